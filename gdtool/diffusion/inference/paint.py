"""Restore the picture's contrast in the albedo of the view that shows it.

A model reproduces that view's color, which is the picture, whole, and about half of the albedo's contrast. Color over
albedo is light. On a surface under distant light it is a smooth function of the normal. So the albedo is set to the
color times a factor that is, around each pixel, as linear in the normal as the model's own. That alone would make paint
of highlights and shadows. The model tells how far the color's detail is paint: where its albedo lacks the detail,
nothing is changed.
"""

from __future__ import annotations

import numpy as np

from gdtool.images.detail import DARK, detail_gain, guided, masked_mean

# On held-out and real models: of detail whose gain is less in the model's albedo the true one has next to none, of what
# has more, all.
LIGHT, PAINT = 0.3, 0.5
# Pixels and squared normals: over which light is linear in the normal, and what says nothing of it.
WIDTH, LEAST = 6.0, 0.005


def repainted(
    albedo: np.ndarray,
    color: np.ndarray,
    mask: np.ndarray,
    normal: np.ndarray | None = None,
    metallic: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Add the paint that color (h, w, 3), linear, shows to the albedo (h, w, 3), linear.

    Also returns how far each pixel was changed (h, w), 0 to 1. mask (h, w) coverage; normal (h, w, 3) unit; metallic
    (h, w): a metal's color is a reflection, so it is not used. Without normals light is taken to be smoother than the
    detail.
    """
    log_color, log_albedo = (np.log(np.clip(image, 0, None) + DARK, dtype=np.float64) for image in (color, albedo))
    gain = np.clip((detail_gain(log_color, log_albedo, mask) - LIGHT) / (PAINT - LIGHT), 0, 1)
    share = np.where(mask > 0, gain * gain * (3 - 2 * gain), 0) * (1 if metallic is None else 1 - metallic)
    if not share.any():
        return albedo, share
    factor = log_albedo - log_color
    factor = (
        masked_mean(factor, mask, WIDTH / 2)
        if normal is None
        else guided(factor, normal.astype(np.float64), mask, WIDTH, LEAST)
    )
    return np.clip(np.exp(log_albedo + share[..., None] * (log_color + factor - log_albedo)) - DARK, 0, 1).astype(
        np.float32
    ), share
