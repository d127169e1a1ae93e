"""Write and read image files, and refuse damaged, huge and unsupported ones."""

import os
import struct
import subprocess
import sys
import zlib

import numpy as np
import OpenImageIO as oiio
import pytest

from gdtool.core.errors import InputError, OutputError, ResourceError
from gdtool.images.io import decode_image, encode_png, encode_pngs, read_image, write_exr, write_png
from tests.images.png import GREY, GREY_ALPHA, PALETTE, RGB, RGBA, adam7, chunk, png, scanlines


@pytest.fixture
def picture() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (33, 47, 3), np.uint8)


def save(path, image: np.ndarray, **attributes) -> None:
    """Write an image through OpenImageIO, with attributes of the spec."""
    kind = {"uint8": "uint8", "uint16": "uint16", "float32": "float"}[image.dtype.name]
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], kind)
    for key, value in attributes.items():
        spec[key] = value
    out = oiio.ImageOutput.create(str(path))
    assert out.open(str(path), spec)
    assert out.write_image(np.ascontiguousarray(image))
    assert out.close()


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_is_read_as_written(tmp_path, channels, dtype):
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max + 1, (20, 31, channels)).astype(dtype)
    write_png(tmp_path / "x.png", image)
    back = read_image(tmp_path / "x.png")
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, image)


def test_colours_under_transparent_pixels_stay(tmp_path):
    image = np.zeros((4, 4, 4), np.uint8)
    image[..., 0] = 200
    write_png(tmp_path / "x.png", image)
    assert (read_image(tmp_path / "x.png")[..., 0] == 200).all()


@pytest.mark.parametrize("bits", [8, 16])
def test_floats_round_to_the_nearest_step(tmp_path, bits):
    values = np.linspace(0, 1, 1000, dtype=np.float64).reshape(20, 50)
    write_png(tmp_path / "x.png", values, bits=bits)
    top = (1 << bits) - 1
    assert np.abs(read_image(tmp_path / "x.png")[..., 0] / top - values).max() <= 0.5 / top + 1e-9


def test_exr_is_exact_and_straight(tmp_path):
    depth = np.random.default_rng(2).normal(size=(20, 30)).astype(np.float32) * 1e3
    write_exr(tmp_path / "d.exr", depth)
    np.testing.assert_array_equal(read_image(tmp_path / "d.exr")[..., 0], depth)
    rgba = np.random.default_rng(3).uniform(0.1, 1, (20, 30, 4)).astype(np.float32)
    write_exr(tmp_path / "c.exr", rgba)
    np.testing.assert_allclose(read_image(tmp_path / "c.exr"), rgba, rtol=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_exr_holds_finite_numbers_only(tmp_path, bad):
    image = np.ones((4, 5), np.float32)
    image[1, 2] = bad
    with pytest.raises(OutputError, match="1 numbers that are not finite"):
        write_exr(tmp_path / "x.exr", image)
    assert not (tmp_path / "x.exr").exists()


def test_same_pixels_same_bytes():
    image = np.random.default_rng(4).random((16, 16, 3))
    assert encode_png(image) == encode_png(image)


def test_not_finite_is_not_written(tmp_path):
    with pytest.raises(ValueError):
        write_png(tmp_path / "x.png", np.full((4, 4), np.nan))


def test_interlaced_equals_plain(picture):
    plain = png(47, 33, RGB, 8, scanlines(picture))
    woven = png(47, 33, RGB, 8, adam7(picture), interlaced=True)
    np.testing.assert_array_equal(decode_image(woven, "woven"), decode_image(plain, "plain"))
    np.testing.assert_array_equal(decode_image(plain, "plain"), picture)


def test_palette_with_transparency_equals_its_plain_twin():
    palette = np.array([[255, 0, 0], [0, 200, 0], [0, 0, 90]], np.uint8)
    alpha = np.array([255, 128, 0], np.uint8)
    index = np.random.default_rng(5).integers(0, 3, (32, 40, 1), np.uint8)
    before = chunk(b"PLTE", palette.tobytes()) + chunk(b"tRNS", alpha.tobytes())
    twin = np.concatenate([palette[index[..., 0]], alpha[index]], -1)
    np.testing.assert_array_equal(decode_image(png(40, 32, PALETTE, 8, scanlines(index), before=before), "p"), twin)
    np.testing.assert_array_equal(decode_image(png(40, 32, RGBA, 8, scanlines(twin)), "t"), twin)


def test_one_bit_palette_and_grey():
    rows = np.packbits(np.eye(32, dtype=np.uint8), axis=1)[..., None]
    palette = chunk(b"PLTE", bytes([10, 20, 30, 40, 50, 60]))
    grey = decode_image(png(32, 32, GREY, 1, scanlines(rows)), "g")
    np.testing.assert_array_equal(grey[..., 0], np.eye(32) * 255)
    colors = decode_image(png(32, 32, PALETTE, 1, scanlines(rows), before=palette), "p")
    np.testing.assert_array_equal(colors[0, :2], [[40, 50, 60], [10, 20, 30]])


def test_grey_and_alpha_in_sixteen_bits():
    image = np.random.default_rng(6).integers(0, 65536, (33, 35, 2)).astype(np.uint16)
    np.testing.assert_array_equal(decode_image(png(35, 33, GREY_ALPHA, 16, scanlines(image)), "g"), image)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_rotation_is_applied(tmp_path, orientation):
    upright = np.random.default_rng(7).integers(0, 256, (34, 40, 3), np.uint8)
    # what a camera held so would store: the inverse of the turn that the EXIF table names
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright, 1),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    save(tmp_path / "x.tif", stored, Orientation=orientation)
    np.testing.assert_array_equal(read_image(tmp_path / "x.tif"), upright)


