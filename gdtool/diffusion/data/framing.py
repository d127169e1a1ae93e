"""Crop and centre a picture the way the rig's front camera frames an object, or the way Wonder3D's data set does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras.camera import HALF_WIDTH
from gdtool.images.color import linear_from_srgb, srgb_from_linear

# The longest side of a normalised object in the front view, as a share of the image.
FRONT_EXTENT = 0.5 / HALF_WIDTH
# The same share in Wonder3D's pictures: crop_size 192 of 256 pixels, configs/mvdiffusion-joint-ortho-6views.yaml.
WONDER3D_EXTENT = 192 / 256


@dataclass(frozen=True)
class Square:
    """Describe a square of a picture: its left and top edge and its side, in the picture's pixels."""

    left: float
    top: float
    side: float


def framed_square(image: np.ndarray, extent: float = FRONT_EXTENT) -> Square:
    """Return the square around the subject of image (h, w, 4) whose side is 1 / extent times the subject's longest."""
    top, bottom, left, right = _bounding_box(image)
    side = max(bottom - top, right - left) / extent
    return Square((left + right - side) / 2, (top + bottom - side) / 2, side)


def framed_together(images: dict[str, np.ndarray]) -> dict[str, Square]:
    """Return the squares of pictures (h, w, 4) by view that give all subjects one height, centred.

    Orthographic views from around an object show it at the same height. The height and the widths of the views along
    the axes are at most a unit box's; views at 45 degrees may be wider.
    """
    boxes = {view: _bounding_box(image) for view, image in images.items()}
    ratios = [(right - left) / (bottom - top) for view, (top, bottom, left, right) in boxes.items() if "_" not in view]
    longest = max([1.0, *ratios])  # in units of the common height
    squares = {}
    for view, (top, bottom, left, right) in boxes.items():
        side = (bottom - top) * longest / FRONT_EXTENT
        squares[view] = Square((left + right - side) / 2, (top + bottom - side) / 2, side)
    return squares


def square_onto(image: np.ndarray, mask: np.ndarray) -> Square:
    """Return the square of image (h, w, 4) in which its subject lies on a silhouette, mask (size, size).

    The bounding boxes have the same centre and the same longest side.
    """
    size = mask.shape[0]
    top, bottom, left, right = _bounding_box(image)
    to_top, to_bottom, to_left, to_right = _bounding_box(np.repeat(mask[..., None], 4, -1))
    scale = max(bottom - top, right - left) / max(to_bottom - to_top, to_right - to_left)
    return Square(
        (left + right - scale * (to_left + to_right)) / 2,
        (top + bottom - scale * (to_top + to_bottom)) / 2,
        scale * size,
    )


def _bounding_box(image: np.ndarray) -> tuple[float, float, float, float]:
    """Return top, bottom, left and right of the subject of image (h, w, 4); of the whole image where it has none."""
    rows, columns = np.nonzero(image[..., 3] > 0.5)
    if not len(rows):
        return 0.0, float(image.shape[0]), 0.0, float(image.shape[1])
    return float(rows.min()), float(rows.max() + 1), float(columns.min()), float(columns.max() + 1)


def frame(image: np.ndarray, size: int, extent: float = FRONT_EXTENT) -> np.ndarray:
    """Centre the subject's bounding box and scale its longest side to extent * size.

    Takes image (h, w, 4), linear color and straight alpha, float32, and returns (size, size, 4) of the same kind.
    Filters premultiplied values, so no background color leaks in.
    """
    return resample(image, framed_square(image, extent), size)


def whole_frame(image: np.ndarray, size: int) -> np.ndarray:
    """Resample the whole picture (h, w, 4), padded with transparency to a square, to (size, size, 4)."""
    h, w = image.shape[:2]
    side = max(h, w)
    square = np.zeros((side, side, 4), np.float32)
    top, left = (side - h) // 2, (side - w) // 2
    square[top : top + h, left : left + w] = image
    return resample(square, Square(0.0, 0.0, float(side)), size)


