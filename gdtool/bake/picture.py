"""What the picture that views were made of adds to them: it is finer than the view that shows the same.

High-pass modulation with a local gain, by which satellites' sharp grey images sharpen their coarse colored ones (Vivone
et al., "A Critical Comparison Among Pansharpening Algorithms", 2015): what the picture has in finer pixels over what it
has in the view's is a factor on the view's albedo. How far it is paint and not light is told by the next coarser
detail: the gain is the regression of the view's albedo, whose light was taken out, on the picture, both at the view's
size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, project
from gdtool.images.detail import DARK, detail_gain
from gdtool.images.metrics import resized
from gdtool.images.sampling import bilinear

MOST = 4.0  # as a factor, and one over it the least


@dataclass(frozen=True)
class Picture:
    """factor (h, w, 3) float32, linear, in the frame of camera, the view's; finer: pixels of it across one of the
    view's."""

    factor: np.ndarray
    camera: Camera
    finer: int

    def at(self, points: np.ndarray) -> np.ndarray:
        """The factors (n, 3) at points (n, 3) that the view sees."""
        return bilinear(self.factor, project(self.camera, points)[0] * self.finer)


def picture_of(image: np.ndarray, camera: Camera, albedo: np.ndarray) -> Picture:
    """What image (H, W, 4), linear color and straight alpha, adds to a view's albedo (h, w, 3), linear, of camera.

    H and W are the same multiple of h and w; both show the same.
    """
    large, small = image.shape[:2], (camera.height, camera.width)
    weighted = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], -1)
    view = resized(weighted, *small)
    fine, coarse = (np.log(x[..., :3] / np.maximum(x[..., 3:], 1e-3) + DARK) for x in (weighted, resized(view, *large)))
    shown = (image[..., 3:] > 0.5) & (resized(view[..., 3:], *large) > 0.25)
    gain = np.clip(
        detail_gain(
            np.log(view[..., :3] / np.maximum(view[..., 3:], 1e-3) + DARK), np.log(albedo + DARK), view[..., 3]
        ),
        0,
        1,
    )
    gain = resized(gain, *large)
    factor = np.exp(np.clip(fine - coarse, -np.log(MOST), np.log(MOST)) * gain[..., None])
    return Picture(np.where(shown, factor, 1).astype(np.float32), camera, large[0] // small[0])
