"""Disturb training pictures the way photographs are: exposure, white balance, blur, noise, JPEG, and rough cut-outs."""

from __future__ import annotations

import numpy as np

from gdtool.core.native import imported

SHARE = 0.8  # of the pictures that are disturbed at all; each disturbance then has a share of its own
# Standard deviations of log2 exposure, of log2 white balance by channel, and of log gamma.
EXPOSURE, BALANCE, GAMMA = 0.5, 0.15, 0.2
BLUR_SHARE, MAX_BLUR = 0.3, 1.2  # pixels, standard deviation
NOISE_SHARE, MAX_NOISE = 0.4, 0.06  # standard deviation of sRGB values
JPEG_SHARE, JPEG_QUALITIES = 0.3, (25, 90)
GREY_SHARE = 0.05  # of pictures without hue
RIM_SHARE, MAX_RIM = 0.4, 1.5  # pixels that the cut-out's edge is off by
RIM_SCALE = 6  # pixels over which that error changes along the edge


def disturb_picture(rgba: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Disturb a picture rgba (4, h, w), sRGB color times coverage and coverage, in [0, 1]; returns the same form."""
    if rng.random() > SHARE:
        return rgba
    cv2 = imported("cv2")
    coverage = rgba[3]
    color: np.ndarray = np.ascontiguousarray(
        np.moveaxis(rgba[:3], 0, -1) / np.maximum(coverage, 1e-3)[..., None], np.float32
    )
    gain: np.ndarray = 2.0 ** (rng.normal(0, EXPOSURE) + rng.normal(0, BALANCE, 3))
    color = np.clip(color.clip(0, 1) ** np.exp(rng.normal(0, GAMMA)) * gain ** (1 / 2.2), 0, 1)
    if rng.random() < GREY_SHARE:
        color = np.repeat(color.mean(-1, keepdims=True), 3, -1)
    if rng.random() < RIM_SHARE:
        coverage = _rough_outline(coverage, rng)
    if rng.random() < BLUR_SHARE:
        sigma = rng.uniform(0.3, MAX_BLUR)
        weight = cv2.GaussianBlur(rgba[3], (0, 0), sigma)
        color = cv2.GaussianBlur(color * rgba[3][..., None], (0, 0), sigma) / np.maximum(weight, 1e-3)[..., None]
    if rng.random() < NOISE_SHARE:
        color = color + rng.normal(0, rng.uniform(0, MAX_NOISE), color.shape)
    if rng.random() < JPEG_SHARE:
        pixels = np.round(color.clip(0, 1) * 255).astype(np.uint8)
        quality = int(rng.integers(*JPEG_QUALITIES))
        _, packed = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
        color = cv2.imdecode(packed, cv2.IMREAD_COLOR).astype(np.float32) / 255
    color = color.clip(0, 1) * coverage[..., None]
    return np.concatenate([np.moveaxis(color, -1, 0), coverage[None]]).astype(np.float32)


def _rough_outline(coverage: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Move the outline of coverage (h, w) in or out by up to MAX_RIM pixels, by an amount that changes along it."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    inside = coverage > 0.5
    if inside.all() or not inside.any():
        return coverage
    distance = distance_transform_edt(inside) - distance_transform_edt(~inside)
    waves = gaussian_filter(rng.normal(size=coverage.shape), RIM_SCALE)
    waves = waves / max(float(np.abs(waves).max()), 1e-6) * rng.uniform(0, MAX_RIM)
    return np.clip(distance + waves + 0.5, 0, 1).astype(np.float32)
