"""Draw linear RGB colours as objects have them, and the reflectances of metals."""

from __future__ import annotations

import colorsys

import numpy as np

# Normal-incidence reflectance of metals, linear: measured optical constants as tabulated at physicallybased.info
METALS = {
    "gold": (1.0, 0.77, 0.31),
    "silver": (0.96, 0.95, 0.92),
    "copper": (0.93, 0.61, 0.49),
    "brass": (0.89, 0.74, 0.42),
    "bronze": (0.71, 0.53, 0.34),
    "aluminium": (0.91, 0.91, 0.92),
    "iron": (0.53, 0.51, 0.49),
    "chrome": (0.64, 0.65, 0.66),
    "titanium": (0.54, 0.50, 0.45),
    "nickel": (0.70, 0.64, 0.56),
    "steel": (0.60, 0.60, 0.62),
}


def hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """Convert a colour picked by eye, as sRGB hue, saturation and value in [0, 1], to linear RGB (3,)."""
    srgb = np.array(colorsys.hsv_to_rgb(hue % 1.0, float(np.clip(saturation, 0, 1)), float(np.clip(value, 0, 1))))
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def any_color(rng: np.random.Generator) -> np.ndarray:
    """Draw a linear colour as objects have it: vivid, muted, pastel, earthy, grey, dark or off-white."""
    kind = rng.choice(7, p=[0.26, 0.2, 0.13, 0.18, 0.08, 0.07, 0.08])
    hue = rng.uniform()
    if kind == 0:
        # No neon greens.
        return hsv(hue, rng.uniform(0.65, 0.92), rng.uniform(0.6, 0.95) * (0.75 if 0.2 < hue < 0.48 else 1.0))
    if kind == 1:
        return hsv(hue, rng.uniform(0.3, 0.6), rng.uniform(0.4, 0.8))
    if kind == 2:
        return hsv(hue, rng.uniform(0.12, 0.35), rng.uniform(0.85, 0.97))
    if kind == 3:
        return hsv(rng.uniform(0.02, 0.13), rng.uniform(0.35, 0.75), rng.uniform(0.3, 0.8))
    if kind == 4:
        return hsv(hue, rng.uniform(0, 0.08), rng.uniform(0.3, 0.75))
    if kind == 5:
        return hsv(hue, rng.uniform(0, 0.6), rng.uniform(0.1, 0.25))
    return hsv(rng.uniform(0.05, 0.18), rng.uniform(0.0, 0.12), rng.uniform(0.88, 0.97))


def near_color(rng: np.random.Generator, color: np.ndarray, amount: float = 0.5) -> np.ndarray:
    """Draw a darker or lighter variant of a linear colour; amount: the standard deviation of its logarithm."""
    factor = np.exp(rng.normal(0, amount))
    return np.clip(color * factor * np.exp(rng.normal(0, 0.15 * amount, 3)), 0.01, 0.95)


def any_metal(rng: np.random.Generator) -> np.ndarray:
    """Draw the linear reflectance (3,) of a metal."""
    return np.array(METALS[list(METALS)[rng.integers(len(METALS))]])


def leaf_green(rng: np.random.Generator) -> np.ndarray:
    """Draw the green of leaves."""
    return hsv(rng.uniform(0.2, 0.4), rng.uniform(0.4, 0.8), rng.uniform(0.25, 0.7))
