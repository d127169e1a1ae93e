"""Make environment lights by formula: three bundled ones, and random studios of spherical Gaussians."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gdtool.shading.lights.environment import Environment
from gdtool.shading.sampling import fibonacci

BUNDLED = ("dark", "mid", "bright")
LOBE_COUNT = 16  # lobes of a fitted or random light, as in the paper


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """Convert azimuth and elevation in degrees to a unit direction (3,); azimuth 0 is +Z, 90 is +X, as for cameras."""
    a, e = np.radians(azimuth), np.radians(elevation)
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


class Softbox(NamedTuple):
    """Describe a rectangular lamp in the sky.

    azimuth, elevation: its middle, in degrees. half_width, half_height: in radians. softness: tangent of the angle over
    which its edge fades out. color: linear radiance.
    """

    azimuth: float
    elevation: float
    half_width: float
    half_height: float
    softness: float
    color: tuple[float, float, float]


def _add_softboxes(image: np.ndarray, directions: np.ndarray, boxes: list[Softbox]) -> None:
    """Add softboxes to a radiance image (h, w, 3) in place; directions (h, w, 3) are those of its pixels."""
    for box in boxes:
        forward = direction(box.azimuth, box.elevation)
        right = np.cross((0.0, 1.0, 0.0), forward)
        right /= np.linalg.norm(right)
        up = np.cross(forward, right)
        depth = directions @ forward
        x = np.abs(directions @ right) / np.maximum(depth, 1e-6) - np.tan(box.half_width)
        y = np.abs(directions @ up) / np.maximum(depth, 1e-6) - np.tan(box.half_height)
        inside = np.clip(0.5 - np.maximum(x, y) / box.softness, 0, 1) * (depth > 0)
        image += inside[..., None] * np.asarray(box.color)


@lru_cache(maxsize=3)
def bundled(name: str) -> Environment:
    """Make a bundled light of 256 x 512 pixels.

    dark: a night with a few lamps; mid: a photographer's studio; bright: a clear day with the sun.
    """
    canvas = Environment(np.zeros((256, 512, 3)))
    d = canvas.directions
    up = d[..., 1:2]
    image = np.zeros_like(d)
    if name == "dark":
        image += np.where(up > 0, 0.006 + 0.01 * np.exp(-6 * up), 0.008) * np.array([0.7, 0.85, 1.2])
        image += 0.03 * np.exp(-((up / 0.08) ** 2)) * np.array([1.3, 0.9, 0.6])
        _add_softboxes(
            image,
            d,
            [
                Softbox(35, 32, 0.10, 0.10, 0.04, (26, 19, 11)),
                Softbox(-70, 22, 0.07, 0.16, 0.04, (9, 12, 20)),
                Softbox(150, 40, 0.09, 0.05, 0.03, (16, 12, 8)),
                Softbox(-140, 12, 0.25, 0.04, 0.03, (3, 2, 4)),
            ],
        )
    elif name == "mid":
        image += (0.16 + 0.10 * np.maximum(up, 0) + 0.05 * up) * np.array([1.0, 0.98, 0.95])
        _add_softboxes(
            image,
            d,
            [
                Softbox(45, 35, 0.38, 0.38, 0.10, (7.0, 6.8, 6.4)),
                Softbox(-60, 15, 0.25, 0.55, 0.10, (1.9, 2.1, 2.5)),
                Softbox(165, 45, 0.55, 0.16, 0.08, (3.2, 3.2, 3.4)),
                Softbox(0, 80, 0.45, 0.45, 0.20, (1.5, 1.5, 1.5)),
            ],
        )
    elif name == "bright":
        sky = np.maximum(up, 0) ** 0.5
        image += np.where(
            up > 0,
            (1 - sky) * np.array([1.15, 1.2, 1.25]) + sky * np.array([0.30, 0.55, 1.05]),
            np.array([0.32, 0.29, 0.25]) * (0.6 + 0.4 * np.exp(8 * np.minimum(up, 0))),
        )
        _add_softboxes(image, d, [Softbox(55, 48, 0.035, 0.035, 0.02, (700, 640, 560))])
        glow = np.maximum(d @ direction(55, 48), 0)[..., None]
        image += 1.6 * glow**60 * np.array([1.0, 0.95, 0.85])
    else:
        raise ValueError(f"no bundled light is called {name!r}")
    return Environment(image.astype(np.float32), name)


def random_lobes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw a random studio of 16 lobes: axes (16, 3), sharpness (16,), amplitudes (16, 3).

    Eight broad lobes are the room, tinted and brighter above. The other eight are lamps, of which two to eight are on;
    one that is off has amplitude 0.
    """
    room = fibonacci(8)
    tint = np.exp(rng.normal(0, 0.15, (8, 3)))
    level = 0.35 * np.exp(rng.normal(0, 0.5, (8, 1))) * (0.55 + 0.45 * room[:, 1:2])
    lamps = int(rng.integers(2, 9))
    # The key light stands on the camera's side, as photographers place it; the others anywhere but far below.
    azimuth = np.concatenate([rng.uniform(-80, 80, 1), rng.uniform(-180, 180, 7)])
    elevation = np.concatenate([rng.uniform(5, 65, 1), rng.uniform(-25, 80, 7)])
    axes = np.stack([direction(a, e) for a, e in zip(azimuth, elevation, strict=True)])
    sharpness = np.exp(rng.uniform(np.log(6), np.log(250), 8))
    power = np.exp(rng.normal(0, 0.6, 8)) * np.concatenate([[2.2], np.full(7, 0.8)]) * (np.arange(8) < lamps)
    warmth = np.exp(rng.normal(0, 0.18, (8, 1)) * np.array([1.0, 0.1, -1.0]))
    # Power is a lamp's irradiance: at the same power, a sharper lobe has a larger amplitude.
    amplitude = power[:, None] * warmth * sharpness[:, None] / (2 * np.pi)
    return (
        np.concatenate([room, axes]),
        np.concatenate([np.full(8, 3.0), sharpness]),
        np.concatenate([level * tint, amplitude]),
    )


def rasterise_lobes(
    axes: np.ndarray, sharpness: np.ndarray, amplitudes: np.ndarray, height: int, name: str = ""
) -> Environment:
    """Evaluate k lobes at the pixels of a lat-long image of height rows and 2 height columns.

    axes (k, 3) unit, sharpness (k,), amplitudes (k, 3) linear radiance.
    """
    d = Environment(np.zeros((height, 2 * height, 3))).directions
    image = np.zeros_like(d)
    for axis, s, amplitude in zip(axes, sharpness, amplitudes, strict=True):
        if amplitude.any():
            image += np.exp(s * (d @ axis - 1))[..., None] * amplitude
    return Environment(image.astype(np.float32), name)
