"""Read a picture, cut its subject out and frame it as the model's condition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.diffusion.data.framing import (
    Square,
    frame_as_wonder3d,
    framed_square,
    resample,
    whole_frame,
    whole_frame_as_wonder3d,
)
from gdtool.images.color import linear_from_srgb, srgb_from_linear
from gdtool.images.io import read_image
from gdtool.images.mask import foreground

MIN_PICTURE_SIDE = 32  # along the picture's shorter side; the model needs as much detail
MAX_FINER = 8  # most pixels of picture.png across one pixel of a view


@dataclass(frozen=True)
class PictureOptions:
    """Set how a picture becomes a condition.

    mask: path of an image that is bright where the subject is. matting: path of an ONNX network that separates the
    subject. crop: centre and scale the subject as in training; otherwise the picture's framing stays. size: side of the
    condition in pixels. wonder3d: frame as Wonder3D's data set does, for its weights.
    """

    mask: str | None
    matting: str | None
    crop: bool
    size: int
    wonder3d: bool = False

    def without_mask(self) -> PictureOptions:
        """Return the same options for a picture that the mask does not belong to."""
        return replace(self, mask=None)


def mask_size_error(mask: str, size: tuple[int, ...], wanted: tuple[int, ...]) -> InputError:
    """Make the error for a mask whose size (width, height) is not the picture's."""
    return InputError(
        mask, f"is {size[0]}x{size[1]}, the image {wanted[0]}x{wanted[1]}", f"scale it to {wanted[0]}x{wanted[1]}"
    )


def make_condition(
    path: Path, name: str, options: PictureOptions, warn: Callable[[str], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Read a picture, cut its subject out and frame it, at the model's size and at about the picture's resolution.

    Returns two images of the same square: (size, size, 4) and (f size, f size, 4), float32, linear color and straight
    alpha. The whole number f, 1 to MAX_FINER, keeps the picture's resolution best. With options.wonder3d the sRGB
    values of the first are whole multiples of 1/255. warn, errors: as in read_subject().
    """
    return _framed(read_subject(path, name, options, warn), options)


def read_subject(path: Path, name: str, options: PictureOptions, warn: Callable[[str], None]) -> np.ndarray:
    """Read a picture and cut its subject out; returns (h, w, 4), linear color and straight alpha, float32.

    warn: called with a text where the subject may be cut off. Raises InputError for a picture without a usable subject.
    """
    image = read_image(path)
    if min(image.shape[:2]) < MIN_PICTURE_SIDE:
        raise InputError(
            path,
            f"is {image.shape[1]}x{image.shape[0]} pixels; the model needs {MIN_PICTURE_SIDE} at least",
            "give a larger picture",
        )
    mask = None
    if options.mask is not None:
        mask = read_image(Path(options.mask))
        if mask.shape[:2] != image.shape[:2]:
            raise mask_size_error(options.mask, mask.shape[1::-1], image.shape[1::-1])
    alpha = foreground(image, mask, path, warn, options.matting)
    if not (alpha > 0.5).any():
        raise InputError(path, "shows no subject: its mask is empty", "give one with --mask")
    edge = np.concatenate([alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]])
    if options.crop and (edge > 0.5).any():
        warn(f"{name}: the subject touches the border of the picture and may be cut off")
    linear = image.dtype.kind == "f"
    color = (
        image[..., :3]
        if image.ndim == 3 and image.shape[2] >= 3
        else np.repeat(image.reshape(*image.shape[:2], -1)[..., :1], 3, -1)
    )
    if not linear:
        color = linear_from_srgb(color.astype(np.float32) / np.iinfo(image.dtype).max)
    return np.concatenate([color, alpha[..., None]], -1).astype(np.float32)


def _framed(rgba: np.ndarray, options: PictureOptions) -> tuple[np.ndarray, np.ndarray]:
    """Frame rgba (h, w, 4), linear color and straight alpha, at the model's size and about at its own resolution."""
    size, square = options.size, Square(0.0, 0.0, float(max(rgba.shape[:2])))
    if options.wonder3d and options.crop:
        condition, square = frame_as_wonder3d(rgba, size)
    elif options.wonder3d:
        condition = whole_frame_as_wonder3d(rgba, size)
    elif options.crop:
        square = framed_square(rgba)
        condition = resample(rgba, square, size)
    else:
        condition = whole_frame(rgba, size)
    finer = finer_size(square, size)
    return condition, resample(rgba, square, finer) if options.crop else whole_frame(rgba, finer)


def finer_size(square: Square, size: int) -> int:
    """Return the whole multiple of size at which a square of a picture keeps about the picture's resolution."""
    return size * min(max(round(square.side / size), 1), MAX_FINER)


def frame_subject(rgba: np.ndarray, square: Square, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Resample a square of rgba (h, w, 4) to (size, size, 4), and to a multiple of it at the picture's resolution."""
    return resample(rgba, square, size), resample(rgba, square, finer_size(square, size))


def encode_rgba(image: np.ndarray) -> np.ndarray:
    """Encode the linear color of (h, w, 4) to sRGB, clipped to [0, 1]. Alpha is clipped only."""
    return np.concatenate([srgb_from_linear(np.clip(image[..., :3], 0, 1)), np.clip(image[..., 3:], 0, 1)], -1)