def faulty(kind: str, picture: np.ndarray) -> bytes:
    whole = png(47, 33, RGB, 8, scanlines(picture))
    if kind == "empty":
        return b""
    if kind == "text":
        return b"these are words, not pixels"
    if kind == "truncated":
        return whole[: len(whole) // 2]
    if kind == "checksum":
        return whole[:200] + bytes([whole[200] ^ 255]) + whole[201:]
    if kind == "no end":
        return whole[:-12]
    if kind == "animated":
        return png(47, 33, RGB, 8, scanlines(picture), before=chunk(b"acTL", struct.pack(">II", 2, 0)))
    if kind == "gif":
        return b"GIF89a" + b"\0" * 60
    raise KeyError(kind)


@pytest.mark.parametrize(
    ("kind", "fact"),
    [
        ("empty", "is empty"),
        ("text", "is not an image"),
        ("truncated", "cut short"),
        ("checksum", "bad checksum"),
        ("no end", "cut short"),
        ("animated", "animation"),
        ("gif", "GIF"),
    ],
)
def test_faulty_files_are_named(tmp_path, picture, kind, fact, capfd):
    path = tmp_path / "x.png"
    path.write_bytes(faulty(kind, picture))
    with pytest.raises(InputError, match=fact) as caught:
        read_image(path)
    assert str(path) in str(caught.value)
    assert capfd.readouterr().err == ""  # the decoders' own complaints do not reach the user


@pytest.mark.parametrize("cut", [0.3, 0.9])
def test_truncated_jpeg(tmp_path, picture, cut):
    save(tmp_path / "x.jpg", picture)
    content = (tmp_path / "x.jpg").read_bytes()
    assert read_image(tmp_path / "x.jpg").shape == picture.shape
    (tmp_path / "x.jpg").write_bytes(content[: int(len(content) * cut)])
    with pytest.raises(InputError):
        read_image(tmp_path / "x.jpg")


@pytest.mark.parametrize("side", [200_000, 20_000])
def test_huge_headers_are_refused_before_decoding(side):
    rows = zlib.compress(b"\0" * 100_000)
    header = struct.pack(">IIBBBBB", side, side, 8, RGB, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
    with pytest.raises(ResourceError, match="16384"):
        decode_image(bomb, "bomb")


def test_cmyk_is_refused(tmp_path):
    # a baseline TIFF by hand (TIFF 6.0, section 16): photometric interpretation 5 is separated inks
    entries = [
        (256, 3, 1, 40),
        (257, 3, 1, 40),
        (258, 3, 4, 8 + 6400),
        (259, 3, 1, 1),
        (262, 3, 1, 5),
        (273, 4, 1, 8),
        (277, 3, 1, 4),
        (278, 3, 1, 40),
        (279, 4, 1, 6400),
        (332, 3, 1, 1),
    ]
    directory = (
        struct.pack("<H", len(entries))
        + b"".join(struct.pack("<HHII", *entry) for entry in entries)
        + struct.pack("<I", 0)
    )
    (tmp_path / "x.tif").write_bytes(
        struct.pack("<2sHI", b"II", 42, 8 + 6400 + 8)
        + bytes(range(256)) * 25
        + struct.pack("<4H", 8, 8, 8, 8)
        + directory
    )
    with pytest.raises(InputError, match="CMYK"):
        read_image(tmp_path / "x.tif")


def test_exr_with_nan_names_the_pixel(tmp_path):
    image = np.ones((40, 50, 3), np.float32)
    image[7, 11, 1] = np.nan
    save(tmp_path / "x.exr", image)
    with pytest.raises(InputError, match="row 7, column 11"):
        read_image(tmp_path / "x.exr")


@pytest.mark.parametrize("cut", [0.2, 0.5, 0.95])
def test_a_truncated_exr_gives_one_error_line(tmp_path, cut, capfd):
    write_exr(tmp_path / "x.exr", np.random.default_rng(9).random((64, 64, 3)))
    content = (tmp_path / "x.exr").read_bytes()
    (tmp_path / "x.exr").write_bytes(content[: int(len(content) * cut)])
    with pytest.raises(InputError, match="damaged or cut short|cannot be read|can be read"):
        read_image(tmp_path / "x.exr")
    assert capfd.readouterr().err == ""
    (tmp_path / "x.exr").write_bytes(content)
    assert read_image(tmp_path / "x.exr").shape == (64, 64, 3)


def test_several_pages_are_refused(tmp_path, picture):
    spec = oiio.ImageSpec(47, 33, 3, "uint8")
    path = str(tmp_path / "x.tif")
    out = oiio.ImageOutput.create(path)
    assert out.open(path, (spec, spec))
    assert out.write_image(picture)
    assert out.open(path, spec, "AppendSubimage")
    assert out.write_image(picture)
    assert out.close()
    with pytest.raises(InputError, match="several images"):
        read_image(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_image(tmp_path / "none.png")
    with pytest.raises(InputError, match="folder"):
        read_image(tmp_path)


def test_names_that_are_not_utf8(tmp_path, picture):
    path = os.fsdecode(os.fsencode(tmp_path) + b"/\xff\xfe.png")
    write_png(path, picture)
    np.testing.assert_array_equal(read_image(path), picture)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        write_png(tmp_path / "file" / "x.png", np.zeros((4, 4)))


@pytest.mark.parametrize("writer", ["write_png", "write_exr"])
def test_a_full_disk_is_reported(tmp_path, writer):
    code = f"""
import resource, signal, sys
import numpy as np
from gdtool.core.errors import OutputError
from gdtool.images.io import {writer}
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
try:
    {writer}(sys.argv[1], np.random.default_rng(0).random((128, 128, 3)))
except OutputError:
    sys.exit(44)
"""
    path = tmp_path / ("x.png" if writer == "write_png" else "x.exr")
    assert subprocess.run([sys.executable, "-c", code, path]).returncode == 44
    assert not path.exists()


def test_several_are_encoded_as_each_would_be(picture):
    images = [picture, picture[..., :1], picture.astype(np.uint16) * 257]
    assert encode_pngs(images, threads=3) == [encode_png(image) for image in images] == encode_pngs(images)
