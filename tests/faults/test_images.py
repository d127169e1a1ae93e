"""Read pictures of all kinds: refuse them in one line with the file and the fact, or use them correctly."""

import os
import struct
import subprocess
import sys

import numpy as np
import pytest

from gdtool.core.names import name_from_path
from gdtool.images.io import read_image, write_png
from tests.faults.files import leftovers, lines_of
from tests.images.png import GREY_ALPHA, PALETTE, RGB, RGBA, adam7, chunk, png, scanlines
from tests.stages.test_sample_views import tiny_model  # noqa: F401  (a fixture)

SIZE = 48


def ball() -> np.ndarray:
    """Make a shaded disc (48, 48, 4) uint8 on a transparent background, away from the border."""
    y, x = np.mgrid[:SIZE, :SIZE]
    inside = (x - 22) ** 2 + (y - 25) ** 2 < 15**2
    return (np.stack([60 + 3 * x, 200 - 2 * y, 90 + 0 * x, np.full_like(x, 255)], -1) * inside[..., None]).astype(
        np.uint8
    )


def write(path, content: bytes):
    """Write a file and return its name."""
    path.write_bytes(content)
    return path.name


def refused(folder) -> dict[str, tuple[int, str]]:
    """Write faulty pictures; returns the exit code and a word of the message by file name."""
    whole = png(SIZE, SIZE, RGBA, 8, scanlines(ball()))
    write(folder / "empty.png", b"")
    write(folder / "text.png", b"a text")
    write(folder / "cut.png", whole[: len(whole) * 2 // 3])
    write(folder / "crc.png", whole[:60] + bytes([whole[60] ^ 255]) + whole[61:])
    write(
        folder / "wide.png",
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 200_000, 200_000, 8, RGB, 0, 0, 0)) + whole[33:],
    )
    write(folder / "bomb.png", png(16_000, 16_000, RGBA, 16, b"\0" * 30_000_000))
    write(
        folder / "animated.png",
        png(SIZE, SIZE, RGBA, 8, scanlines(ball()), before=chunk(b"acTL", struct.pack(">II", 2, 0))),
    )
    write_png(folder / "small.png", np.full((16, 16, 4), 0.5))
    write_png(folder / "clear.png", np.zeros((SIZE, SIZE, 4)))
    write_png(folder / "noise.png", np.random.default_rng(0).random((SIZE, SIZE, 3)))
    return {
        "empty.png": (3, "empty"),
        "text.png": (3, "not an image"),
        "cut.png": (3, "cut"),
        "crc.png": (3, "checksum"),
        "wide.png": (5, "16384"),
        "bomb.png": (5, "bomb"),
        "animated.png": (3, "animation"),
        "small.png": (3, "small"),
        "clear.png": (3, "transparent"),
        "noise.png": (3, "--mask"),
        "none.png": (3, "does not exist"),
    }


def test_each_faulty_picture_is_refused_in_one_line(gdtool, tmp_path, tiny_model):  # noqa: F811
    cases = refused(tmp_path)
    done = gdtool("sample-views", *cases, "--model", tiny_model, "--steps", 1, "-q")
    errors = lines_of(done.stderr)
    for name, (_, word) in cases.items():
        about = [line for line in errors if line.removeprefix("gdtool: ").startswith(name)]
        assert len(about) == 1, (name, about, done.stderr)
        assert word in about[0], (name, about, done.stderr)
    assert done.returncode == 1  # all failed, but not of one kind
    assert done.stdout == ""
    assert leftovers(tmp_path) == []
    assert not list(tmp_path.glob("*.asset/*"))
    three = [name for name, (code, _) in cases.items() if code == 3]
    assert gdtool("sample-views", *three[:2], "--model", tiny_model, "-q").returncode == 3
    assert gdtool("sample-views", "wide.png", "bomb.png", "--model", tiny_model, "-q").returncode == 5


