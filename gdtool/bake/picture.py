"""Add fine detail to a view's albedo from the picture that the views were generated from.

The picture and the view show the same object, and the picture has the higher resolution. The method is high-pass
modulation with a local gain, as in pansharpening of satellite images (Vivone et al. 2015, "A Critical Comparison Among
Pansharpening Algorithms"). The picture divided by itself, blurred to the view's resolution, is a factor on the view's
albedo. The gain is the exponent of that factor: it is near 1 where the detail is paint, and near 0 where it is light.
It is found by local regression of the view's albedo on the picture, at the view's resolution; the albedo has no light
in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, project
from gdtool.images.detail import DARK, detail_gain
from gdtool.images.metrics import resized
from gdtool.images.sampling import bilinear

MAX_FACTOR = 4.0  # largest factor on the albedo; the smallest is its inverse


@dataclass(frozen=True)
class Picture:
    """Factors (h, w, 3) float32 on linear albedo, in the image frame of the view's camera.

    finer: the picture's resolution as a multiple of the view's.
    """

    factor: np.ndarray
    camera: Camera
    finer: int

    def at(self, points: np.ndarray) -> np.ndarray:
        """Interpolate the factors (n, 3) at points (n, 3) that the view sees."""
        return bilinear(self.factor, project(self.camera, points)[0] * self.finer)


def picture_of(image: np.ndarray, camera: Camera, albedo: np.ndarray) -> Picture:
    """Compute the factors on a view's albedo (h, w, 3) linear that an image (H, W, 4) of the same object adds.

    The image has linear color and straight alpha. H and W are the same whole multiple of h and w.
    """
    large, small = image.shape[:2], (camera.height, camera.width)
    weighted = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], -1)
    view = resized(weighted, *small)
    fine, coarse = (np.log(x[..., :3] / np.maximum(x[..., 3:], 1e-3) + DARK) for x in (weighted, resized(view, *large)))
    is_covered = (image[..., 3:] > 0.5) & (resized(view[..., 3:], *large) > 0.25)
    gain = np.clip(
        detail_gain(
            np.log(view[..., :3] / np.maximum(view[..., 3:], 1e-3) + DARK), np.log(albedo + DARK), view[..., 3]
        ),
        0,
        1,
    )
    gain = resized(gain, *large)
    factor = np.exp(np.clip(fine - coarse, -np.log(MAX_FACTOR), np.log(MAX_FACTOR)) * gain[..., None])
    return Picture(np.where(is_covered, factor, 1).astype(np.float32), camera, large[0] // small[0])
