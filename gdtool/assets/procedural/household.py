"""Make containers and tools: chests, cartons, books, extinguishers, clocks, tools. The family includes furniture.py."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import colors, finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.buildings import gable
from gdtool.assets.procedural.furniture import bed, chair, shelf, sofa, table
from gdtool.assets.procedural.parts import (
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


def chest(rng: np.random.Generator) -> Assembly:
    """Make a crate, treasure chest, gift, suitcase or cardboard box."""
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
        for hoop in (-w * 0.35, 0, w * 0.35):
            a.add(
                loft(refined([(0, 0), (1, 0), (1, 1), (0, 1)], 0.3), circle(40), boxed=True)
                .scaled(d / 2 + 0.015, 0.07, d / 2 + 0.015)
                .turned("z", 90)
                .moved(hoop + 0.035, h, 0),
                trim,
            )
            a.add(box(0.07, h, d + 0.03, 0.006).moved(hoop, h / 2 + 0.01, 0), trim)
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


def carton(rng: np.random.Generator) -> Assembly:
    """Make a milk carton: a box with printed sides, a gable top and perhaps a cap."""
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


def books(rng: np.random.Generator) -> Assembly:
    """Make a stack of one to five books."""
    a, y = Assembly(), 0.0
    for _ in range(int(rng.integers(1, 6))):
        w, d, thick, turn = rng.uniform(0.6, 0.9), rng.uniform(0.8, 1.1), rng.uniform(0.09, 0.25), rng.normal(0, 12)
        cover, page = tiles.pick(rng, "cloth"), finishes.matte(rng, colors.hsv(0.12, 0.12, 0.92))
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


def extinguisher(rng: np.random.Generator) -> Assembly:
    """Make a fire extinguisher or gas bottle: body, valve, lever, hose, label."""
    a, h, r = Assembly(), rng.uniform(1.0, 1.4), rng.uniform(0.24, 0.34)
    body = tiles.pick(rng, "paint", colors.hsv(rng.choice([0.0, 0.0, 0.1, 0.35, 0.6]), 0.85, 0.75))
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


def clock(rng: np.random.Generator) -> Assembly:
    """Make an alarm clock or wall clock: a round face on a case."""
    a, r = Assembly(), rng.uniform(0.4, 0.55)
    case, rim = tiles.pick(rng, "paint"), tiles.pick(rng, "metal")
    depth = rng.uniform(0.2, 0.4)
    if rng.uniform() < 0.5:
        a.add(cylinder(r, depth, 0.04, 56).turned("x", 90).moved(y=r), case)
    else:
        a.add(box(2.3 * r, 2.3 * r, depth, 0.06).moved(y=r), case)
    a.add(
        cylinder(r * 0.88, 0.06, 0.01, 56).turned("x", 90).moved(0, r, depth / 2),
        finishes.matte(rng, colors.hsv(0.12, rng.uniform(0, 0.2), rng.uniform(0.75, 0.97))),
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


def tool(rng: np.random.Generator) -> Assembly:
    """Make a hammer, sword, axe or spoon that stands upright."""
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
