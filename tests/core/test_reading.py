"""Read bounded JSON, and regular files only."""

import os
import socket
import threading

import pytest

from gdtool.core.errors import InputError
from gdtool.core.reading import bytes_of, parse_json


@pytest.mark.parametrize(
    "text, said",
    [
        (b"[" * 100_000, "nested"),
        (b'{"a": ' + b"9" * 5000 + b"}", "64 bits"),
        (b'{"a": 18446744073709551616}', "64 bits"),
        (b'{"a": 1e999}', "double precision"),
        (b'{"a": NaN}', "NaN"),
        (b'{"a": -Infinity}', "Infinity"),
        (b'{"a": 1, "a": 2}', "twice"),
        (b'{"a": [{"b": "\\ud800"}]}', "a[0].b holds the lone surrogate U+D800"),
        (b'{"\\udfff": 1}', "surrogate"),
        (b"\xff\xfe", "UTF-8"),
        (b'{"a": ', "line 1"),
        (b"", "line 1"),
    ],
)
def test_invalid_json_is_refused(text, said):
    with pytest.raises(InputError) as caught:
        parse_json(text, "x.json")
    assert said in str(caught.value)
    assert caught.value.cure
    assert caught.value.subject == "x.json"


def test_valid_json_is_parsed():
    assert parse_json(b'\xef\xbb\xbf{"a": [1, -2.5e3, "\\ud83d\\ude00", "caf\\udce9", null, true]}', "x") == {
        "a": [1, -2500.0, "\U0001f600", "caf\udce9", None, True]
    }


def test_only_regular_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "zero").symlink_to("/dev/zero")
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "socket"))
        for name, said in (
            ("fifo", "FIFO"),
            ("zero", "device"),
            ("socket", "socket"),
            ("none", "does not exist"),
            (".", "folder"),
            ("x" * 300, "too long"),
            ("a\0b", "not a file name"),
        ):
            answer = []
            thread = threading.Thread(
                target=lambda name=name, answer=answer: answer.append(_refusal(tmp_path / name)), daemon=True
            )
            thread.start()
            thread.join(5)
            assert answer, name
            assert said in answer[0], name
    (tmp_path / "file").write_bytes(b"x")
    assert bytes_of(tmp_path / "file") == b"x"


def _refusal(path):
    try:
        bytes_of(path)
    except InputError as error:
        return str(error)
    return "was read"
