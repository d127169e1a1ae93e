"""Read and write image files through OpenImageIO, with the checks that its readers leave out.

Reading never applies a colour space: it returns the stored values. The limits keep a small file from taking a large
part of the machine's memory.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gdtool.core.ending import temporary_folder
from gdtool.core.errors import InputError, OutputError, ResourceError, from_os_error
from gdtool.core.memory import require_memory
from gdtool.core.reading import require_regular_file
from gdtool.core.threads import mapped
from gdtool.images.containers import COPY, MAX_SIDE, check_container, suffix_of

MAX_BYTES = 1 << 30  # of the pixels as stored, all channels of the file: OpenImageIO's own limit is set to it
# Bytes while one picture is read: the pixels as stored, as decoded, and one copy where they are turned or put in order.
MAX_HELD = 4 << 30
_ROWS = 256  # rows at a time where pixels are checked and changed in place

_TYPES = {
    "uint8": ("uint8", np.uint8),
    "uint16": ("uint16", np.uint16),
    "half": ("float", np.float32),
    "float": ("float", np.float32),
    "double": ("float", np.float32),
}


def read_image(path: str | Path) -> np.ndarray:
    """Read an image as it is stored: (h, w, c) uint8, uint16 or float32, row 0 at the top, c = 1..4.

    1 channel is grey, 2 grey and alpha, 3 RGB, 4 RGBA; alpha is straight (EXR's premultiplied colours are divided).
    Palettes are expanded, EXIF rotation is applied.

    Raises InputError for a file that is not one complete still image in grey or RGB, is not regular, or holds values
    that are not finite. Raises ResourceError beyond 16384 pixels a side, beyond 1 GiB of stored pixels, and where
    reading would take more than 4 GiB (MAX_HELD) or half of the memory. Raises OutputError when the file cannot be
    read.
    """
    path = Path(path)
    require_regular_file(path)
    try:
        with Path(path).open("rb") as file:
            head = file.read(64)
            check_container(path, head, file)
    except OSError as error:
        raise from_os_error(error, path) from None
    with _plain_name(path) as name, _quiet() if suffix_of(head) == ".exr" else contextlib.nullcontext():
        try:
            return _read(path, name)
        except UnicodeDecodeError:  # OpenImageIO's binding decodes names and messages from the file
            raise InputError(path, "is damaged (its header is not text where it should be)", COPY) from None


def decode_image(content: bytes, subject: str) -> np.ndarray:
    """Read an image from memory, as read_image does; subject names it in errors."""
    with temporary_folder() as folder:
        # OpenImageIO's Python reader opens names only.
        path = folder / ("image" + suffix_of(content))
        path.write_bytes(content)
        try:
            return read_image(path)
        except (InputError, ResourceError) as error:
            raise type(error)(subject, error.fact, error.cure) from None


def _read(path: Path, name: str) -> np.ndarray:
    """Read the stored pixels of a file, which OpenImageIO opens by `name`. Raises as read_image does."""
    import OpenImageIO as oiio

    oiio.attribute("limits:imagesize_MB", MAX_BYTES >> 20)
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(name, config)
    if source is None:
        fact = oiio.geterror().replace(name, "").strip().split("\n")[0]
        if "exceeds" in fact or "limit" in fact:
            raise ResourceError(
                path, f"is larger than gdtool reads ({MAX_SIDE} pixels a side, {MAX_BYTES >> 30} GiB)", "scale it down"
            )
        raise InputError(
            path,
            f"is not an image that can be read ({_lower(fact) or 'unknown format'})",
            "save it as PNG, JPEG or EXR",
        )
    try:
        spec = source.spec()
        _check_spec(path, spec)
        if str(spec.format) not in _TYPES:
            raise InputError(path, f"stores {spec.format} pixels", "save it in 8 or 16 bits or as float")
        kind, dtype = _TYPES[str(spec.format)]
        channels, orientation = _channels(path, list(spec.channelnames)), spec.get_int_attribute("Orientation", 1)
        first, last = min(channels), max(channels) + 1
        _check_held(
            path, spec, last - first, np.dtype(dtype).itemsize, orientation != 1 or channels != list(range(first, last))
        )
        pixels = (
            source.read_image(kind) if last - first == spec.nchannels else source.read_image(0, 0, first, last, kind)
        )
        # A truncated file can come back as zeros with success: only the error flag tells.
        if pixels is None or source.has_error:
            fact = source.geterror().replace(name, "").strip().split("\n")[0]
            raise InputError(path, f"is damaged or cut short ({_lower(fact) or 'the pixels cannot be read'})", COPY)
        file_format = source.format_name()
        if source.seek_subimage(1, 0):
            raise InputError(path, "holds several images or an animation", "save the wanted one as a still image")
        source.geterror()
    finally:
        source.close()
    pixels = np.asarray(pixels, dtype).reshape(spec.height, spec.width, last - first)
    if channels != list(range(first, last)):
        pixels = pixels[..., [channel - first for channel in channels]]
    if dtype == np.float32:
        _check_finite(path, pixels)
        if file_format == "openexr" and pixels.shape[2] in (2, 4):
            _divide_by_alpha(pixels)
    return np.ascontiguousarray(_upright(pixels, orientation))


def _lower(text: str) -> str:
    """Begin a message of OpenImageIO with a small letter."""
    return text[:1].lower() + text[1:]


def _check_spec(path: Path, spec) -> None:
    """Raise ResourceError for a header of too many pixels, InputError for CMYK, volumes and animations."""
    if spec.width > MAX_SIDE or spec.height > MAX_SIDE or spec.image_bytes() > MAX_BYTES:
        raise ResourceError(
            path,
            f"is {spec.width}x{spec.height} pixels in {spec.nchannels} channels ({spec.image_bytes() / 2**30:.1f} "
            f"GiB), more than "
            f"{MAX_SIDE} a side or {MAX_BYTES >> 30} GiB",
            "scale it down",
        )
    if spec.depth > 1 or spec.deep:
        raise InputError(path, "is a volume or a deep image", "flatten it")
    spaces = {
        spec.get_string_attribute(key).lower()
        for key in ("jpeg:ColorSpace", "tiff:ColorSpace", "psd:ColorMode", "oiio:ColorSpace")
    }
    if any("cmyk" in space or "ycck" in space or "ycbcrk" in space for space in spaces) or "C" in spec.channelnames[:1]:
        raise InputError(path, "is in CMYK", "convert it to RGB")
    if spec.get_int_attribute("oiio:Movie", 0):
        raise InputError(path, "is an animation", "save one frame as a still image")


def _check_held(path: Path, spec, channels: int, itemsize: int, copied: bool) -> None:
    """Raise ResourceError where reading an image would take more than 4 GiB (MAX_HELD) or half of the memory.

    channels: how many are read, each of itemsize bytes a pixel once decoded. copied: the pixels are copied once more,
    to turn them or to put channels in order.
    """
    pixels = spec.width * spec.height * channels
    size = pixels * spec.format.size() + pixels * itemsize * (2 if copied else 1)
    require_memory(
        size, path, f"reading {spec.width}x{spec.height} pixels in {channels} channels", "scale it down", MAX_HELD
    )


def _channels(path: Path, names: list[str]) -> list[int]:
    """Return the indices of the channels that make grey, grey and alpha, RGB or RGBA, in that order.

    A multi-channel file may hold others.
    """
    if {"R", "G", "B"} <= set(names):
        rgba_names = ["R", "G", "B", *(["A"] if "A" in names else [])]
        return [names.index(name) for name in rgba_names]
    if 1 <= len(names) <= 4:
        return list(range(len(names)))
    if "Y" in names:
        return [names.index("Y")]
    raise InputError(path, f"has the channels {', '.join(names[:8])}", "save grey or RGB with or without alpha")


def _check_finite(path: Path, pixels: np.ndarray) -> None:
    """Raise InputError for the first pixel that is not finite."""
    for start in range(0, len(pixels), _ROWS):
        bad = ~np.isfinite(pixels[start : start + _ROWS])
        if bad.any():
            row, column, channel = np.argwhere(bad)[0]
            value = pixels[start + row, column, channel]
            raise InputError(
                path, f"is not finite at row {start + row}, column {column} ({value})", "give that pixel a finite value"
            )


def _divide_by_alpha(pixels: np.ndarray) -> None:
    """Turn premultiplied colors (h, w, 2 or 4) into straight ones where alpha is above 0, in place."""
    for start in range(0, len(pixels), _ROWS):
        rows = pixels[start : start + _ROWS]
        alpha = rows[..., -1:]
        rows[..., :-1] = np.where(alpha > 0, rows[..., :-1] / np.where(alpha > 0, alpha, 1), rows[..., :-1])


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Undo an EXIF orientation 1..8, and return rows and columns as the camera was held."""
    flips = {2: (1,), 3: (0, 1), 4: (0,), 6: (0,), 7: (0, 1), 8: (1,)}
    if orientation in (5, 6, 7, 8):
        # 5 is a transpose; 6 turns clockwise: flip the rows, then transpose; 8 the other way; 7 over the other
        # diagonal.
        return np.flip(pixels, flips[orientation]).swapaxes(0, 1) if orientation != 5 else pixels.swapaxes(0, 1)
    return np.flip(pixels, flips[orientation]) if orientation in flips else pixels


def quantized(image: np.ndarray, bits: int = 8) -> np.ndarray:
    """Convert float in [0, 1] (clipped) to uint8 or uint16, rounded to nearest; unsigned integers stay."""
    image = np.asarray(image)
    if image.dtype in (np.uint8, np.uint16):
        return image
    if not np.isfinite(image).all():
        raise ValueError("an image to write is not finite")
    top = (1 << bits) - 1
    return np.rint(np.clip(image, 0, 1) * float(top)).astype(np.uint8 if bits == 8 else np.uint16)


def write_png(path: str | Path, image: np.ndarray, bits: int = 8) -> None:
    """Write (h, w) or (h, w, 1..4) as PNG: float in [0, 1] at 8 or 16 bits, uint8 and uint16 as they are.

    Alpha is straight. No colour-space chunk is written: the folder format says what the numbers mean. The file is read
    again and compared; raises OutputError when it cannot be written whole.
    """
    _write(
        Path(path), quantized(image, bits), "uint8" if quantized(image[:1, :1], bits).dtype == np.uint8 else "uint16"
    )


def write_exr(path: str | Path, image: np.ndarray) -> None:
    """Write (h, w) or (h, w, 1, 3 or 4) as 32-bit float EXR with zip compression.

    Alpha is given straight, and stored premultiplied. The file is read again and compared. Raises OutputError, also for
    NaN and infinity, which readers treat in different ways.
    """
    image = np.asarray(image, np.float32)
    if not np.isfinite(image).all():
        raise OutputError(
            path,
            f"would hold {int((~np.isfinite(image)).sum())} numbers that are not finite",
            "this is a fault of gdtool: please report it",
        )
    _write(Path(path), image, "float")


def encode_png(image: np.ndarray, bits: int = 8) -> bytes:
    """Return the bytes of the file that write_png writes."""
    with temporary_folder() as folder:
        path = folder / "image.png"
        write_png(path, image, bits)
        return path.read_bytes()


def encode_pngs(images: list[np.ndarray], bits: int = 8, threads: int = 1) -> list[bytes]:
    """Encode each image as write_png does, several at a time: OpenImageIO compresses outside of Python's lock."""
    return list(mapped(lambda image: encode_png(image, bits), images, min(threads, len(images))))


def _write(path: Path, image: np.ndarray, kind: str) -> None:
    """Write pixels of a kind ("uint8", "uint16" or "float"), and compare the file. Raises OutputError."""
    import OpenImageIO as oiio

    pixels = np.ascontiguousarray(image.reshape(*image.shape[:2], -1))
    height, width, channels = pixels.shape
    names = {1: ("Y",), 2: ("Y", "A"), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}[channels]
    spec = oiio.ImageSpec(width, height, channels, kind)
    spec.channelnames = names
    stored = pixels
    if kind == "float":
        spec["compression"] = "zip"
        spec["DateTime"] = "1970:01:01 00:00:00"  # or the present time is written: equal images, unequal files
        if channels in (2, 4):
            stored = np.concatenate([pixels[..., :-1] * pixels[..., -1:], pixels[..., -1:]], -1)
    else:
        spec["oiio:UnassociatedAlpha"] = 1
        spec["png:compressionLevel"] = 4  # on baked maps a third of the time of 6 and 8 % more bytes
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb"):
            pass  # a plain error when the place cannot be written
    except OSError as error:
        raise from_os_error(error, path) from None
    with _plain_name(path, writing=True) as name:
        target = oiio.ImageOutput.create(name)
        good = target.open(name, spec) and target.write_image(stored) and target.close()
        fact = target.geterror()
    try:
        same = good and np.array_equal(_read_back(path), stored)
    except (InputError, ResourceError):
        same = False
    if not same:
        with contextlib.suppress(OSError):
            path.unlink()
        raise OutputError(
            path,
            f"was not written whole "
            f"({_lower(fact.strip().splitlines()[0]) if fact.strip() else 'it reads back differently'})",
            "free some space or choose another -o",
        )


def _read_back(path: Path) -> np.ndarray:
    """Read the stored pixels, before alpha is divided."""
    import OpenImageIO as oiio

    if path.suffix.lower() != ".exr":
        return read_image(path)
    with _plain_name(path) as name:
        source = oiio.ImageInput.open(name)
        if source is None:
            raise InputError(path, "cannot be read again", COPY)
        spec = source.spec()
        pixels = source.read_image("float")
        failed = source.has_error
        source.close()
    if pixels is None or failed:
        raise InputError(path, "cannot be read again", COPY)
    return np.asarray(pixels, np.float32).reshape(spec.height, spec.width, spec.nchannels)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Send nothing to stderr in a block: OpenEXR prints each fault that it also reports."""
    try:
        saved = os.dup(2)
    except OSError:  # no stderr at all
        yield
        return
    silent = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(silent, 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(silent)


@contextlib.contextmanager
def _plain_name(path: Path, writing: bool = False) -> Iterator[str]:
    """Yield a name that OpenImageIO accepts: the path, or a link to it where the path is not UTF-8."""
    try:
        str(path).encode()
        yield str(path)
    except UnicodeEncodeError:
        with temporary_folder() as folder:
            link = folder / ("image" + (path.suffix if writing else ""))
            link.symlink_to(path.absolute())
            yield str(link)
