"""Make furniture: chairs, tables, sofas, beds, shelves."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import colors, finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.parts import Part, ball, box, circle, cylinder, loft, refined


def _leg(rng: np.random.Generator, height: float, size: float) -> Part:
    """Make a square, tapered or turned leg that stands at the origin."""
    kind = rng.integers(3)
    if kind == 0:
        return box(size, height, size, 0.01, 3).moved(y=height / 2)
    if kind == 1:
        return cylinder(size * 0.45, height, top_radius=size * 0.7, count=24).moved(y=height / 2)
    t = np.linspace(0, 1, 16)
    radius = size * (0.45 + 0.2 * np.cos(rng.integers(2, 5) * np.pi * t))
    return loft(np.vstack([(0, 0), np.stack([radius, t * height], -1), (0, height)]), circle(24))


def chair(rng: np.random.Generator) -> Assembly:
    """Make a chair: legs, seat, back, perhaps arms."""
    a = Assembly()
    wood, seat = (
        tiles.pick(rng, ["wood", "paint", "metal"][rng.integers(3)]),
        tiles.pick(rng, "cloth" if rng.uniform() < 0.5 else "wood"),
    )
    w, d, leg, size = rng.uniform(0.5, 0.65), rng.uniform(0.48, 0.6), rng.uniform(0.4, 0.6), rng.uniform(0.045, 0.08)
    part = _leg(rng, leg, size)
    for z in (d / 2 - size, -d / 2 + size):
        a.add_pair(part.moved(w / 2 - size, 0, z), wood)
    thick = rng.uniform(0.05, 0.14)
    a.add(box(w, thick, d, 0.03).moved(y=leg + thick / 2 - 0.01), seat)
    back, y = rng.uniform(0.45, 0.8), leg + thick
    a.add_pair(box(size, back, size, 0.01).moved(w / 2 - size, y + back / 2 - 0.02, -d / 2 + size), wood)
    kind = rng.integers(3)
    if kind == 0:
        a.add(box(w * 0.9, back * 0.75, 0.06, 0.025).moved(0, y + back * 0.58, -d / 2 + size), seat)
    elif kind == 1:
        for k in range(int(rng.integers(2, 5))):
            a.add(box(w * 0.85, 0.08, 0.035, 0.01).moved(0, y + back * (0.92 - 0.25 * k), -d / 2 + size), wood)
    else:
        a.add(box(w * 0.95, 0.1, 0.05, 0.01).moved(0, y + back * 0.95, -d / 2 + size), wood)
        for x in np.linspace(-0.3, 0.3, int(rng.integers(3, 7))):
            a.add(cylinder(0.018, back, count=14).moved(x * w, y + back * 0.45, -d / 2 + size), wood)
    if rng.uniform() < 0.35:
        a.add_pair(box(size, 0.05, d * 0.9, 0.01).moved(w / 2, y + 0.24, 0), wood)
        a.add_pair(cylinder(size * 0.35, 0.26, count=16).moved(w / 2, y + 0.1, d / 2 - size), wood)
    return a


def table(rng: np.random.Generator) -> Assembly:
    """Make a table on four legs or one foot, perhaps with things on it."""
    a, wood = Assembly(), tiles.pick(rng, "wood" if rng.uniform() < 0.6 else "any")
    top = wood if rng.uniform() < 0.5 else tiles.pick(rng, "any")
    height, thick = rng.uniform(0.4, 0.8), rng.uniform(0.04, 0.09)
    if rng.uniform() < 0.4:
        r = rng.uniform(0.4, 0.6)
        a.add(cylinder(r, thick, count=56).moved(y=height), top)
        a.add(cylinder(0.05, height, top_radius=0.08).moved(y=height / 2), wood)
        a.add(loft(refined([(0, 0), (r * 0.6, 0), (r * 0.6, 0.03), (0.08, 0.09), (0, 0.12)], 0.06), circle(40)), wood)
    else:
        w, d, size = rng.uniform(0.8, 1.3), rng.uniform(0.5, 0.8), rng.uniform(0.05, 0.1)
        a.add(box(w, thick, d, 0.015, 10).moved(y=height), top)
        part = _leg(rng, height, size)
        for z in (d / 2 - size, -d / 2 + size):
            a.add_pair(part.moved(w / 2 - size, 0, z), wood)
        if rng.uniform() < 0.5:
            a.add(box(w * 0.85, 0.12, d * 0.85, 0.01).moved(y=height - 0.08), wood)
    for _ in range(int(rng.integers(0, 3))):  # things on the table
        x, z = rng.uniform(-0.22, 0.22, 2)
        if rng.uniform() < 0.5:
            a.add(
                ball(rng.uniform(0.05, 0.1), count=22).moved(x, height + thick / 2 + 0.06, z), tiles.pick(rng, "skin")
            )
        else:
            a.add(
                cylinder(0.06, 0.2, top_radius=0.08).moved(x, height + thick / 2 + 0.1, z), tiles.pick(rng, "ceramic")
            )
    return a


def _cushion(width: float, height: float, depth: float, rounding: float) -> Part:
    """Make a block about the origin with edges rounded by `rounding`, less where the block is thin."""
    radius = min(rounding, 0.45 * min(width, height, depth))
    return solids.polygonised(solids.block((0, 0, 0), (width / 2, height / 2, depth / 2), radius), 30)


def sofa(rng: np.random.Generator) -> Assembly:
    """Make a sofa: cushions, arms, back, perhaps pillows."""
    a, cloth, wood = Assembly(), tiles.pick(rng, "cloth"), tiles.pick(rng, "wood")
    w, d = rng.uniform(0.7, 1.6), rng.uniform(0.55, 0.75)
    cushion = cloth if rng.uniform() < 0.5 else tiles.pick(rng, "cloth")
    rounding = rng.uniform(0.04, 0.1)

    a.add(_cushion(w, 0.22, d, rounding).moved(0, 0.2, 0), cloth)
    a.add(_cushion(w, rng.uniform(0.5, 0.7), 0.2, rounding).moved(0, 0.45, -d / 2 + 0.05), cloth)
    a.add_pair(_cushion(0.18, 0.4, d, rounding).moved(w / 2, 0.3, 0), cloth)
    count = max(1, round(w / 0.6))
    for k in range(count):
        x = (k - (count - 1) / 2) * (w - 0.18) / count
        a.add(_cushion((w - 0.2) / count, 0.14, d * 0.85, rounding).moved(x, 0.36, 0.06), cushion)
        if rng.uniform() < 0.4:
            a.add(_cushion(0.26, 0.26, 0.1, rounding).moved(x, 0.55, -0.08), tiles.pick(rng, "cloth"))
    for z in (d / 2 - 0.06, -d / 2 + 0.06):
        a.add_pair(cylinder(0.035, 0.12, count=16).moved(w / 2 - 0.05, 0.05, z), wood)
    return a


def bed(rng: np.random.Generator) -> Assembly:
    """Make a bed: frame, mattress, blanket, pillows."""
    a, wood, sheet = Assembly(), tiles.pick(rng, "wood"), tiles.pick(rng, "cloth")
    w, d = rng.uniform(0.6, 0.95), rng.uniform(1.0, 1.3)
    a.add(box(w, 0.16, d, 0.02).moved(y=0.2), wood)
    a.add(box(w, rng.uniform(0.5, 0.7), 0.07, 0.02).moved(0, 0.35, -d / 2), wood)
    a.add(box(w, rng.uniform(0.25, 0.4), 0.07, 0.02).moved(0, 0.2, d / 2), wood)
    a.add(
        solids.polygonised(solids.block((0, 0.32, 0), (w * 0.47, 0.09, d * 0.48), 0.05), 40),
        finishes.matte(rng, colors.hsv(0.1, 0.05, 0.9)),
    )
    a.add(solids.polygonised(solids.block((0, 0.34, d * 0.14), (w * 0.5, 0.1, d * 0.34), 0.06), 40), sheet)
    for x in [-0.22, 0.22] if w > 0.75 else [0]:
        a.add(ball(0.17, 0.06, 0.12, 26).moved(x, 0.44, -d * 0.34), tiles.pick(rng, "cloth"))
    return a


def shelf(rng: np.random.Generator) -> Assembly:
    """Make a bookcase with books, or a chest of drawers."""
    a, wood = Assembly(), tiles.pick(rng, "wood")
    w, h, d, rows = rng.uniform(0.6, 1.0), rng.uniform(0.7, 1.4), rng.uniform(0.25, 0.45), int(rng.integers(2, 6))
    a.add_pair(box(0.05, h, d, 0.008).moved(w / 2, h / 2, 0), wood)
    a.add(box(w, h, 0.04, 0.008, 8).moved(0, h / 2, -d / 2 + 0.02), wood)
    for k in range(rows + 1):
        a.add(box(w, 0.045, d, 0.008).moved(0, h * k / rows, 0), wood)
    drawers, knob = rng.uniform() < 0.5, finishes.metal(rng)
    paint = wood if rng.uniform() < 0.4 else tiles.pick(rng, "paint")
    spines = [tiles.pick(rng, "cloth") for _ in range(4)]
    for k in range(rows):
        y, tall = h * (k + 0.5) / rows, h / rows
        if drawers:
            a.add(box(w * 0.9, tall * 0.82, d, 0.01).moved(0, y, 0.03), paint)
            a.add_pair(ball(0.028, count=14).moved(w * 0.2, y, d / 2 + 0.05), knob)
            continue
        x = -w / 2 + 0.04
        while x < w / 2 - 0.12:
            thick, high = rng.uniform(0.04, 0.09), tall * rng.uniform(0.55, 0.85)
            if rng.uniform() < 0.85:
                a.add(
                    box(thick, high, d * 0.7, 0.006, 2).moved(x + thick / 2, h * k / rows + 0.02 + high / 2, 0.03),
                    spines[rng.integers(4)],
                )
            x += thick + 0.005
    return a
