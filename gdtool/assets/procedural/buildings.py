"""Make buildings, their entrance toward +Z: houses, castles, towers, pyramids, temples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gdtool.assets.procedural import colors, finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.finishes import Finish
from gdtool.assets.procedural.parts import (
    Part,
    ball,
    box,
    circle,
    cone,
    cylinder,
    extrusion,
    loft,
    rectangle,
    refined,
    subdivided,
)


def gable(width: float, height: float, depth: float, overhang: float = 0.0, power: float = 1.0) -> Part:
    """Make a gable roof with its ridge along z, from y = 0 to `height`.

    overhang: how far it reaches beyond width and depth on each side. power: 1 for straight slopes, else curved ones.
    """
    w = width / 2 + overhang
    slope = np.stack([w * (1 - (t := np.linspace(0, 1, 6))), height * t**power], -1)
    outline = np.vstack(
        [slope, slope[-2::-1] * np.array([-1, 1]), np.stack([np.linspace(-w, w, 7)[1:-1], np.zeros(5)], -1)]
    )
    middle = np.array([0, 0.4 * height])  # an extrusion's outline goes around the origin
    return (
        extrusion(outline - middle, depth + 2 * overhang, 0.01)
        .turned("x", -90)
        .moved(0, middle[1], depth / 2 + overhang)
    )


def hip(width: float, height: float, depth: float, overhang: float = 0.05, top: float = 0.02) -> Part:
    """Make a roof with four slopes, from y = 0 to `height`; top: the share of its width that is left at the top."""
    profile = refined([(0, 0), (1, 0), (1, 0.02), (top, height), (0, height)], 0.1)
    return loft(profile, rectangle(width + 2 * overhang, depth + 2 * overhang), boxed=True)


class Window(NamedTuple):
    """Hold a window of four panes: width and height, and the finishes of frame and panes."""

    width: float
    height: float
    frame: Finish
    pane: Finish


def add_window(a: Assembly, window: Window, x: float, y: float, z: float, turn: float = 0.0) -> None:
    """Add a window centred at (x, y, z) in front of a wall that faces +Z, turned about y by `turn` degrees with it."""
    width, height = window.width, window.height
    a.add(box(width, height, 0.05, 0.01, 3).moved(x, y, z).turned("y", turn), window.frame)
    for sx in (-1, 1):
        for sy in (-1, 1):
            a.add(
                box(width * 0.38, height * 0.38, 0.05, 0.008, 2)
                .moved(x + sx * width * 0.22, y + sy * height * 0.22, z + 0.012)
                .turned("y", turn),
                window.pane,
            )


def house(rng: np.random.Generator) -> Assembly:
    """Make a house: walls, roof, door, windows, perhaps a chimney, a porch and a lawn."""
    a = Assembly()
    width, depth, storeys = rng.uniform(0.7, 1.3), rng.uniform(0.6, 1.2), int(rng.integers(1, 4))
    tall = 0.42 * storeys + rng.uniform(0, 0.2)
    wall, roof, frame = tiles.pick(rng, "wall"), tiles.pick(rng, "roof"), tiles.pick(rng, "wood")
    pane = finishes.glossy(
        rng,
        colors.hsv(rng.uniform(0.5, 0.62), rng.uniform(0.1, 0.5), rng.uniform(0.15, 0.8))
        if rng.uniform() < 0.8
        else colors.hsv(0.13, 0.6, 1),
    )
    a.add(box(width, tall, depth, 0.015, 8).moved(y=tall / 2), wall)
    pitch = rng.uniform(0.25, 0.7) * width
    kind = rng.integers(4)
    if kind == 0:
        a.add(gable(width, pitch, depth, 0.08).moved(y=tall), roof)
    elif kind == 1:
        a.add(gable(depth, pitch, width, 0.08).turned("y", 90).moved(y=tall), roof)
    elif kind == 2:
        a.add(hip(width, pitch, depth, 0.1, rng.choice([0.02, 0.4])).moved(y=tall - 0.01), roof)
    else:
        a.add(box(width + 0.1, 0.08, depth + 0.1).moved(y=tall + 0.03), roof)
        a.add(
            box(width * 0.4, 0.14, depth * 0.3).moved(width * 0.15, tall + 0.12, -depth * 0.1), tiles.pick(rng, "metal")
        )
    door = rng.choice([-0.25, 0.0, 0.0, 0.25]) * width
    a.add(box(0.22, 0.36, 0.06, 0.01).moved(door, 0.18, depth / 2), frame)
    a.add(box(0.17, 0.32, 0.06, 0.01).moved(door, 0.16, depth / 2 + 0.015), tiles.pick(rng, "paint"))
    a.add(ball(0.018, count=12).moved(door + 0.06, 0.16, depth / 2 + 0.05), finishes.metal(rng))
    front, side = Window(0.18, 0.2, frame, pane), Window(0.16, 0.2, frame, pane)
    count = max(2, int(width / 0.36))
    for level in range(storeys):
        for x in (np.arange(count) - (count - 1) / 2) * (width / count):
            y = 0.26 + 0.42 * level
            if level or abs(x - door) > 0.22:
                add_window(a, front, x, y, depth / 2)
            add_window(a, front, x, y, depth / 2, 180)
        for x in (-depth * 0.22, depth * 0.22):
            for turn in (90, -90):
                add_window(a, side, x, 0.26 + 0.42 * level, width / 2, turn)
    if rng.uniform() < 0.6 and kind < 3:
        a.add(
            box(0.13, pitch * 0.8 + 0.2, 0.13, 0.01).moved(width * 0.25, tall + pitch * 0.55, -depth * 0.2),
            tiles.pick(rng, "wall"),
        )
    if rng.uniform() < 0.4:
        a.add_pair(cylinder(0.03, 0.4).moved(0.22, 0.2, depth / 2 + 0.25), frame)
        a.add(gable(0.6, 0.2, 0.34, 0.02).moved(0, 0.4, depth / 2 + 0.14), roof)
    if rng.uniform() < 0.6:
        a.add(
            box(width * rng.uniform(1.2, 1.7), 0.05, depth * rng.uniform(1.3, 1.7)).moved(y=-0.02),
            tiles.pick(rng, "stone")
            if rng.uniform() < 0.5
            else finishes.matte(rng, colors.hsv(rng.uniform(0.2, 0.35), 0.6, 0.5)),
        )
    return a


def castle(rng: np.random.Generator) -> Assembly:
    """Make a castle: walls, four corner towers, a keep, a gate."""
    a = Assembly()
    half, wall_h = rng.uniform(0.5, 0.8), rng.uniform(0.35, 0.6)
    stone, roof, wood = tiles.pick(rng, "wall"), tiles.pick(rng, "roof"), tiles.pick(rng, "wood")
    for turn in (0, 90, 180, 270):
        a.add(box(2 * half, wall_h, 0.12, 0.01, 8).moved(0, wall_h / 2, half).turned("y", turn), stone)
        for x in np.linspace(-half * 0.75, half * 0.75, 6):
            a.add(box(0.1, 0.09, 0.12, 0.008, 2).moved(x, wall_h + 0.03, half).turned("y", turn), stone)
    r, tower_h, pointed = rng.uniform(0.14, 0.24), wall_h * rng.uniform(1.3, 2.0), rng.uniform() < 0.65
    sides = int(rng.choice([4, 6, 8, 40]))
    for x, z in ((half, half), (half, -half)):
        a.add_pair(
            loft(
                refined(
                    [
                        (0, 0),
                        (r * 1.1, 0),
                        (r, 0.1),
                        (r, tower_h),
                        (r * 1.15, tower_h + 0.06),
                        (r * 1.15, tower_h + 0.13),
                        (0, tower_h + 0.13),
                    ],
                    0.1,
                ),
                subdivided(circle(sides), 4) if sides < 40 else circle(32),
            ).moved(x, 0, z),
            stone,
        )
        if pointed:
            a.add_pair(cone(r * 1.35, r * rng.uniform(1.8, 3.2), 36).moved(x, tower_h + 0.12, z), roof)
        else:
            for side in (1, -1):
                for k in range(8):
                    w = 2 * np.pi * k / 8
                    a.add(
                        box(0.07, 0.09, 0.07, 0.006, 2).moved(
                            side * x + r * np.cos(w), tower_h + 0.16, z + r * np.sin(w)
                        ),
                        stone,
                    )
    keep, keep_h = half * rng.uniform(0.45, 0.65), wall_h * rng.uniform(1.8, 2.8)
    a.add(box(2 * keep, keep_h, 2 * keep, 0.012, 8).moved(0, keep_h / 2, -half * 0.25), stone)
    a.add(hip(2 * keep, keep * rng.uniform(0.8, 1.6), 2 * keep, 0.06).moved(0, keep_h, -half * 0.25), roof)
    a.add(box(0.28, wall_h * 0.75, 0.16, 0.01).moved(0, wall_h * 0.37, half), wood)
    a.add(cylinder(0.14, 0.17).turned("x", 90).moved(0, wall_h * 0.72, half), wood)
    dark = finishes.matte(rng, colors.hsv(0.1, 0.4, 0.08))
    for y in np.linspace(keep_h * 0.62, keep_h * 0.88, 2):
        for x in (-0.4, 0, 0.4):
            a.add(box(0.07, 0.14, 0.04, 0.01, 2).moved(x * keep, y, keep - half * 0.25), dark)
    if rng.uniform() < 0.6:
        top = keep_h + keep * 1.1
        a.add(cylinder(0.015, 0.6).moved(0, top, -half * 0.25), wood)
        a.add(box(0.26, 0.15, 0.02, 0.004, 3).moved(0.14, top + 0.2, -half * 0.25), tiles.pick(rng, "cloth"))
    if rng.uniform() < 0.5:
        a.add(
            cylinder(half * 1.65, 0.1, count=48).moved(y=-0.04),
            finishes.matte(rng, colors.hsv(rng.uniform(0.1, 0.35), 0.5, 0.5)),
        )
    return a


def tower(rng: np.random.Generator) -> Assembly:
    """Make a pagoda, or a round tower with a gallery: lighthouse, windmill, water tower."""
    a, height = Assembly(), rng.uniform(1.1, 1.7)
    wall, roof = tiles.pick(rng, "wall"), tiles.pick(rng, "roof")
    r, top = rng.uniform(0.28, 0.4), rng.uniform(0.18, 0.26)
    if rng.uniform() < 0.35:  # pagoda
        y, w = 0.0, rng.uniform(0.6, 0.9)
        for _ in range(int(rng.integers(3, 6))):
            a.add(box(w * 0.8, 0.26, w * 0.8, 0.01).moved(y=y + 0.13), wall)
            flare = refined([(0, 0.22), (1.25, 0.24), (1.27, 0.27), (0.85, 0.31), (0.7, 0.4), (0, 0.4)], 0.08)
            a.add(loft(flare, rectangle(w, w), boxed=True).moved(y=y), roof)
            a.add(
                box(0.14, 0.18, 0.04, 0.01, 2).moved(0, y + 0.1, w * 0.4),
                finishes.plastic(rng, colors.hsv(0.05, 0.7, 0.3)),
            )
            y, w = y + 0.36, w * 0.84
        a.add(cone(0.06, 0.3, 16).moved(y=y), finishes.metal(rng))
        return a
    finish = (
        wall
        if rng.uniform() < 0.5
        else finishes.banded(
            np.random.default_rng(rng.integers(2**32)), colors.hsv(rng.uniform(), 0.8, 0.7), axis=1, frequency=2.5
        )
    )
    outline = circle(48) if rng.uniform() < 0.7 else subdivided(circle(8), 5)
    a.add(
        loft(refined([(0, 0), (r * 1.15, 0), (r * 1.1, 0.08), (r, 0.1), (top, height), (0, height)], 0.09), outline),
        finish,
    )
    a.add(cylinder(top * 1.4, 0.07, count=40).moved(y=height), tiles.pick(rng, "metal"))
    a.add(
        cylinder(top * 0.8, 0.24, count=40).moved(y=height + 0.14),
        finishes.glossy(rng, colors.hsv(0.13, rng.uniform(0.1, 0.6), 0.95)),
    )
    cap = refined(
        [
            (0, 0),
            (1.15, 0),
            (1.15, 0.03),
            *[(1.05 * np.cos(t), 0.03 + 0.9 * np.sin(t)) for t in np.linspace(0.1, 1.5, 8)],
            (0, 0.95),
        ],
        0.2,
    )
    a.add(
        (loft(cap, circle(40)).scaled(top, top, top) if rng.uniform() < 0.5 else cone(top * 1.3, top * 1.5, 40)).moved(
            y=height + 0.25
        ),
        roof,
    )
    a.add(box(0.2, 0.3, 0.08, 0.01).moved(0, 0.16, r * 1.04), tiles.pick(rng, "wood"))
    for k, y in enumerate(np.linspace(0.5, height * 0.85, 3)):
        a.add(
            box(0.09, 0.13, 0.06, 0.01, 2)
            .moved(0, y, float(np.interp(y, [0.1, height], [r, top])))
            .turned("y", [0, 35, -35][k]),
            finishes.glossy(rng, colors.hsv(0.6, 0.3, 0.15)),
        )
    if rng.uniform() < 0.35:
        sail, pole, tilt = tiles.pick(rng, "cloth"), tiles.pick(rng, "wood"), rng.uniform(0, 90)
        for k in range(4):
            a.add(
                box(0.16, 0.6, 0.02, 0.005)
                .moved(0.09, 0.42, top + 0.2)
                .turned("z", 90 * k + tilt)
                .moved(y=height * 0.9),
                sail,
            )
            a.add(
                box(0.035, 0.75, 0.035, 0.005)
                .moved(0, 0.37, top + 0.22)
                .turned("z", 90 * k + tilt)
                .moved(y=height * 0.9),
                pole,
            )
        a.add(cylinder(0.06, top + 0.25).turned("x", 90).moved(0, height * 0.9, top * 0.7), pole)
    return a


def pyramid(rng: np.random.Generator) -> Assembly:
    """Make a stepped pyramid with stairs and a temple on top, or a smooth pyramid."""
    a, stone = Assembly(), tiles.pick(rng, "stone")
    other = stone if rng.uniform() < 0.5 else tiles.pick(rng, "stone")
    if rng.uniform() < 0.25:
        peak = rng.uniform(0.8, 1.4)
        a.add(
            loft(refined([(0, 0), (1, 0), (0.01, peak * 0.99), (0, peak)], 0.08), rectangle(1.4, 1.4), boxed=True),
            stone,
        )
        return a
    steps, w, y = int(rng.integers(3, 9)), 1.0, 0.0
    rise, shrink = rng.uniform(0.55, 0.9) / steps, rng.uniform(0.3, 0.4)
    for k in range(steps):
        a.add(extrusion(rectangle(2 * w, 2 * w), rise, 0.015).moved(y=y), stone if k % 2 == 0 else other)
        y, w = y + rise, 1.0 - (1.0 - shrink) * (k + 1) / steps
    stairs = int(rng.integers(8, 16))
    for turn in (0, 90, 180, 270) if rng.uniform() < 0.5 else (0,):
        for k in range(stairs):
            t = (k + 1) / stairs
            z0, z1 = 0.2, 1.12 - (1.0 - shrink) * (k / stairs)
            a.add(
                box(0.34, y / stairs * 1.02, z1 - z0, 0.006, 3)
                .moved(0, y * (t - 0.5 / stairs), (z0 + z1) / 2)
                .turned("y", turn),
                other,
            )
    a.add(box(shrink * 1.3, 0.28, shrink * 1.2, 0.01).moved(y=y + 0.14), stone)
    a.add(box(shrink * 1.6, 0.07, shrink * 1.5, 0.01).moved(y=y + 0.3), other)
    a.add(box(0.14, 0.2, 0.1, 0.005).moved(0, y + 0.1, shrink * 0.58), finishes.matte(rng, colors.hsv(0.1, 0.3, 0.07)))
    return a


def temple(rng: np.random.Generator) -> Assembly:
    """Make a hall with columns on a stepped base, under a gable roof or a dome."""
    a, stone, roof = Assembly(), tiles.pick(rng, "stone"), tiles.pick(rng, "roof")
    width, depth, tall = rng.uniform(1.0, 1.4), rng.uniform(0.7, 1.3), rng.uniform(0.5, 0.8)
    for k in range(3):
        a.add(box(width + 0.24 - 0.08 * k, 0.06, depth + 0.24 - 0.08 * k, 0.006).moved(y=0.03 + 0.06 * k), stone)
    r, count = rng.uniform(0.04, 0.065), int(rng.integers(4, 7))
    flutes = circle(48) * (1 - 0.07 * np.abs(np.cos(6 * 2 * np.pi * np.arange(48) / 48)))[:, None]
    column = loft(
        refined(
            [
                (0, 0),
                (1.3 * r, 0),
                (1.3 * r, 0.04),
                (r, 0.06),
                (0.85 * r, tall - 0.06),
                (1.3 * r, tall - 0.03),
                (1.3 * r, tall),
                (0, tall),
            ],
            0.12,
        ),
        flutes,
        crease_degrees=50,
    ).moved(y=0.18)
    inside = box(width * 0.7, tall, depth * 0.7, 0.01).moved(y=0.18 + tall / 2)
    for x in np.linspace(-width / 2 + r, width / 2 - r, count):
        for z in (depth / 2 - r, -depth / 2 + r):
            a.add(column.moved(x, 0, z), stone)
    a.add(inside, tiles.pick(rng, "wall"))
    a.add(box(0.24, tall * 0.7, 0.04, 0.005).moved(0, 0.18 + tall * 0.35, depth * 0.35), tiles.pick(rng, "wood"))
    a.add(box(width + 0.08, 0.1, depth + 0.08, 0.01).moved(y=0.18 + tall + 0.05), stone)
    y = 0.18 + tall + 0.1
    if rng.uniform() < 0.6:
        a.add(gable(width, width * rng.uniform(0.16, 0.3), depth, 0.06).moved(y=y), roof)
    else:
        dome = solids.common(
            [solids.ellipsoid((0, 0, 0), (width * 0.36, width * 0.36, depth * 0.36)), lambda p: -p[:, 1]], 0.01
        )
        a.add(solids.polygonised(dome, 40).moved(y=y), finishes.metal(rng) if rng.uniform() < 0.5 else roof)
    return a


KINDS = {"house": house, "castle": castle, "tower": tower, "pyramid": pyramid, "temple": temple}
