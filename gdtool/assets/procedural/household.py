"""Furniture, containers and tools: chairs, tables, sofas, beds, shelves, chests, cartons, books, clocks,
extinguishers."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.buildings import gable
from gdtool.assets.procedural.parts import (
    Part,
    ball,
    box,
    circle,
    cone,
    cylinder,
    loft,
    refined,
    smooth_curve,
    subdivided,
    tube,
)


def _leg(rng, height: float, size: float) -> Part:
    kind = rng.integers(3)
    if kind == 0:
        return box(size, height, size, 0.01, 3).moved(y=height / 2)
    if kind == 1:
        return cylinder(size * 0.45, height, top_radius=size * 0.7, count=24).moved(y=height / 2)
    t = np.linspace(0, 1, 16)
    radius = size * (0.45 + 0.2 * np.cos(rng.integers(2, 5) * np.pi * t))
    return loft(np.vstack([(0, 0), np.stack([radius, t * height], -1), (0, height)]), circle(24))


def chair(rng) -> Assembly:
    """Return a chair: seat, legs, back."""
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


def table(rng) -> Assembly:
    """Return a table: a top on legs or a foot."""
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
    for _ in range(int(rng.integers(0, 3))):  # something on it
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


def sofa(rng) -> Assembly:
    """Return a sofa: cushions, arms, back."""
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


def bed(rng) -> Assembly:
    """Return a bed: frame, mattress, pillows."""
    a, wood, sheet = Assembly(), tiles.pick(rng, "wood"), tiles.pick(rng, "cloth")
    w, d = rng.uniform(0.6, 0.95), rng.uniform(1.0, 1.3)
    a.add(box(w, 0.16, d, 0.02).moved(y=0.2), wood)
    a.add(box(w, rng.uniform(0.5, 0.7), 0.07, 0.02).moved(0, 0.35, -d / 2), wood)
    a.add(box(w, rng.uniform(0.25, 0.4), 0.07, 0.02).moved(0, 0.2, d / 2), wood)
    a.add(
        solids.polygonised(solids.block((0, 0.32, 0), (w * 0.47, 0.09, d * 0.48), 0.05), 40),
        finishes.matte(rng, finishes.hsv(0.1, 0.05, 0.9)),
    )
    a.add(solids.polygonised(solids.block((0, 0.34, d * 0.14), (w * 0.5, 0.1, d * 0.34), 0.06), 40), sheet)
    for x in [-0.22, 0.22] if w > 0.75 else [0]:
        a.add(ball(0.17, 0.06, 0.12, 26).moved(x, 0.44, -d * 0.34), tiles.pick(rng, "cloth"))
    return a


def shelf(rng) -> Assembly:
    """Bookcase or chest of drawers."""
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


def chest(rng) -> Assembly:
    """Box, crate, treasure chest, gift, suitcase."""
    a = Assembly()
    w, h, d = rng.uniform(0.7, 1.2), rng.uniform(0.45, 0.9), rng.uniform(0.5, 0.9)
    kind, finish = rng.integers(5), tiles.pick(rng, ["wood", "any", "cloth", "paint"][rng.integers(4)])
    trim = tiles.pick(rng, "metal" if rng.uniform() < 0.6 else "any")
    a.add(box(w, h, d, rng.uniform(0.01, 0.06), 10).moved(y=h / 2), finish)
    if kind == 0:  # crate: a frame on every side
        for turn in (0, 90, 180, 270):
            half, side = (d, w) if turn % 180 == 0 else (w, d)
            for x in (-1, 1):
                a.add(box(0.08, h, 0.05, 0.008).moved(x * (side / 2 - 0.04), h / 2, half / 2).turned("y", turn), trim)
            for y in (0.04, h - 0.04):
                a.add(box(side, 0.08, 0.05, 0.008).moved(0, y, half / 2).turned("y", turn), trim)
            if rng.uniform() < 0.7:
                a.add(
                    box(np.hypot(side, h) * 0.86, 0.07, 0.03, 0.006)
                    .turned("z", np.degrees(np.arctan2(h, side)))
                    .moved(0, h / 2, half / 2)
                    .turned("y", turn),
                    trim,
                )
    elif kind == 1:  # treasure chest
        lid = (
            loft(refined([(0, 0), (1, 0), (1, 1), (0, 1)], 0.12), circle(40), boxed=True)
            .scaled(d / 2, w, d / 2)
            .turned("z", 90)
            .moved(w / 2, h, 0)
        )
        a.add(lid, finish)
        for x in (-w * 0.35, 0, w * 0.35):
            a.add(
                loft(refined([(0, 0), (1, 0), (1, 1), (0, 1)], 0.3), circle(40), boxed=True)
                .scaled(d / 2 + 0.015, 0.07, d / 2 + 0.015)
                .turned("z", 90)
                .moved(x + 0.035, h, 0),
                trim,
            )
            a.add(box(0.07, h, d + 0.03, 0.006).moved(x, h / 2 + 0.01, 0), trim)
        a.add(box(0.16, 0.18, 0.07, 0.02).moved(0, h, d / 2 + 0.02), finishes.metal(rng))
    elif kind == 2:  # gift with ribbon and bow
        a.add(box(w + 0.02, h + 0.02, 0.12, 0.01).moved(y=h / 2), trim)
        a.add(box(0.12, h + 0.02, d + 0.02, 0.01).moved(y=h / 2), trim)
        t = np.linspace(0, 2 * np.pi, 30, endpoint=False)
        for turn in (0, 180) if rng.uniform() < 0.5 else (0, 90, 180, 270):
            a.add(
                tube(
                    np.stack([0.14 + 0.14 * np.cos(t), h + 0.08 + 0.09 * np.sin(t), 0 * t], -1), 0.035, closed=True
                ).turned("y", turn),
                trim,
            )
    elif kind == 3:  # suitcase, radio or toaster: handle, corners, a dial or two
        a.add(tube(np.array([(-0.15, h, 0), (-0.14, h + 0.1, 0), (0.14, h + 0.1, 0), (0.15, h, 0)]), 0.03), trim)
        for x in (-1, 1):
            a.add(cylinder(rng.uniform(0.06, 0.12), 0.08).turned("x", 90).moved(x * w * 0.28, h * 0.55, d / 2), trim)
        a.add(box(w * 0.3, h * 0.35, 0.04).moved(0, h * 0.55, d / 2), tiles.pick(rng, "any"))
    else:  # cardboard box with open flaps or a lid
        if rng.uniform() < 0.5:
            a.add(box(w + 0.05, h * 0.25, d + 0.05, 0.02, 10).moved(y=h), trim)
        else:
            for turn, half, side in ((0, d, w), (180, d, w), (90, w, d), (270, w, d)):
                a.add(
                    box(side * 0.95, half * 0.4, 0.02, 0.004)
                    .moved(y=half * 0.2)
                    .turned("x", rng.uniform(25, 70))
                    .moved(0, h, half / 2)
                    .turned("y", turn),
                    finish,
                )
    return a


def carton(rng) -> Assembly:
    """Milk carton: a box with a gable, a fin and a cap; printed sides."""
    a, paper = Assembly(), tiles.pick(rng, "any")
    w, h = rng.uniform(0.45, 0.65), rng.uniform(0.7, 1.1)
    a.add(box(w, h, w, 0.012, 10).moved(y=h / 2), paper)
    top = paper if rng.uniform() < 0.5 else finishes.plastic(rng)
    rise = rng.uniform(0.2, 0.32)
    a.add(gable(w, rise, w).turned("y", 90 * int(rng.integers(2))).moved(y=h - 0.005), top)
    a.add(box(w, 0.12, 0.03, 0.005).moved(y=h + rise + 0.03).turned("y", 90 * int(rng.integers(2))), top)
    print_color = tiles.pick(rng, "any")
    a.add(box(w * 0.75, h * rng.uniform(0.25, 0.5), 0.03, 0.01).moved(0, h * 0.55, w / 2), print_color)
    if rng.uniform() < 0.6:
        a.add(cylinder(0.09, 0.1).turned("x", 40).moved(0, h + rise * 0.5, w * 0.26), finishes.plastic(rng))
    if rng.uniform() < 0.4:
        a.add(ball(w * 0.22, w * 0.22, 0.03, 24).moved(0, h * 0.55, w / 2 + 0.012), tiles.pick(rng, "any"))
    return a


def books(rng) -> Assembly:
    """Return a stack or row of books."""
    a, y = Assembly(), 0.0
    for _ in range(int(rng.integers(1, 6))):
        w, d, thick, turn = rng.uniform(0.6, 0.9), rng.uniform(0.8, 1.1), rng.uniform(0.09, 0.25), rng.normal(0, 12)
        cover, page = tiles.pick(rng, "cloth"), finishes.matte(rng, finishes.hsv(0.12, 0.12, 0.92))
        for part, finish in (
            (box(w, 0.03, d, 0.008).moved(y=thick), cover),
            (box(w, 0.03, d, 0.008), cover),
            (box(0.03, thick + 0.03, d, 0.01).moved(-w / 2, thick / 2), cover),
            (box(w * 0.95, thick, d * 0.95, 0.005).moved(y=thick / 2), page),
            (box(w * 0.5, 0.01, d * 0.25, 0.003).moved(0, thick + 0.016, 0), finishes.metal(rng)),
        ):
            a.add(part.moved(y=y + 0.015).turned("y", turn), finish)
        y += thick + 0.03
    return a


def extinguisher(rng) -> Assembly:
    """Bottle with valve, lever, hose and label: an extinguisher, flask or gas bottle."""
    a, h, r = Assembly(), rng.uniform(1.0, 1.4), rng.uniform(0.24, 0.34)
    body = tiles.pick(rng, "paint", finishes.hsv(rng.choice([0.0, 0.0, 0.1, 0.35, 0.6]), 0.85, 0.75))
    t = np.linspace(0, np.pi / 2, 10)
    curve = np.vstack(
        [
            (0, 0.02),
            (r * 0.9, 0),
            (r, 0.05),
            (r, h * 0.75),
            np.stack([0.08 + (r - 0.08) * np.cos(t), h * 0.75 + 0.2 * np.sin(t)], -1),
            (0.08, h),
            (0, h),
        ]
    )
    a.add(loft(refined(curve, 0.08), circle(48)), body)
    black, chrome = finishes.plastic(rng, np.full(3, 0.02)), finishes.metal(rng)
    a.add(cylinder(0.07, 0.16).moved(y=h + 0.05), chrome)
    a.add(box(0.05, 0.035, 0.34).turned("x", -15).moved(0, h + 0.17, 0.12), black)
    a.add(box(0.05, 0.03, 0.3).moved(0, h + 0.09, 0.12), black)
    path = np.array([(0.06, h + 0.05, 0), (r * 0.9, h + 0.02, 0), (r + 0.1, h * 0.7, 0), (r + 0.06, h * 0.35, 0.05)])
    a.add(tube(smooth_curve(path, 24), 0.035), black)
    a.add(cone(0.08, 0.28, 24).moved(r + 0.06, h * 0.22, 0.05), black)
    label = [(0, 0), (r * 1.015, 0), (r * 1.015, h * 0.3), (0, h * 0.3)]
    a.add(loft(refined(label, 0.06), circle(48)).moved(y=h * rng.uniform(0.2, 0.4)), tiles.pick(rng, "any"))
    return a


def clock(rng) -> Assembly:
    """Alarm clock, mirror or camera-like round front on a case."""
    a, r = Assembly(), rng.uniform(0.4, 0.55)
    case, rim = tiles.pick(rng, "paint"), tiles.pick(rng, "metal")
    depth = rng.uniform(0.2, 0.4)
    if rng.uniform() < 0.5:
        a.add(cylinder(r, depth, 0.04, 56).turned("x", 90).moved(y=r), case)
    else:
        a.add(box(2.3 * r, 2.3 * r, depth, 0.06).moved(y=r), case)
    a.add(
        cylinder(r * 0.88, 0.06, 0.01, 56).turned("x", 90).moved(0, r, depth / 2),
        finishes.matte(rng, finishes.hsv(0.12, rng.uniform(0, 0.2), rng.uniform(0.75, 0.97))),
    )
    w = 2 * np.pi * np.arange(56) / 56
    a.add(
        tube(
            np.stack([r * 0.92 * np.cos(w), r + r * 0.92 * np.sin(w), np.full(56, depth / 2 + 0.03)], -1),
            0.05,
            closed=True,
            outline=circle(12),
        ),
        rim,
    )
    dark = finishes.plastic(rng, np.full(3, 0.02))
    for k in range(12):
        a.add(
            box(0.035, 0.09 if k % 3 == 0 else 0.05, 0.03, 0.006, 2)
            .moved(y=r * 0.72)
            .turned("z", 30 * k)
            .moved(0, r, depth / 2 + 0.025),
            dark,
        )
    for length, turn in ((0.5, rng.uniform(0, 360)), (0.7, rng.uniform(0, 360))):
        a.add(
            box(0.04, r * length, 0.025, 0.008, 3)
            .moved(y=r * length * 0.45)
            .turned("z", turn)
            .moved(0, r, depth / 2 + 0.045),
            dark,
        )
    if rng.uniform() < 0.6:
        a.add_pair(ball(0.16, 0.12, 0.16, 24).turned("z", -30).moved(r * 0.55, r * 2.02, 0), rim)
        a.add_pair(cylinder(0.035, 0.3).turned("z", 25).moved(r * 0.6, 0.0, 0), rim)
    return a


def tool(rng) -> Assembly:
    """Hammer, sword, axe, brush or spoon, standing upright."""
    a, handle, head = Assembly(), tiles.pick(rng, "wood"), tiles.pick(rng, "metal")
    length, kind = rng.uniform(0.9, 1.3), rng.integers(4)
    t = np.linspace(0, 1, 14)
    a.add(
        loft(
            np.vstack([(0, 0), np.stack([0.05 * (1 + 0.25 * np.sin(7 * t)), t * length], -1), (0, length)]),
            circle(28) * np.array([1.0, 1.3]),
        ),
        handle,
    )
    if kind == 0:
        a.add(box(0.28, 0.2, 0.22, 0.03).moved(y=length), head)
        a.add(cylinder(0.13, 0.22).turned("z", 90).moved(0.24, length, 0), head)
        a.add(cone(0.12, 0.35, 24).turned("z", 90).moved(-0.12, length, 0), head)
    elif kind == 1:
        blade = np.array([(1.0, 0.0), (0.0, 0.28), (-1.0, 0.0), (0.0, -0.28)])
        profile = refined([(0, 0), (0.12, 0.0), (0.1, 0.75), (0.005, 0.98), (0, 1.0)], 0.06)
        a.add(loft(profile * np.array([1.0, 1.3 * length]), subdivided(blade, 4)).moved(y=length * 0.35), head)
        a.add(box(0.5, 0.07, 0.1, 0.02).moved(y=length * 0.36), finishes.metal(rng))
        a.add(ball(0.08, count=24), finishes.metal(rng))
    elif kind == 2:
        wedge = solids.common(
            [
                solids.block((0.22, length - 0.12, 0), (0.22, 0.24, 0.07), 0.01),
                solids.ellipsoid((0.3, length - 0.12, 0), (0.34, 0.26, 0.075)),
            ],
            0.02,
        )
        a.add(solids.polygonised(wedge, 46), head)
        a.add(box(0.16, 0.2, 0.15, 0.02).moved(y=length - 0.12), head)
    else:
        a.add(ball(0.2, 0.3, 0.06, 30).moved(y=length + 0.2), head)
    return a


KINDS = {
    "chair": chair,
    "table": table,
    "sofa": sofa,
    "bed": bed,
    "shelf": shelf,
    "chest": chest,
    "carton": carton,
    "books": books,
    "extinguisher": extinguisher,
    "clock": clock,
    "tool": tool,
}
