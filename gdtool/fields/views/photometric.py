"""Constrain depth by color: a point has the same color in all views that see it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, project, rays
from gdtool.fields.views.prepared_view import pixel_footprint
from gdtool.images.sampling import bilinear

BLUR = 0.05  # blur of the colors per unit of surface error; sharper colors have misleading slopes at a distance
LEAST_NOISE = 0.02  # linear color: least noise that is assumed between views
_STEP = 1e-3  # world units: step of a projection's numerical derivative
_GAIN = 2.0  # largest ratio of brightness between two views


@dataclass(frozen=True)
class Picture:
    """Hold a view's colors (h, w, 3), blurred inside its mask, and their slopes per pixel along x and y."""

    camera: Camera
    color: np.ndarray
    across: np.ndarray
    down: np.ndarray

    @classmethod
    def of(cls, camera: Camera, image: np.ndarray, mask: np.ndarray, reach: float) -> Picture:
        """Blur image (h, w, 3), linear, within mask (h, w). reach: world units by which surfaces may be off."""
        from scipy.ndimage import gaussian_filter

        pixels = BLUR * reach / float(pixel_footprint(camera, float(np.linalg.norm(camera.position))))
        cover = (mask > 0.9).astype(np.float32)
        share = np.maximum(gaussian_filter(cover, pixels), 1e-6)
        color = np.stack([gaussian_filter(image[..., c] * cover, pixels) / share for c in range(3)], -1)
        down, across = np.gradient(color, axis=(0, 1))
        return cls(camera, color, across, down)


def color_equations(
    points: np.ndarray, here: np.ndarray, there: np.ndarray, first: Picture, second: Picture, trust: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linearise how a view's depth has to change for its points to have the colors that another view shows.

    points (n, 3): shown by the first view at pixels `here` (n, 2), projected to pixels `there` (n, 2) of the second.
    trust (n,). Returns the slope (n,) of the color difference per world unit of the first view's depth, the difference
    (n,) to remove, and weights (n,): one over the variance of the two views' color differences, less for outliers. Each
    channel may have a gain and an offset between the views.
    """
    color_here, color_there = bilinear(first.color, here), bilinear(second.color, there)
    _, direction = rays(first.camera, here)
    farther = points + _STEP * direction / np.maximum(-(direction @ first.camera.backward), 1e-9)[:, None]
    moved = (project(second.camera, farther)[0] - there) / _STEP
    slope = bilinear(second.across, there) * moved[:, :1] + bilinear(second.down, there) * moved[:, 1:]
    weight = trust
    for _ in range(3):
        difference = color_there - np.stack(
            [_matched(x, y, weight) for x, y in zip(color_here.T, color_there.T, strict=True)], -1
        )
        # 1.5: from a median to a standard deviation.
        noise = max(1.5 * float(np.median(np.abs(difference))), LEAST_NOISE)
        weight = trust / (1 + (difference**2).mean(1) / (2 * noise) ** 2) ** 2
    size = np.linalg.norm(slope, axis=1)
    return size, (slope * difference).sum(1) / np.maximum(size, 1e-9), weight / noise**2


def _matched(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Apply to x (n,) the gain and offset that bring it nearest to y (n,)."""
    total = max(float(weight.sum()), 1e-12)
    from_x, from_y = x - (weight * x).sum() / total, y - (weight * y).sum() / total
    gain = (weight * from_x * from_y).sum() / max(float((weight * from_x**2).sum()), 1e-12)
    return y - from_y + np.clip(gain, 1 / _GAIN, _GAIN) * from_x