def test_one_picture_in_every_png_encoding_gives_the_same_pixels(gdtool, tmp_path, tiny_model):  # noqa: F811
    picture = ball()
    write(tmp_path / "plain.png", png(SIZE, SIZE, RGBA, 8, scanlines(picture)))
    write(tmp_path / "interlaced.png", png(SIZE, SIZE, RGBA, 8, adam7(picture), interlaced=True))
    write(tmp_path / "sixteen.png", png(SIZE, SIZE, RGBA, 16, scanlines(picture.astype(np.uint16) * 257)))
    colors, index = np.unique(picture.reshape(-1, 4), axis=0, return_inverse=True)
    few = colors[:256][np.minimum(index.reshape(SIZE, SIZE), 255)]
    write(tmp_path / "few.png", png(SIZE, SIZE, RGBA, 8, scanlines(few)))
    write(
        tmp_path / "palette.png",
        png(
            SIZE,
            SIZE,
            PALETTE,
            8,
            scanlines(np.minimum(index, 255).reshape(SIZE, SIZE, 1).astype(np.uint8)),
            before=chunk(b"PLTE", colors[:256, :3].tobytes()) + chunk(b"tRNS", colors[:256, 3].tobytes()),
        ),
    )
    grey = picture[..., [0, 3]]
    write(tmp_path / "grey.png", png(SIZE, SIZE, GREY_ALPHA, 8, scanlines(grey)))
    write(tmp_path / "grey_rgba.png", png(SIZE, SIZE, RGBA, 8, scanlines(grey[..., [0, 0, 0, 1]])))
    names = ("plain", "interlaced", "sixteen", "few", "palette", "grey", "grey_rgba")
    done = gdtool("sample-views", *(f"{name}.png" for name in names), "--model", tiny_model, "--steps", 1, "-q")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == len(names), done.stderr
    condition = {name: read_image(tmp_path / f"{name}.asset/views/condition/000.png") for name in names}
    for first, second in (("plain", "interlaced"), ("plain", "sixteen"), ("few", "palette"), ("grey", "grey_rgba")):
        assert np.array_equal(condition[first], condition[second]), (first, second)
    assert condition["plain"][..., 3].any()


def test_a_subject_cut_by_the_border_gives_a_warning(gdtool, tmp_path, tiny_model):  # noqa: F811
    picture = np.zeros((SIZE, SIZE, 4))
    picture[10:40, 20:] = (0.8, 0.3, 0.2, 1)
    write_png(tmp_path / "border.png", picture)
    done = gdtool("sample-views", "border.png", "--model", tiny_model, "--steps", 1)
    assert done.returncode == 0
    assert "warning: " in done.stderr
    assert "border" in done.stderr.replace("border.", "")


@pytest.mark.parametrize("name", [b"caf\xe9.png", "貓 *.png".encode(), b"-x [1].png"])
def test_file_names_of_any_characters_work(tmp_path, tiny_model, name):  # noqa: F811
    """Names that are not UTF-8, with spaces, brackets or a leading dash, as argument and in the output's name."""
    path = os.fsencode(tmp_path) + b"/" + name
    with open(path, "wb") as file:  # noqa: PTH123 - a name of bytes
        file.write(png(SIZE, SIZE, RGBA, 8, scanlines(ball())))
    command = [
        sys.executable,
        "-m",
        "gdtool",
        "sample-views",
        "--model",
        str(tiny_model),
        "--steps",
        "1",
        "-q",
        "--",
        name,
    ]
    done = subprocess.run(command, capture_output=True, cwd=tmp_path, env={**os.environ, "OMP_NUM_THREADS": "2"})
    assert done.returncode == 0, done.stderr
    out = done.stdout.removesuffix(b"\n")
    # The object's name is text: bytes that are not UTF-8 are read as Latin-1.
    assert out == os.fsencode(name_from_path(os.fsdecode(name.removesuffix(b".png")))) + b".asset/views"
    check = subprocess.run(
        [sys.executable, "-m", "gdtool", "validate", "-q"], input=done.stdout, capture_output=True, cwd=tmp_path
    )
    assert check.returncode == 0, check.stderr
