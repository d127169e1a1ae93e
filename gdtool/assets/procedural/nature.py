"""Make plants and rocks: mushrooms, trees, potted plants, boulders, crystals. The family includes food.py."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import colors, finishes, patterns, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.colors import hsv
from gdtool.assets.procedural.food import bread, burger, cake, chili, fruit, icecream
from gdtool.assets.procedural.parts import (
    ball,
    circle,
    cylinder,
    loft,
    product,
    refined,
    smooth_curve,
    subdivided,
    tube,
)


def mushroom(rng: np.random.Generator) -> Assembly:
    """Make one to three mushrooms; the first may be a house with door and windows."""
    a = Assembly()
    count = int(rng.choice([1, 1, 2, 3]))
    cap = (
        finishes.spotted(
            np.random.default_rng(rng.integers(2**32)),
            hsv(rng.choice([0.0, 0.03, 0.08, 0.75]), 0.8, 0.7),
            hsv(0.1, 0.1, 0.95),
        )
        if rng.uniform() < 0.5
        else tiles.pick(rng, "skin")
    )
    stalk = finishes.matte(rng, hsv(0.11, rng.uniform(0.05, 0.35), rng.uniform(0.7, 0.95)))
    for k in range(count):
        s = 1.0 if k == 0 else rng.uniform(0.4, 0.65)
        x, z = (0.0, 0.0) if k == 0 else (rng.choice([-1, 1]) * rng.uniform(0.4, 0.55), rng.uniform(-0.2, 0.3))
        r, tall, stem, dome = (
            rng.uniform(0.4, 0.6),
            rng.uniform(0.45, 0.8),
            rng.uniform(0.12, 0.26),
            rng.uniform(0.3, 0.6),
        )
        curve = smooth_curve([(stem * 1.35, 0.02), (stem, tall * 0.5), (stem * 0.9, tall)], 14)
        a.add(
            loft(np.vstack([(0, 0), (stem * 1.2, 0), curve, (0, tall + 0.02)]), circle(36)).scaled(s).moved(x, 0, z),
            stalk,
        )
        t = np.linspace(0, np.pi / 2, 18)
        top = np.stack([r * np.cos(t) ** rng.uniform(0.7, 1.3), tall + dome * np.sin(t)], -1)
        top[-1, 0] = 0
        part = loft(
            np.vstack([(0, tall + 0.05), (stem, tall + 0.03), (r * 0.8, tall - 0.05), (r * 0.97, tall - 0.05), top]),
            circle(52),
        )
        a.add(part.scaled(s).moved(x, 0, z), cap)
        if k == 0 and rng.uniform() < 0.35:
            a.add(
                solids.polygonised(
                    solids.block((0, tall * 0.28, stem * 1.1), (stem * 0.4, tall * 0.26, 0.05), 0.04), 26
                ),
                tiles.pick(rng, "wood"),
            )
            a.add_pair(
                cylinder(0.07, 0.05).turned("x", 70).moved(r * 0.35, tall + dome * 0.45, r * 0.7),
                finishes.glossy(rng, hsv(0.14, 0.6, 0.95)),
            )
    if rng.uniform() < 0.4:
        a.add(ball(0.75, 0.09, 0.65, 40), tiles.pick(rng, "skin", colors.leaf_green(rng)))
    return a


def tree(rng: np.random.Generator) -> Assembly:
    """Make a conifer, a leafy tree or a palm."""
    a, bark, leaf = (
        Assembly(),
        tiles.pick(rng, "wood", hsv(0.07, 0.5, rng.uniform(0.2, 0.5))),
        tiles.pick(
            rng, "skin", colors.leaf_green(rng) if rng.uniform() < 0.75 else hsv(rng.uniform(0, 0.15), 0.8, 0.7)
        ),
    )
    tall, kind = rng.uniform(0.6, 0.9), rng.integers(3)
    a.add(cylinder(0.13, tall, top_radius=0.07, count=24).moved(y=tall / 2), bark)
    if kind == 0:
        y, r = 0.3, rng.uniform(0.4, 0.55)
        for _ in range(int(rng.integers(3, 6))):
            star = circle(48) * (1 + 0.08 * np.sin(9 * 2 * np.pi * np.arange(48) / 48))[:, None]
            a.add(
                loft(refined([(0, 0.08), (r, 0), (r, 0.03), (0.02, r * 1.1), (0, r * 1.1)], 0.1), star).moved(y=y), leaf
            )
            y, r = y + r * 0.55, r * 0.78
    elif kind == 1:
        bump, blobs = (
            patterns.noise_field(rng, 1.6, 1.5),
            [solids.ellipsoid((0, tall + 0.2, 0), rng.uniform(0.35, 0.45))],
        )
        for _ in range(int(rng.integers(3, 9))):
            d = rng.normal(size=3) * np.array([1, 0.6, 1])
            blobs.append(
                solids.ellipsoid(np.array([0, tall + 0.22, 0]) + 0.35 * d / np.linalg.norm(d), rng.uniform(0.2, 0.32))
            )
        crown = solids.blended(blobs, 0.06)
        a.add(solids.polygonised(lambda p: crown(p) + np.float32(0.02) * bump(p), 54, 1.9), leaf)
    else:
        top, count = tall * 1.2, int(rng.integers(5, 10))
        a.add(cylinder(0.07, tall * 0.6, top_radius=0.05, count=20).moved(y=tall * 0.95), bark)
        t = np.linspace(0, 1, 14)
        flat = circle(14) * np.array([0.2, 1.0])
        for k in range(count):
            path = np.stack([0.65 * t, top + 0.25 * np.sin(2.6 * t) - 0.2 * t**2, 0 * t], -1)
            a.add(
                tube(path, 0.1 * np.sin(np.pi * (0.08 + 0.88 * t)) + 0.01, outline=flat).turned("y", 360 * k / count),
                leaf,
            )
        for k in range(3):
            a.add(
                ball(0.07, count=18).moved(0.1, top - 0.06, 0).turned("y", 120 * k),
                tiles.pick(rng, "skin", hsv(0.08, 0.6, 0.35)),
            )
    if rng.uniform() < 0.5:
        a.add(ball(0.5, 0.07, 0.5, 36), finishes.matte(rng, colors.leaf_green(rng)))
    return a


def potted(rng: np.random.Generator) -> Assembly:
    """Make a pot with a cactus, flowers or leaves."""
    a, r, h = Assembly(), rng.uniform(0.24, 0.36), rng.uniform(0.3, 0.5)
    pot = tiles.pick(rng, "ceramic", hsv(0.05, 0.65, 0.7) if rng.uniform() < 0.4 else None)
    a.add(
        loft(
            refined(
                [
                    (0, 0),
                    (r * 0.7, 0),
                    (r, h * 0.85),
                    (r * 1.12, h * 0.85),
                    (r * 1.12, h),
                    (r * 0.95, h),
                    (r * 0.92, h - 0.06),
                    (0, h - 0.06),
                ],
                0.06,
            ),
            circle(44),
        ),
        pot,
    )
    a.add(cylinder(r * 0.93, 0.04).moved(y=h - 0.05), tiles.grained(rng, hsv(0.07, 0.5, 0.25)))
    kind, green = rng.integers(3), tiles.pick(rng, "skin", colors.leaf_green(rng))
    if kind == 0:
        ribs = circle(90) * (1 - 0.12 * np.abs(np.cos(7.5 * 2 * np.pi * np.arange(90) / 90)))[:, None]
        tall = rng.uniform(0.4, 0.9)
        t = np.linspace(-np.pi / 2, np.pi / 2, 18)
        stem = np.stack([np.cos(t) ** 0.6, 0.5 + 0.5 * np.sin(t)], -1)
        stem[[0, -1], 0] = 0
        a.add(loft(stem * np.array([r * 0.62, tall]), ribs, crease_degrees=60).moved(y=h - 0.06), green)
        if rng.uniform() < 0.5:
            arm = np.array([(0, 0, 0), (0.3, 0.03, 0), (0.36, 0.12, 0), (0.36, 0.36, 0)])
            a.add_pair(tube(arm, 0.09, outline=circle(22)).moved(r * 0.3, h + tall * 0.35, 0), green)
        a.add(ball(0.08, 0.06, None, 20).moved(y=h + tall - 0.05), finishes.plastic(rng))
    else:
        petals = finishes.plastic(rng)
        for k in range(int(rng.integers(4, 10))):
            w, lean, tall = 2 * np.pi * k / 7 + rng.uniform(-0.3, 0.3), rng.uniform(0.05, 0.4), rng.uniform(0.35, 0.7)
            t = np.linspace(0, 1, 12)
            path = np.stack([lean * t**1.5 * np.cos(w), h - 0.06 + tall * t, lean * t**1.5 * np.sin(w)], -1)
            if kind == 1:
                a.add(tube(path, 0.018, outline=circle(8)), green)
                x, y, z = path[-1]
                a.add(ball(0.055, count=16).moved(x, y, z), finishes.plastic(rng, hsv(0.13, 0.8, 0.9)))
                for p in range(6):
                    a.add(
                        ball(0.08, 0.02, 0.045, 14).moved(0.1).turned("y", 60 * p).turned("x", 50).moved(x, y, z),
                        petals,
                    )
            else:
                a.add(
                    tube(
                        path,
                        0.09 * np.sin(np.pi * (0.1 + 0.88 * t)) + 0.008,
                        outline=circle(14) * np.array([0.25, 1.0]),
                    ),
                    green,
                )
    return a


def rock(rng: np.random.Generator) -> Assembly:
    """Make a boulder or a cluster of crystals."""
    a = Assembly()
    if rng.uniform() < 0.5:
        bump, cuts = patterns.noise_field(rng, 0.7, 3.0), rng.normal(size=(9, 3))
        cuts = (cuts / np.linalg.norm(cuts, axis=1, keepdims=True)).astype(np.float32)
        offset = rng.uniform(0.45, 0.75, 9).astype(np.float32)
        a.add(
            solids.polygonised(
                lambda p: (
                    (product(p, cuts) - offset).max(axis=1) * np.float32(0.7)
                    + np.float32(0.3) * (np.linalg.norm(p, axis=1) - 0.65)
                    + np.float32(0.03) * bump(p)
                ),
                58,
            ),
            tiles.pick(rng, "stone"),
        )
        return a
    crystal = (
        finishes.glossy(rng, hsv(rng.uniform(), rng.uniform(0.4, 0.9), rng.uniform(0.5, 0.95)))
        if rng.uniform() < 0.6
        else finishes.gradient(np.random.default_rng(rng.integers(2**32)))
    )
    for k in range(int(rng.integers(1, 8))):
        r, tall = rng.uniform(0.1, 0.2), rng.uniform(0.5, 1.2)
        gem = loft(
            refined([(0, 0), (r * 0.8, 0), (r, tall * 0.7), (0.01, tall), (0, tall * 1.002)], 0.1),
            subdivided(circle(6), 4),
            crease_degrees=25,
        )
        a.add(gem.turned("z", 0 if k == 0 else rng.uniform(15, 50)).turned("y", rng.uniform(0, 360)), crystal)
    a.add(ball(0.4, 0.16, 0.4, 30), tiles.pick(rng, "stone"))
    return a


KINDS = {
    "mushroom": mushroom,
    "bread": bread,
    "fruit": fruit,
    "chili": chili,
    "cake": cake,
    "icecream": icecream,
    "burger": burger,
    "tree": tree,
    "potted": potted,
    "rock": rock,
}
