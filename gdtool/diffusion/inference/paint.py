"""Restore the picture's contrast in the albedo of the view that shows the picture.

The model reproduces the color of that view with all of its contrast, and the albedo with about half of it. Color
divided by albedo is light, which on a surface under distant light is a smooth function of the normal. So the albedo is
set to the color times a factor. Around each pixel the factor is the linear function of the normal that fits the model's
ratio of albedo to color best. That alone would turn highlights and shadows into paint. So the model's albedo
decides how far a detail of the color is paint: where the albedo lacks the detail, nothing is changed.
"""

from __future__ import annotations

import numpy as np

from gdtool.images.detail import DARK, detail_gain, guided, masked_mean

# Contrast of a detail in the model's albedo, relative to that in the color. Below LIGHT_CONTRAST the true albedo has
# hardly any of the detail, above PAINT_CONTRAST all of it; measured on held-out and real models.
LIGHT_CONTRAST, PAINT_CONTRAST = 0.3, 0.5
# Light is fitted as a linear function of the normal: width of the fit in pixels, and what is added to the normals'
# variance, so that normals which hardly vary explain little.
FIT_WIDTH_PX, MIN_NORMAL_VARIANCE = 6.0, 0.005


def restore_albedo_contrast(
    albedo: np.ndarray,
    color: np.ndarray,
    mask: np.ndarray,
    normal: np.ndarray | None = None,
    metallic: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Add to the albedo (h, w, 3) the painted detail that the color (h, w, 3) shows; both are linear, 0 to 1.

    mask (h, w): coverage. normal (h, w, 3): unit; without it light is assumed to vary over more pixels than the detail.
    metallic (h, w): pixels of metal are left as they are, since a metal's color is a reflection. Returns the new
    albedo, and how far each pixel (h, w) was changed, 0 to 1.
    """
    log_color, log_albedo = (np.log(np.clip(image, 0, None) + DARK, dtype=np.float64) for image in (color, albedo))
    gain = np.clip(
        (detail_gain(log_color, log_albedo, mask) - LIGHT_CONTRAST) / (PAINT_CONTRAST - LIGHT_CONTRAST), 0, 1
    )
    share = np.where(mask > 0, gain * gain * (3 - 2 * gain), 0) * (1 if metallic is None else 1 - metallic)
    if not share.any():
        return albedo, share
    factor = log_albedo - log_color
    factor = (
        masked_mean(factor, mask, FIT_WIDTH_PX / 2)
        if normal is None
        else guided(factor, normal.astype(np.float64), mask, FIT_WIDTH_PX, MIN_NORMAL_VARIANCE)
    )
    return np.clip(np.exp(log_albedo + share[..., None] * (log_color + factor - log_albedo)) - DARK, 0, 1).astype(
        np.float32
    ), share
