"""Draw patterns: smooth random fields over points in space, and square tiling images of heights and labels."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gdtool.assets.procedural.parts import product

Field = Callable[[np.ndarray], np.ndarray]  # a function of points (n, 3)


def noise_field(rng: np.random.Generator, frequency: float, octaves: float = 2.0, waves: int = 28) -> Field:
    """Draw a smooth random function of points (n, 3), of about unit variance: a sum of `waves` sines.

    Their frequencies, in cycles per unit length, lie within `octaves` above `frequency`; higher ones are weaker in
    proportion.
    """
    direction = rng.normal(size=(waves, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ratio = 2.0 ** rng.uniform(0, octaves, waves)
    vectors = (2 * np.pi * frequency * ratio[:, None] * direction).astype(np.float32)
    phase = rng.uniform(0, 2 * np.pi, waves).astype(np.float32)
    weight = (1 / ratio).astype(np.float32)
    weight *= np.sqrt(2 / (weight**2).sum())
    return lambda points: product(np.sin(product(points.astype(np.float32), vectors) + phase), weight)


def cell_field(rng: np.random.Generator, count: int) -> Field:
    """Draw random sites in the unit box; returns a function of points (n, 3): distances (n, 2) to the nearest two."""
    from scipy.spatial import cKDTree

    tree = cKDTree(rng.uniform(-0.55, 0.55, (count, 3)))
    return lambda points: tree.query(points, k=2)[0]


def tile_grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u, to the right, and v, downward, of the texel centres of a tile: each (size, size) in (0, 1)."""
    axis = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(axis, axis)
    return u, v


def tile_noise(
    rng: np.random.Generator, size: int, low: float = 2, high: float = 64, slope: float = 1.5, stretch: float = 1.0
) -> np.ndarray:
    """Draw tiling noise (size, size) of unit variance, with power between `low` and `high` cycles per tile.

    slope: the exponent by which amplitude falls with frequency. stretch > 1 draws streaks along u.
    """
    fy, fx = np.fft.fftfreq(size, 1 / size)[:, None], np.fft.rfftfreq(size, 1 / size)[None]
    frequency = np.hypot(fx * stretch, fy)
    gain = np.where((frequency >= low) & (frequency <= high), np.maximum(frequency, 1e-9) ** -slope, 0)
    spectrum = gain * (rng.normal(size=gain.shape) + 1j * rng.normal(size=gain.shape))
    image = np.fft.irfft2(spectrum, s=(size, size))
    return image / max(image.std(), 1e-12)


class TileCells(NamedTuple):
    """Hold Voronoi cells, each (size, size): distances to the nearest and second nearest site, index of the nearest."""

    nearest: np.ndarray
    second: np.ndarray
    site: np.ndarray


def tile_cells(rng: np.random.Generator, size: int, count: int) -> TileCells:
    """Draw tiling Voronoi cells of `count` random sites."""
    from scipy.spatial import cKDTree

    u, v = tile_grid(size)
    sites = rng.uniform(0, 1, (count, 2)) % 1.0
    distance, index = cKDTree(sites, boxsize=1).query(np.stack([u, v], -1).reshape(-1, 2), k=2)
    return TileCells(*(column.reshape(size, size) for column in (distance[:, 0], distance[:, 1], index[:, 0])))


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    """Rise from 0 at `low` to 1 at `high` by a cubic."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def brick_cells(
    rng: np.random.Generator, size: int, rows: int, columns: int, gap: float, shift: float = 0.5, bevel: float = 0.06
) -> tuple[np.ndarray, np.ndarray]:
    """Draw running-bond bricks: height (size, size) in [0, 1], 0 in the joints, and a shade in [-1, 1] for each brick.

    gap: half the width of a joint; bevel: the width of a brick's rim; both in units of a row's height. shift: of every
    second row, in bricks.
    """
    u, v = tile_grid(size)
    row = np.floor(v * rows).astype(int)
    across = u * columns + shift * (row % 2)
    column = np.floor(across).astype(int) % columns
    fu, fv = across % 1, (v * rows) % 1
    edge = np.minimum(np.minimum(fu, 1 - fu) * rows / columns, np.minimum(fv, 1 - fv))
    shade = rng.uniform(-1, 1, (rows, columns))[row % rows, column]
    return smoothstep(gap, gap + bevel, edge), shade


def scratch_lines(rng: np.random.Generator, size: int, count: int) -> np.ndarray:
    """Draw straight scratches (size, size), one texel wide, of strengths in [0, 1], that wrap around the tile."""
    image = np.zeros((size, size), np.float32)
    for _ in range(count):
        length, angle = rng.uniform(0.05, 0.4), rng.uniform(0, np.pi)
        t = np.arange(0, length, 0.5 / size)
        u, v = rng.uniform(size=2)
        columns = ((u + t * np.cos(angle)) % 1 * size).astype(int) % size
        rows = ((v + t * np.sin(angle)) % 1 * size).astype(int) % size
        image[rows, columns] = np.maximum(image[rows, columns], rng.uniform(0.3, 1))
    return image


def normal_from_height(height: np.ndarray, strength: float) -> np.ndarray:
    """Compute the tangent-space normal map (size, size, 3) uint8 of a tiling height map.

    strength: what a height of 1 is in units of the tile's side. glTF convention: X toward increasing u (right), Y
    toward the top of the image.
    """
    size = height.shape[0]
    slope_u = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * (0.5 * size * strength)
    slope_down = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) * (0.5 * size * strength)
    normal = np.stack([-slope_u, slope_down, np.ones_like(height)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.round((normal * 0.5 + 0.5) * 255).astype(np.uint8)
