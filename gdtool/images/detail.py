"""Measure and transfer the fine detail of pictures, within the part that a mask covers."""

from __future__ import annotations

import numpy as np

DARK = 0.02  # linear; added before a logarithm is taken, so that noise in dark parts does not count as detail
# Standard deviations in pixels: of the mean that detail is the difference from, and of the window that gains are
# measured in.
BAND, WINDOW = 3.0, 6.0
FLOOR = 1e-3  # squared logarithms of color; with less detail than this the gain goes to 0


def masked_mean(values: np.ndarray, mask: np.ndarray, width: float) -> np.ndarray:
    """Compute the Gaussian mean of values (h, w[, ...]) around each pixel, over covered pixels only.

    mask (h, w) in [0, 1]. width: standard deviation of the Gaussian, pixels.
    """
    from scipy.ndimage import gaussian_filter

    weight = np.asarray(mask, np.float64)
    aligned = (...,) + (None,) * (values.ndim - 2)
    sums = gaussian_filter(values * weight[aligned], (width, width) + (0,) * (values.ndim - 2))
    return sums / np.maximum(gaussian_filter(weight, width), 1e-6)[aligned]


def detail_gain(picture: np.ndarray, second: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Measure which share of a picture's detail a second picture has too, around each pixel; returns (h, w).

    picture, second (h, w, c), mask (h, w). Detail is the difference from the Gaussian mean of standard deviation BAND
    pixels. The share is the slope of the regression of the second picture's detail on the first's, in Gaussian windows
    of standard deviation WINDOW pixels.
    """
    fine, second_fine = (x - masked_mean(x, mask, BAND) for x in (picture, second))
    covariance = masked_mean((fine * second_fine).sum(-1), mask, WINDOW)
    return covariance / (masked_mean((fine * fine).sum(-1), mask, WINDOW) + FLOOR)


def guided(values: np.ndarray, guide: np.ndarray, mask: np.ndarray, width: float, least: float) -> np.ndarray:
    """Fit values (h, w, c) by a linear function of a guide (h, w, g) around each pixel of mask (h, w).

    This is the guided filter (He, Sun and Tang, "Guided Image Filtering", 2010) with Gaussian windows. width: their
    standard deviation in pixels. least: added to the guide's variances, in squared units of the guide, so that a guide
    that hardly varies explains little.
    """
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
