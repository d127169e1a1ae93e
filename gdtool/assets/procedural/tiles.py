"""Define finishes of tiled images on the first UV set, most with a normal map, and draw finishes by theme."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import finishes, patterns
from gdtool.assets.procedural.colors import any_color, any_metal, hsv, near_color
from gdtool.assets.procedural.finishes import Finish, Look

SIZE = 256  # pixels along a side of a tile


def _tiled(
    name: str,
    color: np.ndarray,
    metallic: float,
    roughness: np.ndarray,
    height: np.ndarray | None,
    strength: float,
    tiles: float,
) -> Finish:
    """Make a finish of tiling maps; strength: the range of heights in units of a tile's side; tiles per unit length."""
    normal = None if height is None else patterns.normal_from_height(height, strength)
    roughness = np.broadcast_to(np.clip(roughness, 0.04, 1), (SIZE, SIZE))
    material = finishes.textured_material(name, np.clip(color, 0, 1), metallic, roughness, 0, "repeat", normal)
    return lambda shape: Look(material, None, tiles)


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Blend two colours or images by a weight (h, w)."""
    return np.asarray(a) * (1 - weight[..., None]) + np.asarray(b) * weight[..., None]


def bricks(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw bricks, ashlar or tiles with joints."""
    color = hsv(rng.uniform(0.0, 0.1), rng.uniform(0.1, 0.7), rng.uniform(0.35, 0.8)) if color is None else color
    rows, columns = [(6, 3), (8, 4), (4, 4), (5, 3)][rng.integers(4)]
    shift = 0.0 if rows == columns else 0.5
    height, shade = patterns.brick_cells(rng, SIZE, 2 * (rows // 2), columns, rng.uniform(0.02, 0.07), shift)
    grain = patterns.tile_noise(rng, SIZE, 4, 60, 1.2)
    brick = color * np.exp(rng.uniform(0.1, 0.35) * shade + 0.08 * grain)[..., None]
    joint = hsv(0.1, 0.1, rng.uniform(0.3, 0.85))
    glazed = rng.uniform() < 0.3
    roughness = 0.9 - height * (rng.uniform(0.5, 0.75) if glazed else 0.15)
    return _tiled(
        "bricks", _mix(joint, brick, height), 0.0, roughness, height + 0.03 * grain, 0.02, rng.uniform(1.2, 2.5)
    )


def planks(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw boards side by side, their grain along u or v."""
    color = hsv(rng.uniform(0.04, 0.11), rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.8)) if color is None else color
    height, shade = patterns.brick_cells(rng, SIZE, int(rng.integers(3, 7)), 1, 0.015, rng.uniform(0.2, 0.8), 0.03)
    grain = patterns.tile_noise(rng, SIZE, 3, 120, 1.0, stretch=9)
    wood = color * np.exp(0.25 * shade + 0.16 * grain)[..., None]
    image, relief = _mix(color * 0.15, wood, height), height + 0.06 * grain
    roughness = 0.75 + 0.05 * grain - rng.uniform(0, 0.3) * height
    if rng.uniform() < 0.6:
        image, relief, roughness = image.transpose(1, 0, 2), relief.T, roughness.T
    return _tiled("planks", image, 0.0, roughness, relief, 0.012, rng.uniform(1.0, 2.5))


def shingles(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw overlapping rounded tiles: roofs, scales, feathers."""
    color = any_color(rng) if color is None else color
    rows = 2 * int(rng.integers(3, 6))
    columns = rows // 2 + int(rng.integers(0, 3))
    u, v = patterns.tile_grid(SIZE)
    height, shade = np.zeros((SIZE, SIZE)), np.zeros((SIZE, SIZE))
    shades = rng.uniform(-1, 1, (rows, columns))
    for below in (1, 0):  # the row above overlaps the one below
        row = np.floor(v * rows).astype(int) - below
        fv = v * rows - np.floor(v * rows) + below
        across = u * columns + 0.5 * (row % 2)
        fu, column = across % 1 - 0.5, np.floor(across).astype(int) % columns
        inside = fv < 0.55 + 0.95 * np.sqrt(np.clip(0.25 - fu**2, 0, 1))
        height = np.where(inside, 0.25 + 0.5 * fv - 0.5 * fu**2, height)
        shade = np.where(inside, shades[row % rows, column], shade)
    image = color * np.exp(0.3 * shade + 0.9 * (height - 0.5))[..., None]
    return _tiled(
        "shingles", image, 0.0, np.full((SIZE, SIZE), rng.uniform(0.3, 0.85)), height, 0.03, rng.uniform(1.5, 3)
    )


def woven(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw cloth, wicker or carbon fibre: threads that pass over and under each other."""
    color = any_color(rng) if color is None else color
    other = near_color(rng, color, 0.4) if rng.uniform() < 0.6 else any_color(rng)
    count = 2 * int(rng.integers(5, 14))
    u, v = patterns.tile_grid(SIZE)
    over = ((np.floor(u * count) + np.floor(v * count)) % 2) == 0
    warp, weft = np.abs(np.sin(np.pi * u * count)), np.abs(np.sin(np.pi * v * count))
    height = np.where(
        over, weft * (0.6 + 0.4 * np.sin(np.pi * (u * count % 1))), warp * (0.6 + 0.4 * np.sin(np.pi * (v * count % 1)))
    )
    image = np.where(over[..., None], color, other) * (0.45 + 0.55 * height)[..., None]
    return _tiled(
        "weave", image, 0.0, np.full((SIZE, SIZE), rng.uniform(0.45, 0.95)), height, 0.3 / count, rng.uniform(1.5, 3)
    )


def tartan(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw the crossing stripes of cloth or paper."""
    color = any_color(rng) if color is None else color
    u, v = patterns.tile_grid(SIZE)
    image = np.broadcast_to(color, (SIZE, SIZE, 3)).copy()
    for _ in range(int(rng.integers(2, 4))):
        band, center, half = any_color(rng), rng.uniform(), rng.uniform(0.02, 0.14)
        for axis in (u, v):
            image = _mix(image, band, 0.5 * (np.abs((axis - center + 0.5) % 1 - 0.5) < half))
    grain = patterns.tile_noise(rng, SIZE, 30, 120, 0.5)
    return _tiled(
        "tartan", image, 0.0, np.full((SIZE, SIZE), rng.uniform(0.6, 0.95)), grain, 0.002, rng.uniform(1.2, 3)
    )


def hammered(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw metal with dents."""
    color = any_metal(rng) if color is None else color
    near = patterns.tile_cells(rng, SIZE, int(rng.integers(40, 160))).nearest
    roughness = rng.uniform(0.15, 0.4) + 0.04 * patterns.tile_noise(rng, SIZE, 4, 60)
    return _tiled(
        "hammered",
        np.broadcast_to(color, (SIZE, SIZE, 3)),
        1.0,
        roughness,
        near**2 / near.max() ** 2,
        0.012,
        rng.uniform(1, 2),
    )


def brushed(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw metal or lacquer with directional streaks, scratches and smudges."""
    is_metal = rng.uniform() < 0.7
    color = (any_metal(rng) if is_metal else any_color(rng)) if color is None else color
    streaks = patterns.tile_noise(rng, SIZE, 4, 128, 0.6, stretch=12)
    scratches = patterns.scratch_lines(rng, SIZE, int(rng.integers(10, 70)))
    smudge = patterns.tile_noise(rng, SIZE, 1, 6, 1.5)
    roughness = rng.uniform(0.15, 0.45) + 0.05 * streaks + 0.3 * scratches + 0.07 * smudge
    image = color * (1 + 0.05 * streaks - 0.15 * scratches)[..., None]
    return _tiled("brushed", image, float(is_metal), roughness, -scratches + 0.1 * streaks, 0.002, rng.uniform(0.8, 2))


def grained(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw leather, plaster, crust, felt or rock: bumps with darker pits."""
    color = any_color(rng) if color is None else color
    if rng.uniform() < 0.5:
        cells = patterns.tile_cells(rng, SIZE, int(rng.integers(150, 700)))
        height = patterns.smoothstep(0, 0.03, cells.second - cells.nearest)
        strength = 0.004
    else:
        height = 0.5 + 0.2 * patterns.tile_noise(rng, SIZE, 3, 100, rng.uniform(1.0, 2.0))
        strength = rng.uniform(0.004, 0.012)
    stain = patterns.tile_noise(rng, SIZE, 1, 8, 1.5)
    image = color * (np.exp(0.12 * stain) * (0.6 + 0.4 * np.clip(height, 0, 1.2)))[..., None]
    return _tiled("grained", image, 0.0, rng.uniform(0.5, 0.95) - 0.1 * height, height, strength, rng.uniform(0.8, 2))


def dotted(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw polka dots or a terrazzo of chips."""
    color, other = any_color(rng) if color is None else color, any_color(rng)
    if rng.uniform() < 0.5:
        count = int(rng.integers(2, 6))
        u, v = patterns.tile_grid(SIZE)
        distance = np.minimum(*(np.hypot((u * count + o) % 1 - 0.5, (v * count + o) % 1 - 0.5) for o in (0.0, 0.5)))
        weight = 1 - patterns.smoothstep(-0.02, 0.02, distance - rng.uniform(0.15, 0.28))
        image = _mix(color, other, weight)
    else:
        cells = patterns.tile_cells(rng, SIZE, 90)
        chips = np.array([any_color(rng) for _ in range(4)])[cells.site % 4]
        is_chip = (cells.site % 3 > 0).astype(float)
        weight = patterns.smoothstep(0.015, 0.025, cells.second - cells.nearest) * is_chip
        image = _mix(color, chips, weight)
    roughness = np.clip(rng.uniform(0.1, 0.6) + 0.2 * weight * rng.uniform(-1, 1), 0.05, 1)
    return _tiled("dots", image, 0.0, roughness, None, 0, rng.uniform(1, 2.5))


DIELECTRIC = (finishes.plastic, finishes.matte, finishes.glossy)
THEMES = {
    "any": (
        *DIELECTRIC,
        finishes.metal,
        finishes.banded,
        finishes.gradient,
        finishes.marble,
        finishes.blotched,
        finishes.spotted,
        finishes.crackled,
        finishes.chequered,
        finishes.wooden,
        finishes.worn_paint,
        finishes.rusty,
        finishes.topped,
        bricks,
        planks,
        shingles,
        woven,
        tartan,
        hammered,
        brushed,
        grained,
        dotted,
    ),
    "ceramic": (
        finishes.glossy,
        finishes.glossy,
        finishes.plastic,
        finishes.banded,
        finishes.gradient,
        finishes.marble,
        finishes.crackled,
        finishes.spotted,
        dotted,
        finishes.blotched,
        finishes.chequered,
    ),
    "metal": (
        finishes.metal,
        finishes.metal,
        hammered,
        brushed,
        finishes.rusty,
        finishes.worn_paint,
        finishes.worn_paint,
    ),
    "wood": (finishes.wooden, finishes.wooden, planks, finishes.matte, finishes.worn_paint),
    "fur": (
        finishes.matte,
        finishes.blotched,
        finishes.spotted,
        finishes.banded,
        finishes.gradient,
        grained,
        finishes.crackled,
        finishes.plastic,
        shingles,
    ),
    "skin": (finishes.matte, finishes.plastic, finishes.gradient, finishes.spotted, grained, finishes.blotched),
    "cloth": (woven, tartan, finishes.matte, grained, dotted, finishes.banded, finishes.matte),
    "wall": (bricks, bricks, finishes.matte, planks, grained, finishes.topped, finishes.crackled),
    "roof": (shingles, shingles, planks, bricks, finishes.topped, finishes.matte, finishes.metal),
    "paint": (
        finishes.plastic,
        finishes.glossy,
        finishes.worn_paint,
        finishes.worn_paint,
        finishes.gradient,
        brushed,
        finishes.metal,
    ),
    "stone": (grained, finishes.marble, finishes.matte, bricks, finishes.topped, finishes.crackled),
}


def pick(rng: np.random.Generator, theme: str = "any", color: np.ndarray | None = None) -> Finish:
    """Draw a finish of a theme, in the given colour if any; metals keep a metal's colour.

    The finish gets a random generator of its own, so that the details of a finish do not change what is drawn after it.
    """
    choices = THEMES[theme]
    chosen = choices[rng.integers(len(choices))]
    stream = np.random.default_rng(rng.integers(2**62))
    if color is not None and chosen in (finishes.metal, hammered, finishes.rusty):
        color = None  # a metal has a metal's colour
    return chosen(stream, color)
