"""Images in and out by OpenImageIO: what is read is checked, what is written is read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError, OutputError, ResourceError

MAX_SIDE = 16384


def read_image(path: Path | str) -> np.ndarray:
    """(h, w, c) uint8, uint16 or float32 as stored, row 0 at the top, straight alpha. Raises InputError, ResourceError."""
    import OpenImageIO as oiio

    path = Path(path)
    if not path.is_file():
        raise InputError(path, "does not exist")
    config = oiio.ImageSpec()
    config["oiio:UnassociatedAlpha"] = 1
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise InputError(path, f"is not an image that can be read ({oiio.geterror().strip().splitlines()[0][:120]})")
    try:
        spec = source.spec()
        if max(spec.width, spec.height) > MAX_SIDE:
            raise ResourceError(path, f"is {spec.width}x{spec.height}, the limit is {MAX_SIDE} a side")
        kind = {"uint8": "uint8", "uint16": "uint16"}.get(str(spec.format), "float")
        pixels = source.read_image(kind)
        if pixels is None or source.has_error:
            raise InputError(path, f"is cut or damaged ({source.geterror().strip()[:120]})")
    finally:
        source.close()
    return np.asarray(pixels).reshape(spec.height, spec.width, spec.nchannels)


def write_png(path: Path | str, image: np.ndarray, bits: int = 8) -> None:
    """Write a PNG of (h, w[, c]) floats in [0, 1], or of uint8 or uint16 as they are. Raises OutputError."""
    image = np.asarray(image)
    if image.dtype.kind == "f":
        top = 2**bits - 1
        image = np.round(np.clip(np.nan_to_num(image), 0, 1) * top).astype(np.uint8 if bits == 8 else np.uint16)
    _write(Path(path), image)


def write_exr(path: Path | str, image: np.ndarray) -> None:
    """Write an EXR of (h, w[, c]) float32. Raises OutputError."""
    _write(Path(path), np.asarray(image, np.float32))


def _write(path: Path, image: np.ndarray) -> None:
    import OpenImageIO as oiio

    image = np.ascontiguousarray(image if image.ndim == 3 else image[..., None])
    height, width, channels = image.shape
    spec = oiio.ImageSpec(width, height, channels, image.dtype.name if image.dtype.kind == "u" else "float")
    spec["oiio:UnassociatedAlpha"] = 1
    spec["png:compressionLevel"] = 3
    if channels == 1:
        spec.channelnames = ("Y",)
    output = oiio.ImageOutput.create(str(path))
    if output is None or not output.open(str(path), spec):
        raise OutputError(path, f"cannot be written ({(output.geterror() if output else oiio.geterror()).strip()[:120]})")
    good = output.write_image(image)
    good = output.close() and good
    if not good:
        raise OutputError(path, f"cannot be written ({output.geterror().strip()[:120]})", "free some space or choose another -o")
    try:
        back = read_image(path)
    except InputError as error:
        raise OutputError(path, f"was not written whole ({error.fact})", "free some space or choose another -o") from None
    if not np.array_equal(back, image):
        raise OutputError(path, "was not written as it should be", "free some space or choose another -o")
