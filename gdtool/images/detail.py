"""The fine detail of pictures, over the part of them that a mask covers."""

from __future__ import annotations

import numpy as np

DARK = 0.02  # linear: added before a logarithm is taken, so that noise in the dark is no detail
BAND, WINDOW = 3.0, 6.0  # pixels: wavelengths that gains are told from, and the Gaussian window they are taken over
FLOOR = 1e-3  # squared logarithms: less than this says nothing of a gain


def masked_mean(values: np.ndarray, mask: np.ndarray, width: float) -> np.ndarray:
    """Gaussian mean of values (h, w[, ...]) over the covered pixels around each; mask (h, w) in [0, 1], width in
    pixels."""
    from scipy.ndimage import gaussian_filter

    weight = np.asarray(mask, np.float64)
    aligned = (...,) + (None,) * (values.ndim - 2)
    sums = gaussian_filter(values * weight[aligned], (width, width) + (0,) * (values.ndim - 2))
    return sums / np.maximum(gaussian_filter(weight, width), 1e-6)[aligned]


def detail_gain(one: np.ndarray, other: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """How much of one's detail the other has too (h, w): the regression of the other's on it, around each pixel.

    Both (h, w, c), mask (h, w). Detail is what differs from the mean over BAND pixels.
    """
    fine, same = (x - masked_mean(x, mask, BAND) for x in (one, other))
    return masked_mean((fine * same).sum(-1), mask, WINDOW) / (masked_mean((fine * fine).sum(-1), mask, WINDOW) + FLOOR)


def guided(values: np.ndarray, guide: np.ndarray, mask: np.ndarray, width: float, least: float) -> np.ndarray:
    """values (h, w, c) as far as they are linear in guide (h, w, g), around each pixel of mask (h, w).

    The guided filter (He, Sun and Tang, "Guided Image Filtering", 2010) with Gaussian windows of width pixels. least:
    added to the guide's variances, so that a guide that hardly varies explains little."""
    mean, level = masked_mean(guide, mask, width), masked_mean(values, mask, width)
    variance = (
        masked_mean(guide[..., :, None] * guide[..., None, :], mask, width) - mean[..., :, None] * mean[..., None, :]
    )
    common = (
        masked_mean(guide[..., :, None] * values[..., None, :], mask, width) - mean[..., :, None] * level[..., None, :]
    )
    slope = np.linalg.solve(variance + least * np.eye(guide.shape[-1]), common)
    start = level - np.einsum("...g,...gc->...c", mean, slope)
    return np.einsum("...g,...gc->...c", guide, masked_mean(slope, mask, width)) + masked_mean(start, mask, width)
