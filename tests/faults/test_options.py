"""Bound what comes in by the command line and stdin: numbers, strings, generated objects."""

import importlib
import io
import sys

import click
import msgspec
import pytest

from gdtool.commands import COMMANDS
from gdtool.commands._options import build_options
from gdtool.core import sources
from gdtool.core.errors import UsageError

MODULES = {name: importlib.import_module("gdtool.commands." + name.replace("-", "_")) for name in COMMANDS}
NUMBERS = [
    (name, param)
    for name, module in MODULES.items()
    for param in module.command.params
    if isinstance(param.type, (click.types.IntParamType, click.types.FloatParamType))
]
STRINGS = [
    (name, param)
    for name, module in MODULES.items()
    for param in module.command.params
    if not getattr(param, "is_flag", False)
    and not isinstance(param.type, (click.Choice, click.types.IntParamType, click.types.FloatParamType))
]


def by_option(pairs):
    """Parametrize a test by options."""
    return pytest.mark.parametrize("name, param", pairs, ids=[f"{name}-{param.name}" for name, param in pairs])


def converted(name, param, text):
    """Convert text as the option's type does."""
    return param.type_cast_value(click.Context(MODULES[name].command), (text,) if param.nargs == -1 else text)


def feed(monkeypatch, content):
    """Replace stdin."""
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(content)))


@by_option(NUMBERS)
def test_every_number_has_two_finite_bounds(name, param):
    assert param.type.min is not None, f"{name} {param.opts[0]}: give it ge and le"
    assert param.type.max is not None, f"{name} {param.opts[0]}: give it ge and le"
    for text in ("nan", "inf", "-inf", "1e400", "1" + 30 * "0", "9" * 5000):
        with pytest.raises(click.BadParameter):
            converted(name, param, text)
    if not param.type.max_open:
        assert converted(name, param, str(param.type.max)) == param.type.max


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "validate"])
def test_option_structs_have_the_bounds_of_the_command_line(name):
    """Options may also be built from a manifest or in a test."""
    struct = importlib.import_module("gdtool.stages." + name.replace("-", "_")).Options
    defaults = {field.name: field.default for field in msgspec.structs.fields(struct)}
    for field in msgspec.structs.fields(struct):
        if isinstance(field.default, float):
            for wrong in (float("nan"), float("inf"), -1e30, 1e30):
                with pytest.raises(UsageError):
                    build_options(struct, defaults | {field.name: wrong})


@by_option(STRINGS)
def test_strings_with_control_characters_are_refused(name, param):
    for text in ("a\nb", "a\0b", "a\x1bb", "a\x85b", "a\ud800b"):
        with pytest.raises(click.BadParameter) as caught:
            converted(name, param, text)
        assert len(str(caught.value.format_message()).splitlines()) == 1
    assert "caf\udce9" in converted(name, param, "caf\udce9")  # a name that is not UTF-8


@pytest.mark.parametrize(
    "text, fact",
    [
        ("procedural:5..2", "ends before it begins"),
        (f"procedural:{2**63}", "beyond 64 bits"),
        (f"procedural:0..{2**64}", "beyond 64 bits"),
        ("procedural:" + "9" * 5000, "beyond 64 bits"),
        ("procedural:-1", "is not procedural:SEED"),
        ("procedural:٣", "is not procedural:SEED"),
        ("procedural:1\n", "control character"),
        ("procedural:", "is not procedural:SEED"),
    ],
)
def test_ranges_of_procedural_seeds_are_ascending_64_bit_numbers(text, fact):
    with pytest.raises(UsageError, match=fact) as caught:
        next(sources.incoming(("procedural:1", text)))  # told before the first one is worked on
    assert caught.value.cure
    assert len(str(caught.value)) < 400
    assert list(sources.incoming(("procedural:2..4", f"procedural:{2**63 - 1}"))) == [
        "procedural:2",
        "procedural:3",
        "procedural:4",
        f"procedural:{2**63 - 1}",
    ]


@pytest.mark.parametrize(
    "line",
    [
        b'{"folder": 5}',
        b'{"folder": ["a"]}',
        b'{"path": "a"}',
        b'{"folder": "\\ud800"}',
        b'{"folder": "a\\u0000b"}',
        b'{"folder": "a\\nb"}',
        b'{"folder": "a"',
        b'{"folder": ' + b"9" * 5000 + b"}",
        b'{"folder": ' + b"[" * 100_000,
        b'{"folder": "a", "folder": "b"}',
        b"a\0b",
        b"a\x1b[2Jb",
        b"a\rb",
        b"x" * (sources.MAX_LINE_BYTES + 1),
        b'{"folder": "\xff"}',
    ],
    ids=lambda line: line[:24],
)
def test_malformed_lines_of_stdin_are_refused(monkeypatch, line):
    feed(monkeypatch, b"first\n" + line + b"\n")
    stream = sources.incoming(())
    assert next(stream) == "first"
    with pytest.raises(UsageError) as caught:
        next(stream)
    assert caught.value.cure
    assert len(str(caught.value)) < 400
    assert len(str(caught.value).splitlines()) == 1


def test_lines_of_stdin_name_sources_as_paths_or_json(monkeypatch):
    feed(
        monkeypatch,
        b'caf\xe9.obj\r\n{"folder": "a/b", "seconds": 1.5}\n{"folder": null}\n\n{"folder": "\\udce9"}\nlast',
    )
    assert list(sources.incoming(())) == ["caf\udce9.obj", "a/b", "\udce9", "last"]


def test_an_empty_pipe_blames_the_command_before_it(monkeypatch):
    feed(monkeypatch, b"")
    with pytest.raises(
        UsageError, match="gave no sources; the command before the pipe has failed or printed nothing: see its message"
    ):
        next(sources.incoming(()))
    monkeypatch.setattr(sys, "stdin", None)
    with pytest.raises(UsageError, match="gave no sources; name files or folders, or pipe their paths in"):
        next(sources.incoming(()))


@pytest.mark.parametrize(
    "arguments",
    [
        ["remesh", "x.obj", "-o", "a\nb"],
        ["remesh", "a\nb"],
        ["relight", "x.obj", "--exposure", "inf"],
        ["relight", "x.obj", "--seed", str(2**70)],
        ["remesh", "x.obj", "--seconds", "inf"],
        ["remesh", "x.obj", "--threads", str(10**9)],
        ["render-dataset", "x.obj", "--shard", "1/" + "9" * 5000],
        ["render-dataset", "x.obj", "--shard", "٣/٣"],
        ["remesh", "x.obj", "--no-such-option"],
        ["nothing"],
    ],
    ids=lambda a: " ".join(a)[:40],
)
def test_a_wrong_command_line_gives_one_line_and_exits_2(gdtool_here, arguments, tmp_path):
    done = gdtool_here(*arguments)
    assert done.returncode == 2, done.stderr
    assert done.stdout == "", done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("gdtool")
    assert list(tmp_path.iterdir()) == []
