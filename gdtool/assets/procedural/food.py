"""Make food: bread, fruit, peppers, cakes, ice cream, burgers, doughnuts."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import colors, finishes, patterns, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.colors import hsv
from gdtool.assets.procedural.parts import (
    ball,
    circle,
    cylinder,
    loft,
    refined,
    smooth_curve,
    tube,
)


def bread(rng: np.random.Generator) -> Assembly:
    """Make a loaf, a slice of toast or a seeded bun with a browned crust."""
    a = Assembly()
    crust = hsv(rng.uniform(0.06, 0.09), rng.uniform(0.55, 0.8), rng.uniform(0.45, 0.75))
    finish = (
        finishes.topped(np.random.default_rng(rng.integers(2**32)), hsv(0.1, 0.4, 0.85), crust)
        if rng.uniform() < 0.6
        else tiles.grained(rng, crust)
    )
    kind = rng.integers(3)
    if kind == 0:
        length, cuts = rng.uniform(0.55, 0.9), int(rng.integers(0, 6))
        loaf = (
            solids.ellipsoid((0, 0, 0), (length, 0.3, 0.34))
            if rng.uniform() < 0.5
            else solids.blended(
                [
                    solids.block((0, -0.05, 0), (length, 0.2, 0.3), 0.1),
                    solids.ellipsoid((0, 0.14, 0), (length * 1.02, 0.2, 0.34)),
                ],
                0.08,
            )
        )
        for x in np.linspace(-0.65, 0.65, cuts) * length:
            loaf = solids.carved(
                loaf, solids.turned(solids.ellipsoid((x, 0.34, 0), (0.05, 0.1, 0.26)), "y", 25, (x, 0, 0)), 0.04
            )
        bump = patterns.noise_field(rng, 1.5, 1.5)
        a.add(solids.polygonised(_bumpy(loaf, bump, 0.012), 60), finish)
    elif kind == 1:
        w, h, half = rng.uniform(0.42, 0.58), rng.uniform(0.4, 0.6), rng.uniform(0.08, 0.2)
        ear = rng.uniform(0.18, 0.3)
        outline = solids.blended(
            [
                solids.block((0, 0, 0), (w, h, 9.0), 0.06),
                *[solids.rod((x * w * 0.75, h * 0.85, 0), ear, 9.0, "z") for x in (1, -1)],
            ],
            0.08,
        )
        a.add(
            solids.polygonised(solids.common([outline, lambda p: np.abs(p[:, 2]) - half], 0.04), 52),
            tiles.grained(rng, crust),
        )
        crumb = solids.common(
            [lambda p: outline(p) + np.float32(0.05), lambda p: np.abs(p[:, 2]) - (half + 0.012)], 0.02
        )
        a.add(solids.polygonised(crumb, 46), tiles.grained(rng, hsv(0.11, 0.3, 0.97)))
    else:
        a.add(ball(0.6, 0.38, 0.58, 44), finish)
        seed = finishes.matte(rng, hsv(0.12, 0.25, 0.92))
        for _ in range(int(rng.integers(0, 40))):
            w, up = rng.uniform(0, 2 * np.pi), rng.uniform(0.4, 1.0)
            out = np.sqrt(1 - up**2)
            a.add(
                ball(0.03, 0.015, 0.018, 10)
                .turned("y", rng.uniform(0, 180))
                .moved(0.6 * out * np.cos(w), 0.385 * up, 0.58 * out * np.sin(w)),
                seed,
            )
    return a


def fruit(rng: np.random.Generator) -> Assembly:
    """Make an apple, pear, pumpkin, pepper, tomato or orange: a lathed body with lobes, a stalk and leaves."""
    a = Assembly()
    lobes, depth = int(rng.integers(3, 11)), rng.choice([0.0, 0.0, 0.06, 0.12])
    angle = 2 * np.pi * np.arange(96) / 96
    outline = circle(96) * (1 - depth * np.abs(np.cos(lobes * angle / 2)) ** 3)[:, None]
    tall, waist = rng.uniform(0.7, 1.3), rng.uniform(0.35, 0.75)
    top = rng.uniform(0.2, 0.55)
    curve = smooth_curve(
        [
            (0.06, 0.07),
            (0.3, 0.0),
            (0.52, tall * rng.uniform(0.3, 0.5)),
            (waist * 0.6, tall * 0.75),
            (top * 0.5, tall * 0.97),
            (0.05, tall * 0.9),
        ],
        40,
    )
    color = hsv(
        rng.choice([0.0, 0.02, 0.07, 0.11, 0.15, 0.22, 0.3, 0.85]), rng.uniform(0.65, 0.95), rng.uniform(0.55, 0.95)
    )
    skin = (
        finishes.gradient(np.random.default_rng(rng.integers(2**32)), color)
        if rng.uniform() < 0.4
        else tiles.pick(rng, "skin", color)
    )
    a.add(loft(np.vstack([(0, 0.09), curve, (0, tall * 0.88)]), outline), skin)
    stalk = finishes.matte(rng, hsv(rng.uniform(0.08, 0.3), 0.5, rng.uniform(0.2, 0.5)))
    lean = rng.uniform(-0.15, 0.15)
    a.add(
        tube(
            np.array([(0, tall * 0.85, 0), (lean * 0.4, tall + 0.05, 0), (lean, tall + 0.2, 0)]),
            np.array([0.055, 0.04, 0.05]),
        ),
        stalk,
    )
    leaf = finishes.plastic(rng, colors.leaf_green(rng))
    for k in range(int(rng.integers(0, 6))):
        a.add(
            ball(0.2, 0.02, 0.08, 20)
            .moved(0.2)
            .turned("z", rng.uniform(-10, 30))
            .turned("y", 72 * k + rng.uniform(-10, 10))
            .moved(0, tall * 0.95, 0),
            leaf,
        )
    return a


def chili(rng: np.random.Generator) -> Assembly:
    """Make one to three long, tapering, curved things: chili, carrot, banana, cucumber."""
    a = Assembly()
    color = hsv(rng.choice([0.0, 0.0, 0.06, 0.14, 0.3]), rng.uniform(0.75, 0.95), rng.uniform(0.55, 0.9))
    skin, green = (
        tiles.pick(rng, "skin", color) if rng.uniform() < 0.5 else finishes.glossy(rng, color),
        finishes.plastic(rng, colors.leaf_green(rng)),
    )
    bend, thick, taper = rng.uniform(-0.6, 0.6), rng.uniform(0.1, 0.2), rng.uniform(0.1, 1.0)
    t = np.linspace(0, 1, 30)
    for k in range(int(rng.choice([1, 1, 2, 3]))):
        path = np.stack([bend * np.sin(np.pi * t) * 0.6, 1.3 * (0.5 - t), 0.15 * np.sin(2 * np.pi * t)], -1)
        radius = thick * np.sqrt(np.clip(1 - (t * (1 - 0.15 * taper)) ** 3, 0.01, 1)) * (1 - 0.6 * taper * t)
        turn, dx = (0, 0) if k == 0 else (rng.uniform(-40, 40), rng.uniform(-0.3, 0.3))
        a.add(tube(path, radius, outline=circle(28)).turned("z", turn).moved(dx, 0, -0.25 * k), skin)
        a.add(
            ball(thick * 1.05, thick * 0.5, thick * 1.05, 22)
            .moved(0, 0.68, 0)
            .turned("z", turn)
            .moved(dx, 0, -0.25 * k),
            green,
        )
        a.add(
            tube(np.array([(0, 0.7, 0), (0.03, 0.85, 0), (0.1, 0.95, 0)]), np.array([0.05, 0.035, 0.045]))
            .turned("z", turn)
            .moved(dx, 0, -0.25 * k),
            green,
        )
    return a


def cake(rng: np.random.Generator) -> Assembly:
    """Make a layered cake, cupcake or pudding with icing, cherries and perhaps candles."""
    a, y, r = Assembly(), 0.0, rng.uniform(0.5, 0.65)
    icing, dough = (
        tiles.pick(rng, "skin"),
        tiles.pick(rng, "skin", hsv(0.09, rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.9))),
    )
    for k in range(int(rng.integers(1, 4))):
        h = rng.uniform(0.2, 0.4)
        a.add(cylinder(r, h, 0.03, 56).moved(y=y + h / 2), dough if k % 2 == 0 else icing)
        y += h
        drip = 1 + 0.02 * np.sin(11 * 2 * np.pi * np.arange(88) / 88)
        a.add(
            loft(
                refined(
                    [
                        (0, y - 0.03),
                        (r * 1.01, y - 0.1),
                        (r * 1.05, y - 0.06),
                        (r * 1.04, y + 0.02),
                        (r * 0.95, y + 0.05),
                        (0, y + 0.05),
                    ],
                    0.08,
                ),
                circle(88) * drip[:, None],
            ),
            icing,
        )
        y, r = y + 0.03, r * rng.uniform(0.6, 0.85)
    r /= 0.75
    bead = finishes.glossy(rng)
    count = int(rng.integers(4, 11))
    for k in range(count):
        w = 2 * np.pi * k / count
        a.add(ball(0.06, count=18).moved(r * 0.75 * np.cos(w), y + 0.06, r * 0.75 * np.sin(w)), bead)
    if rng.uniform() < 0.5:
        wax, flame = (
            finishes.banded(np.random.default_rng(rng.integers(2**32)), frequency=9.0),
            finishes.glossy(rng, hsv(0.1, 0.8, 1)),
        )
        for x in (-0.15, 0, 0.15):
            a.add(cylinder(0.025, 0.3, count=14).moved(x, y + 0.15, 0), wax)
            a.add(ball(0.025, 0.05, 0.025, 12).moved(x, y + 0.35, 0), flame)
    a.add(cylinder(0.85, 0.05, 0.02, 56).moved(y=-0.02), tiles.pick(rng, "ceramic"))
    return a


def _bumpy(shape: solids.Distance, bump: solids.Distance, amount: float) -> solids.Distance:
    """Displace the surface of a shape by a noise field."""
    return lambda points: shape(points) + np.float32(amount) * bump(points)


def icecream(rng: np.random.Generator) -> Assembly:
    """Make scoops of ice cream in a cone."""
    a, tall = Assembly(), rng.uniform(0.7, 1.0)
    wafer = tiles.woven(rng, hsv(0.09, 0.6, 0.8))
    r = rng.uniform(0.26, 0.34)
    a.add(
        loft(
            refined(
                [
                    (0, 0),
                    (0.03, 0.01),
                    (r, tall),
                    (r * 1.08, tall),
                    (r * 1.08, tall + 0.08),
                    (r, tall + 0.08),
                    (0, tall + 0.05),
                ],
                0.07,
            ),
            circle(44),
        ),
        wafer,
    )
    y = tall + 0.1
    for _ in range(int(rng.integers(1, 4))):
        bump, s = patterns.noise_field(rng, 2.0, 1.5), r * rng.uniform(1.0, 1.15)
        scoop = solids.blended(
            [solids.ellipsoid((0, 0, 0), (s, s * 0.9, s)), solids.ring((0, -0.35 * s, 0), s * 0.9, s * 0.2)], 0.05
        )
        a.add(
            solids.polygonised(_bumpy(scoop, bump, 0.012), 36).moved(y=y + s * 0.4),
            tiles.pick(rng, "skin"),
        )
        y += s * 1.15
    if rng.uniform() < 0.6:
        a.add(ball(0.09, count=22).moved(y=y + r * 0.45), finishes.glossy(rng, hsv(0.98, 0.9, 0.6)))
    return a


def burger(rng: np.random.Generator) -> Assembly:
    """Make a doughnut, or a burger or sandwich of stacked layers."""
    a, y = Assembly(), 0.0
    if rng.uniform() < 0.35:
        w = 2 * np.pi * np.arange(60) / 60
        thick = rng.uniform(0.18, 0.26)
        ring = np.stack([0.4 * np.cos(w), 0 * w, 0.4 * np.sin(w)], -1)
        a.add(tube(ring, thick, closed=True, outline=circle(28)), finishes.matte(rng, hsv(0.085, 0.6, 0.75)))

        def below_edge(p: np.ndarray) -> np.ndarray:
            """Measure the height above the wavy lower edge of the icing."""
            # Contiguous, because on strided columns the last bit of numpy 1.26's arctan2 depends on memory alignment.
            x, y, z = np.ascontiguousarray(p.T)
            return y - 0.02 - 0.03 * np.sin(7 * np.arctan2(z, x))

        top = solids.carved(solids.ring((0, 0, 0), 0.4, thick * 1.06), below_edge, 0.02)
        a.add(solids.polygonised(top, 52), tiles.pick(rng, "skin"))
        sprinkle = [finishes.plastic(rng) for _ in range(3)]
        for _ in range(int(rng.integers(0, 30))):
            w0, out = rng.uniform(0, 2 * np.pi), rng.uniform(-0.6, 0.6)
            at = 0.4 + out * thick
            a.add(
                ball(0.035, 0.014, 0.014, 10)
                .turned("y", rng.uniform(0, 180))
                .moved(at * np.cos(w0), thick * 1.06 * np.sqrt(1 - out**2), at * np.sin(w0)),
                sprinkle[rng.integers(3)],
            )
        return a
    bun = finishes.matte(rng, hsv(0.08, 0.6, 0.8))
    a.add(loft(refined([(0, 0), (0.45, 0), (0.55, 0.06), (0.55, 0.14), (0, 0.16)], 0.06), circle(48)), bun)
    y = 0.15
    for _ in range(int(rng.integers(2, 6))):
        kind = rng.integers(4)
        if kind == 0:
            wave = circle(96) * (1 + 0.06 * np.sin(11 * 2 * np.pi * np.arange(96) / 96))[:, None]
            a.add(
                loft(refined([(0, 0), (0.6, -0.02), (0.62, 0.01), (0.6, 0.03), (0, 0.04)], 0.08), wave).moved(y=y),
                finishes.plastic(rng, hsv(rng.uniform(0.22, 0.32), 0.7, 0.65)),
            )
            y += 0.035
        elif kind == 1:
            a.add(cylinder(0.55, 0.13, 0.05, 48).moved(y=y + 0.065), tiles.grained(rng, hsv(0.05, 0.6, 0.3)))
            y += 0.13
        elif kind == 2:
            a.add(
                cylinder(0.74, 0.03, 0.008, 4).turned("y", 45 * rng.uniform(0, 2)).moved(y=y + 0.015),
                finishes.plastic(rng, hsv(0.12, 0.8, 0.95)),
            )
            y += 0.03
        else:
            a.add_pair(
                cylinder(0.24, 0.05, 0.015, 36).moved(0.27, y + 0.025, 0.1), finishes.glossy(rng, hsv(0.01, 0.85, 0.75))
            )
            y += 0.05
    t = np.linspace(0, np.pi / 2, 14)
    dome = np.stack([0.56 * np.cos(t), y + 0.05 + 0.32 * np.sin(t)], -1)
    dome[-1, 0] = 0
    a.add(loft(np.vstack([(0, y), (0.5, y), dome]), circle(48)), bun)
    return a
