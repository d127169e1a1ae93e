"""Add features to the heads of creatures: eyes, muzzles, ears, horns, hats."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import colors, finishes, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.colors import hsv
from gdtool.assets.procedural.finishes import Finish
from gdtool.assets.procedural.parts import ball, circle, cone, cylinder, loft, refined, tube

Place = tuple[float, float, float]
BLACK = np.array([0.012, 0.011, 0.011])


def fur_color(rng: np.random.Generator) -> np.ndarray:
    """Draw the colour of an animal's coat, in a third of cases any colour, as toys have."""
    return (
        colors.any_color(rng)
        if rng.uniform() < 0.35
        else hsv(rng.uniform(0.02, 0.12), rng.uniform(0.05, 0.75), rng.uniform(0.2, 1.0) ** 0.7)
    )


def eyes(
    a: Assembly, rng: np.random.Generator, x: float, y: float, z: float, size: float, outward: float = 0.25
) -> None:
    """Add a pair of eyes at +x and -x: black beads, or eyeballs that look `outward` from +Z."""
    style = rng.uniform()
    finish = finishes.glossy(rng, BLACK) if style < 0.4 else finishes.gazing(rng, np.array([outward, 0.0, 1.0]))
    a.add_pair(ball(size, size * rng.uniform(0.9, 1.2), size * 0.8, 20).moved(x, y, z), finish)


def face(a: Assembly, rng: np.random.Generator, center: Place, r: float, coat: Finish, snout: float) -> None:
    """Add eyes, a muzzle of length `snout` relative to r, and a nose to a head of radius r at `center`."""
    x, y, z = center
    size = r * rng.uniform(0.14, 0.28)
    height = rng.uniform(0.1, 0.3)
    depth = np.sqrt(max(1 - 0.42**2 - height**2, 0.1)) * r
    eyes(a, rng, x + 0.42 * r, y + height * r, z + depth * 0.93, size)
    muzzle = tiles.pick(rng, "fur", colors.near_color(rng, fur_color(rng), 0.3)) if rng.uniform() < 0.5 else coat
    if snout > 0.05:
        a.add(ball(r * 0.42, r * 0.34, r * (0.3 + snout), 24).moved(x, y - 0.22 * r, z + 0.75 * r), muzzle)
    tip = z + r * (1.02 + snout if snout > 0.05 else 0.98)
    a.add(
        ball(r * 0.13, r * 0.1, r * 0.1, 16).moved(x, y - 0.12 * r, tip),
        finishes.glossy(rng, BLACK if rng.uniform() < 0.7 else hsv(0.97, 0.5, 0.7)),
    )


def ears(a: Assembly, rng: np.random.Generator, center: Place, r: float, coat: Finish) -> None:
    """Add a pair of pointed, round, long, hanging or wide ears to a head of radius r at `center`."""
    x, y, z = center
    kind = rng.integers(5)
    if kind == 0:  # pointed, as a cat's
        part = (
            cone(r * rng.uniform(0.28, 0.42), r * rng.uniform(0.6, 1.0), 20)
            .scaled(1, 1, 0.55)
            .turned("z", -22)
            .moved(x + 0.5 * r, y + 0.62 * r, z)
        )
    elif kind == 1:  # round, as a bear's
        size = r * rng.uniform(0.28, 0.42)
        part = ball(size, size, size * 0.45, 22).moved(x + 0.68 * r, y + 0.68 * r, z)
    elif kind == 2:  # long and upright, as a rabbit's
        part = (
            ball(r * 0.2, r * rng.uniform(0.7, 1.2), r * 0.12, 22)
            .turned("z", -rng.uniform(5, 25))
            .moved(x + 0.4 * r, y + 1.5 * r, z)
        )
    elif kind == 3:  # hanging, as a dog's
        part = (
            ball(r * 0.16, r * rng.uniform(0.45, 0.7), r * 0.3, 22).turned("z", 12).moved(x + 0.98 * r, y - 0.02 * r, z)
        )
    else:  # wide, as an elephant's
        part = ball(r * 0.75, r * 0.85, r * 0.12, 26).turned("y", 25).moved(x + 1.25 * r, y + 0.1 * r, z - 0.15 * r)
    a.add_pair(part, coat)


def horns(a: Assembly, rng: np.random.Generator, center: Place, r: float) -> None:
    """Add a pair of curved horns, or one straight horn, to a head of radius r at `center`."""
    x, y, z = center
    finish = (
        finishes.matte(rng, hsv(0.11, rng.uniform(0.1, 0.4), rng.uniform(0.3, 0.9)))
        if rng.uniform() < 0.7
        else tiles.pick(rng, "metal")
    )
    if rng.uniform() < 0.25:
        a.add(cone(r * 0.12, r * 0.9, 20).turned("x", 25).moved(x, y + 0.8 * r, z + 0.4 * r), finish)
        return
    t = np.linspace(0, 1, 14)
    curl = rng.uniform(-0.5, 0.8)
    path = np.stack([x + r * (0.4 + 0.5 * t), y + r * (0.75 + 0.8 * t - 0.2 * t**2), z + r * curl * t**2], -1)
    a.add_pair(tube(path, r * 0.16 * (1 - 0.85 * t)), finish)


def dress_head(a: Assembly, rng: np.random.Generator, center: Place, r: float, chance: float) -> None:
    """Add a pointed hat, a top hat, a crown, a cap or a scarf with probability `chance`."""
    if rng.uniform() > chance:
        return
    x, y, z = center
    kind, finish = rng.integers(5), tiles.pick(rng, "cloth")
    if kind == 0:
        a.add(cone(r * 0.7, r * 1.5, 32).moved(x, y + r * 0.7, z), finish)
        a.add(ball(r * 0.18, count=20).moved(x, y + r * 2.2, z), tiles.pick(rng, "cloth"))
    elif kind == 1:
        a.add(cylinder(r * 0.62, r * 0.9).moved(x, y + r * 1.2, z), finish)
        a.add(cylinder(r * 1.1, r * 0.1).moved(x, y + r * 0.8, z), finish)
    elif kind == 2:
        gold = finishes.metal(rng)
        a.add(cylinder(r * 0.6, r * 0.3, top_radius=r * 0.66).moved(x, y + r * 0.95, z), gold)
        for k in range(6):
            w = 2 * np.pi * k / 6 + np.pi / 6
            a.add(
                cone(r * 0.16, r * 0.4, 12).moved(x + r * 0.52 * np.cos(w), y + r * 1.05, z + r * 0.52 * np.sin(w)),
                gold,
            )
    elif kind == 3:
        half = refined([(0, 0), (1.04, 0), (1.0, 0.35), (0.75, 0.75), (0.4, 0.95), (0, 1.0)], 0.1)
        a.add(loft(half, circle(40)).scaled(r, r * 0.85, r).moved(x, y + 0.32 * r, z), finish)
    else:
        angle = 2 * np.pi * np.arange(40) / 40
        a.add(
            tube(
                np.stack([x + r * 0.85 * np.cos(angle), np.full(40, y - r * 0.85), z + r * 0.85 * np.sin(angle)], -1),
                r * 0.2,
                closed=True,
            ),
            finish,
        )
