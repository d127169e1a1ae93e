"""Crop and centre a picture the way the rig's front camera frames an object."""

from __future__ import annotations

import numpy as np

from gdtool.cameras.camera import HALF_WIDTH

# The longest side of a normalised object in the front view, as a share of the image.
FRONT_EXTENT = 0.5 / HALF_WIDTH


def framed_side(image: np.ndarray, extent: float = FRONT_EXTENT) -> float:
    """Return the side, in the picture's pixels, of the square that frame() cuts out of image (h, w, 4)."""
    rows, columns = np.nonzero(image[..., 3] > 0.5)
    return float(max(np.ptp(rows), np.ptp(columns)) + 1) / extent


def frame(image: np.ndarray, size: int, extent: float = FRONT_EXTENT) -> np.ndarray:
    """Centre the subject's bounding box and scale its longest side to extent * size.

    Takes image (h, w, 4), linear color and straight alpha, float32, and returns (size, size, 4) of the same kind.
    Filters premultiplied values, so no background color leaks in.
    """

    rows, columns = np.nonzero(image[..., 3] > 0.5)
    top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
    side = framed_side(image, extent)
    return _resample(image, (left + right - side) / 2, (top + bottom - side) / 2, side, size)


def whole_frame(image: np.ndarray, size: int) -> np.ndarray:
    """Resample the whole picture (h, w, 4), padded with transparency to a square, to (size, size, 4)."""
    h, w = image.shape[:2]
    side = max(h, w)
    square = np.zeros((side, side, 4), np.float32)
    top, left = (side - h) // 2, (side - w) // 2
    square[top : top + h, left : left + w] = image
    return _resample(square, 0.0, 0.0, float(side), size)


def _resample(image: np.ndarray, x0: float, y0: float, side: float, size: int) -> np.ndarray:
    """Resample a square of the picture (h, w, 4) to (size, size, 4); pixels outside the picture are transparent.

    x0, y0: the square's left and top edge; side: its side; all in pixels of the picture.
    """
    import torch
    import torch.nn.functional as F

    h, w = image.shape[:2]
    premultiplied = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], -1)
    source = torch.from_numpy(np.ascontiguousarray(np.moveaxis(premultiplied, -1, 0), np.float32))[None]
    ratio = side / size
    if ratio > 1:  # an antialiased shrink to the result's pixel size, then a bilinear look-up that only shifts
        new = (max(round(h / ratio), 1), max(round(w / ratio), 1))
        source = F.interpolate(source, size=new, mode="bilinear", antialias=True, align_corners=False)
    centre = (np.arange(size) + 0.5) / size * side
    gx, gy = np.meshgrid((x0 + centre) / w * 2 - 1, (y0 + centre) / h * 2 - 1)
    grid = torch.from_numpy(np.stack([gx, gy], -1).astype(np.float32))[None]
    out = F.grid_sample(source, grid, mode="bilinear", padding_mode="zeros", align_corners=False)[0].numpy()
    alpha = out[3]
    color = np.where(alpha > 1e-4, out[:3] / np.maximum(alpha, 1e-4), 0)
    return np.moveaxis(np.concatenate([color, alpha[None]]), 0, -1).astype(np.float32)