def resample(image: np.ndarray, square: Square, size: int) -> np.ndarray:
    """Resample a square of the picture (h, w, 4) to (size, size, 4); pixels outside the picture are transparent."""
    import torch
    import torch.nn.functional as F

    h, w = image.shape[:2]
    premultiplied = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], -1)
    source = torch.from_numpy(np.ascontiguousarray(np.moveaxis(premultiplied, -1, 0), np.float32))[None]
    ratio = square.side / size
    if ratio > 1:  # an antialiased shrink to the result's pixel size, then a bilinear look-up that only shifts
        new = (max(round(h / ratio), 1), max(round(w / ratio), 1))
        source = F.interpolate(source, size=new, mode="bilinear", antialias=True, align_corners=False)
    centre = (np.arange(size) + 0.5) / size * square.side
    gx, gy = np.meshgrid((square.left + centre) / w * 2 - 1, (square.top + centre) / h * 2 - 1)
    grid = torch.from_numpy(np.stack([gx, gy], -1).astype(np.float32))[None]
    out = F.grid_sample(source, grid, mode="bilinear", padding_mode="zeros", align_corners=False)[0].numpy()
    alpha = out[3]
    color = np.where(alpha > 1e-4, out[:3] / np.maximum(alpha, 1e-4), 0)
    return np.moveaxis(np.concatenate([color, alpha[None]]), 0, -1).astype(np.float32)


def frame_as_wonder3d(image: np.ndarray, size: int) -> tuple[np.ndarray, Square]:
    """Frame image (h, w, 4) as Wonder3D's data set does: 8-bit sRGB with straight alpha, resized by Pillow's filter.

    Takes linear color and straight alpha, float32; returns (size, size, 4) of the same kind, whose sRGB values are
    whole multiples of 1/255, and about the square of the picture that it shows. The box around all alpha above 0 loses
    its last row and column, its longest side becomes WONDER3D_EXTENT * size, the other is rounded down, and it is
    centred to whole pixels (SingleImageDataset.load_image in mvdiffusion/data/single_image_dataset.py).
    """
    shown = np.rint(255 * image[..., 3]) > 0
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    left, top = int(columns[0]), int(rows[0])
    box = _eight_bit(image[top : max(int(rows[-1]), top + 1), left : max(int(columns[-1]), left + 1)])
    scale = int(WONDER3D_EXTENT * size) / max(box.shape[:2])
    height, width = (max(int(scale * side), 1) for side in box.shape[:2])
    x, y = (size - width) // 2, (size - height) // 2
    framed = np.zeros((size, size, 4), np.float32)
    framed[y : y + height, x : x + width] = _resized(box, height, width)
    return _from_eight_bit(framed), Square(left - x / scale, top - y / scale, size / scale)


def whole_frame_as_wonder3d(image: np.ndarray, size: int) -> np.ndarray:
    """Pad image (h, w, 4) to a square and resize it to (size, size, 4), as Wonder3D's data set does with crop_size -1.

    The kinds of image are those of frame_as_wonder3d().
    """
    h, w = image.shape[:2]
    side = max(h, w)
    square = np.zeros((side, side, 4), np.float32)
    top, left = (side - h) // 2, (side - w) // 2
    square[top : top + h, left : left + w] = _eight_bit(image)
    return _from_eight_bit(_resized(square, size, size))


def _eight_bit(image: np.ndarray) -> np.ndarray:
    """Convert linear color and straight alpha (…, 4) to sRGB and alpha in whole numbers 0 to 255, float32."""
    srgb = np.concatenate([srgb_from_linear(np.clip(image[..., :3], 0, 1)), np.clip(image[..., 3:], 0, 1)], -1)
    return np.rint(255 * srgb).astype(np.float32)


def _from_eight_bit(pixels: np.ndarray) -> np.ndarray:
    """Convert sRGB and alpha (…, 4), 0 to 255, to linear color and straight alpha, float32."""
    unit = pixels.astype(np.float32) / 255
    return np.concatenate([linear_from_srgb(unit[..., :3]), unit[..., 3:]], -1).astype(np.float32)


def _resized(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize pixels (h, w, 4), 0 to 255, as Pillow does."""
    import torch

    from gdtool.diffusion.network.eight_bit import resize_rgba

    return resize_rgba(torch.from_numpy(np.ascontiguousarray(pixels)), height, width).numpy()
