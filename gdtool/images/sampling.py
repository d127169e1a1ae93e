"""Look up pixel values at positions between pixel centres."""

from __future__ import annotations

import numpy as np


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Interpolate an image (h, w, c) bilinearly at pixel positions (n, 2); returns (n, c) float32.

    Positions are (x, y) with pixel centres at + 0.5. Beyond the border the border pixels are repeated.
    """
    h, w, c = image.shape
    flat = image.reshape(h * w, c)
    x = np.clip(pixels[:, 0] - 0.5, 0, w - 1.000001)
    y = np.clip(pixels[:, 1] - 0.5, 0, h - 1.000001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
    corner = row * w + column
    return (flat[corner] * (1 - fx) + flat[corner + 1] * fx) * (1 - fy) + (
        flat[corner + w] * (1 - fx) + flat[corner + w + 1] * fx
    ) * fy
