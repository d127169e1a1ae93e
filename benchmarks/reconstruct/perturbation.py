"""A seeded imitation of what is wrong with generated views: they are plausible one by one and do not fit one
another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.folders.views import Views


@dataclass(frozen=True)
class Perturbation:
    """How much is wrong, per view and independently of the other views.

    scale: of the depth about the object's centre, at most; warp: rms of a smooth change of depth, world units;
    normal_degrees: rms turn of the normals by a smooth field; mask_pixels: the mask is grown or shrunk by this;
    color: gain per channel at most, and half of it as offset; wavelength: of the smooth fields' Gaussian, as a share
    of the picture.
    """

    seed: int = 0
    wavelength: float = 1 / 8
    scale: float = 0.02
    warp: float = 0.01
    normal_degrees: float = 5.0
    mask_pixels: int = 1
    color: float = 0.05


def perturbed(views: Views, how: Perturbation) -> Views:
    """The views with every picture disturbed; cameras and light stay."""
    rng = np.random.default_rng(how.seed)
    images = {name: np.array(stack) for name, stack in views.images.items() if name != "closed_form"}
    masks = np.array(views.mask)
    for k, camera in enumerate(views.cameras):
        shape, cover = masks[k].shape, masks[k]
        if "depth" in images:
            centre = float(camera.position @ camera.backward)  # of the world's origin, along the axis
            height = (centre - images["depth"][k]) * (1 + rng.uniform(-how.scale, how.scale))
            images["depth"][k] = centre - height - how.warp * smooth_field(rng, shape, how.wavelength)
        if "normal" in images:
            turn = np.stack([smooth_field(rng, shape, how.wavelength) for _ in range(3)], -1)
            images["normal"][k] = turned(images["normal"][k], turn * np.radians(how.normal_degrees) / np.sqrt(3))
        masks[k], nearest = grown(cover, how.mask_pixels if rng.random() < 0.5 else -how.mask_pixels)
        for name, stack in images.items():
            if name in ("color", "albedo"):
                gain, offset = 1 + rng.uniform(-how.color, how.color, 3), rng.uniform(-how.color / 2, how.color / 2, 3)
                stack[k] = np.clip(stack[k] * gain + offset, 0, 1)
            inside = masks[k] > 0
            filled = stack[k][nearest[0], nearest[1]]
            stack[k] = np.where(inside if filled.ndim == 2 else inside[..., None], filled, 0)
    return Views(
        views.cameras, {n: s.astype(np.float32) for n, s in images.items()}, masks.astype(np.float32), views.light
    )


def smooth_field(rng: np.random.Generator, shape: tuple[int, int], wavelength: float) -> np.ndarray:
    """A smooth random image (h, w) of mean square 1 about its mean; it wraps around."""
    from scipy.ndimage import gaussian_filter

    field = gaussian_filter(rng.standard_normal(shape), wavelength * shape[1], mode="wrap")
    return field / field.std()


def turned(normal: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Vectors (h, w, 3) turned by rotation vectors (h, w, 3), radians (Rodrigues)."""
    angle = np.linalg.norm(rotation, axis=-1, keepdims=True)
    axis = rotation / np.maximum(angle, 1e-12)
    along = axis * (axis * normal).sum(-1, keepdims=True)
    return normal * np.cos(angle) + np.cross(axis, normal) * np.sin(angle) + along * (1 - np.cos(angle))


def grown(cover: np.ndarray, pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """The mask (h, w) grown (or, negative, shrunk) by pixels, and for each pixel the index (2, h, w) of the nearest
    one that the mask held before."""
    from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

    nearest = distance_transform_edt(cover <= 0.5, return_distances=False, return_indices=True)
    own = cover > 0
    nearest = np.where(own, np.indices(cover.shape), nearest)
    side = 2 * abs(pixels) + 1
    return (maximum_filter if pixels > 0 else minimum_filter)(cover, side), nearest
