"""Make vessels and other turned objects: vases, bottles, cups, teapots, bowls, goblets, lamps, candles, barrels."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from gdtool.assets.procedural import colors, finishes, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.parts import Part, ball, circle, cylinder, loft, refined, smooth_curve, tube


def walled(outer: np.ndarray, thickness: float, segments: int = 48, outline: np.ndarray | None = None) -> Part:
    """Make an open vessel with a wall.

    outer: its outer profile (k, 2) of radius and height, from the axis at the foot to the rim; the inner profile runs
    back at a distance of `thickness`. outline: the cross section for `loft`, a circle of `segments` points by default.
    """
    outer = np.asarray(outer, float)
    inner = outer[outer[:, 1] > outer[0, 1] + 1.5 * thickness]
    inner = np.stack([np.maximum(inner[:, 0] - thickness, 0.01), inner[:, 1]], -1)
    rim = [((outer[-1, 0] + inner[-1, 0]) / 2, outer[-1, 1] + 0.4 * thickness)]
    floor = [(0.0, inner[0, 1])]
    profile = refined(np.vstack([outer, rim, inner[::-1], floor]), 0.09)
    return loft(profile, circle(segments) if outline is None else outline)


def _outline(rng: np.random.Generator, plain_share: float = 0.6) -> np.ndarray:
    """Draw a cross section for `loft`: a circle with probability `plain_share`, else one with lobes."""
    if rng.uniform() < plain_share:
        return circle(48)
    lobes, depth = int(rng.integers(4, 13)), rng.uniform(0.02, 0.1)
    angle = 2 * np.pi * np.arange(96) / 96
    wave = np.abs(np.cos(lobes * angle / 2)) if rng.uniform() < 0.4 else 0.5 + 0.5 * np.cos(lobes * angle)
    return circle(96) * (1 - depth + depth * wave)[:, None]


def body_curve(
    rng: np.random.Generator, height: float, foot: float, belly: float, neck: float, rim: float, count: int = 28
) -> np.ndarray:
    """Draw a vessel's contour (2 + count, 2) of radius and height, through radii of foot, belly, neck and rim."""
    where = np.sort(rng.uniform([0.2, 0.65], [0.5, 0.88]))
    curve = smooth_curve(
        [(foot, 0.02 * height), (belly, where[0] * height), (neck, where[1] * height), (rim, height)], count
    )
    return np.vstack([(0, 0), (foot * 0.92, 0), curve])


def _handle(rng: np.random.Generator, start: ArrayLike, end: ArrayLike, bulge: float, radius: float) -> Part:
    """Make a handle between two points that bulges by `bulge` in x."""
    first, last = np.asarray(start, float), np.asarray(end, float)
    t = np.linspace(0, 1, 22)
    out = np.sin(np.pi * t) ** rng.uniform(0.5, 1.0)
    path = first + (last - first) * t[:, None] + np.array([bulge, 0, 0]) * out[:, None]
    outline = circle(14) * np.array([1.0, rng.uniform(0.8, 1.8)])
    return tube(path, radius, outline=outline)


def vase(rng: np.random.Generator) -> Assembly:
    """Make a vase, perhaps with handles and metal rims."""
    a, height = Assembly(), rng.uniform(0.9, 1.8)
    curve = body_curve(
        rng, height, rng.uniform(0.15, 0.35), rng.uniform(0.3, 0.6), rng.uniform(0.1, 0.3), rng.uniform(0.15, 0.42)
    )
    finish = tiles.pick(rng, "ceramic" if rng.uniform() < 0.7 else "any")
    part = walled(curve, 0.035, outline=_outline(rng))
    a.add(part, finish)
    if rng.uniform() < 0.35:
        y0, y1 = height * rng.uniform(0.4, 0.55), height * rng.uniform(0.75, 0.95)
        r0, r1 = (float(np.interp(y, curve[2:, 1], curve[2:, 0])) - 0.02 for y in (y0, y1))
        a.add_pair(_handle(rng, (r0, y0, 0), (r1, y1, 0), rng.uniform(0.1, 0.25), 0.035), finish)
    if rng.uniform() < 0.4:
        trim = tiles.pick(rng, "metal")
        for y in [height * 0.02, height] if rng.uniform() < 0.5 else [height]:
            r = np.interp(y, curve[2:, 1], curve[2:, 0]) + 0.005
            angle = 2 * np.pi * np.arange(48) / 48
            a.add(
                tube(
                    np.stack([r * np.cos(angle), np.full(48, y), r * np.sin(angle)], -1),
                    0.028,
                    closed=True,
                    outline=circle(10),
                ),
                trim,
            )
    return a


def bottle(rng: np.random.Generator) -> Assembly:
    """Make a bottle with a cap, perhaps with a label."""
    a, height, r = Assembly(), rng.uniform(1.2, 1.9), rng.uniform(0.22, 0.42)
    neck, shoulder = r * rng.uniform(0.25, 0.5), rng.uniform(0.5, 0.7)
    knots = [
        (r, 0.04),
        (r, height * shoulder * 0.8),
        (r * 0.95, height * shoulder),
        (neck, height * (shoulder + 0.16)),
        (neck * 0.95, height),
    ]
    curve = np.vstack([(0, 0), (r * 0.9, 0), smooth_curve(knots, 36), (0, height)])
    square = rng.uniform() < 0.3
    outline = np.sign(circle(48)) * np.abs(circle(48)) ** 0.45 if square else circle(48)
    a.add(loft(refined(curve, 0.08), outline), tiles.pick(rng, "ceramic"))
    label = tiles.pick(rng, "any")
    band = [(0, 0), (r * 1.02, 0), (r * 1.02, height * shoulder * 0.5), (0, height * shoulder * 0.5)]
    if rng.uniform() < 0.7:
        a.add(loft(refined(band, 0.06), outline).moved(y=height * shoulder * 0.18), label)
    cap = cylinder(neck * 1.2, height * rng.uniform(0.06, 0.12)).moved(y=height)
    a.add(cap, tiles.pick(rng, "paint"))
    return a


def cup(rng: np.random.Generator) -> Assembly:
    """Make a cup with a handle, perhaps with a drink and a saucer."""
    a, height = Assembly(), rng.uniform(0.7, 1.2)
    rim = rng.uniform(0.35, 0.5)
    foot = rim * rng.uniform(0.55, 1.0)
    curve = np.vstack(
        [
            (0, 0),
            (foot * 0.93, 0),
            smooth_curve([(foot, 0.03), ((foot + rim) / 2 * rng.uniform(0.95, 1.12), height * 0.5), (rim, height)], 20),
        ]
    )
    finish = tiles.pick(rng, "ceramic" if rng.uniform() < 0.75 else "any")
    a.add(walled(curve, 0.04), finish)
    handle = finish if rng.uniform() < 0.7 else tiles.pick(rng, "ceramic")
    a.add(
        _handle(
            rng,
            (foot * 0.98, height * 0.2, 0),
            (rim * 0.95, height * 0.82, 0),
            rng.uniform(0.18, 0.3),
            rng.uniform(0.035, 0.05),
        ),
        handle,
    )
    if rng.uniform() < 0.6:
        inner = float(np.interp(height * 0.85, curve[2:, 1], curve[2:, 0])) - 0.03
        a.add(
            cylinder(inner, 0.03, count=48).moved(y=height * 0.85),
            finishes.glossy(rng, colors.hsv(rng.uniform(0.03, 0.12), 0.7, rng.uniform(0.15, 0.8))),
        )
    if rng.uniform() < 0.3:
        r = rim * 1.7
        a.add(
            loft(
                refined([(0, -0.06), (r * 0.5, -0.06), (r, 0.03), (r, 0.06), (r * 0.5, -0.02), (0, -0.02)], 0.06),
                circle(48),
            ),
            finish,
        )
    return a


def teapot(rng: np.random.Generator) -> Assembly:
    """Make a teapot with spout and handle, or a kettle with its handle over the top."""
    a = Assembly()
    height, r = rng.uniform(0.6, 1.0), rng.uniform(0.45, 0.6)
    top = r * rng.uniform(0.4, 0.7)
    kettle = rng.uniform() < 0.4
    finish = tiles.pick(rng, "metal" if kettle and rng.uniform() < 0.6 else "ceramic")
    curve = smooth_curve([(r * rng.uniform(0.6, 1.0), 0.02), (r, height * rng.uniform(0.25, 0.5)), (top, height)], 24)
    a.add(loft(refined(np.vstack([(0, 0), (curve[0, 0] * 0.95, 0), curve, (0, height)]), 0.07), circle(56)), finish)
    lid = finish if rng.uniform() < 0.6 else tiles.pick(rng, "ceramic")
    dome = rng.uniform(0.08, 0.22)
    a.add(
        loft(
            refined(
                [
                    (0, height - 0.02),
                    (top * 1.04, height - 0.02),
                    (top * 1.04, height + 0.02),
                    (top * 0.75, height + dome * 0.7),
                    (0, height + dome),
                ],
                0.05,
            ),
            circle(40),
        ),
        lid,
    )
    a.add(
        ball(rng.uniform(0.06, 0.1), rng.uniform(0.06, 0.12), None, 20).moved(y=height + dome + 0.05),
        lid if rng.uniform() < 0.5 else tiles.pick(rng, "wood"),
    )
    side = 1 if rng.uniform() < 0.5 else -1
    t = np.linspace(0, 1, 18)
    y0, y1 = height * rng.uniform(0.25, 0.45), height * rng.uniform(0.85, 1.1)
    path = np.stack([r * 0.8 + 0.5 * r * t + 0.35 * r * t**3, y0 + (y1 - y0) * t**1.4, 0 * t], -1)
    a.add(tube(path, np.linspace(0.15, 0.06, 18), outline=circle(20)).scaled(side, 1, 1), finish)
    handle = finish if rng.uniform() < 0.5 else tiles.pick(rng, "wood")
    if kettle:
        bow = np.linspace(-0.1, np.pi + 0.1, 26)
        rise = height + rng.uniform(0.25, 0.5)
        a.add(
            tube(
                np.stack([r * 0.75 * np.cos(bow), height * 0.8 + (rise - height * 0.8) * np.sin(bow), 0 * bow], -1),
                0.045,
            ),
            handle,
        )
    else:
        a.add(
            _handle(rng, (r * 0.9, height * 0.2, 0), (r * 0.8, height * 0.8, 0), rng.uniform(0.25, 0.4), 0.05).scaled(
                -side, 1, 1
            ),
            handle,
        )
    return a


def bowl(rng: np.random.Generator) -> Assembly:
    """Make a bowl, perhaps with fruit."""
    a, height, rim = Assembly(), rng.uniform(0.25, 0.6), rng.uniform(0.5, 0.7)
    foot = rim * rng.uniform(0.3, 0.6)
    curve = np.vstack(
        [(0, 0), (foot, 0), smooth_curve([(foot * 1.02, 0.03), (rim * 0.85, height * 0.5), (rim, height)], 20)]
    )
    a.add(walled(curve, 0.04, outline=_outline(rng)), tiles.pick(rng, "ceramic" if rng.uniform() < 0.6 else "any"))
    fruit = [
        tiles.pick(rng, "skin", colors.hsv(h, 0.85, 0.85))
        for h in rng.choice([0.0, 0.02, 0.09, 0.15, 0.25, 0.3, 0.8], 3)
    ]
    for _ in range(int(rng.integers(0, 8))):
        size, angle, reach = rng.uniform(0.12, 0.2), rng.uniform(0, 2 * np.pi), rng.uniform(0, rim * 0.55)
        y = height * (0.75 + 0.5 * (1 - reach / rim))
        a.add(
            ball(size, size * rng.uniform(0.85, 1.1), None, 24).moved(reach * np.cos(angle), y, reach * np.sin(angle)),
            fruit[rng.integers(3)],
        )
    return a


def goblet(rng: np.random.Generator) -> Assembly:
    """Make a goblet: foot, stem, bowl."""
    a, height = Assembly(), rng.uniform(1.2, 1.8)
    base, stem, rim = rng.uniform(0.3, 0.42), rng.uniform(0.04, 0.09), rng.uniform(0.28, 0.45)
    knot = rng.uniform(0.35, 0.5) * height
    curve = smooth_curve(
        [
            (base, 0.04),
            (stem * 1.6, 0.12 * height),
            (stem, 0.25 * height),
            (stem * rng.uniform(1, 2.6), 0.32 * height),
            (stem * 1.2, knot),
            (rim * rng.uniform(0.9, 1.2), knot + 0.25 * height),
            (rim, height),
        ],
        48,
    )
    outer = np.vstack([(0, 0), (base, 0), curve])
    inside = curve[curve[:, 1] > knot + 0.08 * height][::-1] - np.array([0.035, 0])
    profile = np.vstack([outer, inside[inside[:, 0] > 0.02], (0, knot + 0.1 * height)])
    a.add(
        loft(refined(profile, 0.08), _outline(rng, 0.8)), tiles.pick(rng, "metal" if rng.uniform() < 0.6 else "ceramic")
    )
    return a


def lamp(rng: np.random.Generator) -> Assembly:
    """Make a table lamp: foot, stem, shade."""
    a, stem = Assembly(), rng.uniform(0.7, 1.2)
    finish = tiles.pick(rng, "metal" if rng.uniform() < 0.5 else "ceramic")
    belly = rng.uniform(0.08, 0.35)
    curve = smooth_curve([(0.3, 0.05), (0.1, 0.12), (belly, stem * rng.uniform(0.3, 0.6)), (0.05, stem)], 30)
    a.add(loft(refined(np.vstack([(0, 0), (0.3, 0), curve, (0, stem)]), 0.07), _outline(rng, 0.8)), finish)
    low, high, tall = rng.uniform(0.35, 0.55), rng.uniform(0.12, 0.35), rng.uniform(0.35, 0.6)
    y = stem - tall * 0.25
    profile = [(0, y + 0.1), (low - 0.03, y), (low, y), (high, y + tall), (high - 0.03, y + tall), (0, y + tall - 0.03)]
    a.add(loft(refined(profile, 0.06), _outline(rng, 0.7)), tiles.pick(rng, "cloth"))
    return a


def candle(rng: np.random.Generator) -> Assembly:
    """Make one candle or three on a stand."""
    a, count = Assembly(), int(rng.choice([1, 1, 3]))
    stand = tiles.pick(rng, "metal")
    wax = finishes.plastic(rng, colors.any_color(rng))
    flame = finishes.glossy(rng, colors.hsv(0.1, 0.8, 1.0))
    for i in range(count):
        x = (i - (count - 1) / 2) * 0.45
        y = 0.5 + (0.15 if count == 3 and i == 1 else 0.0)
        r, tall = rng.uniform(0.08, 0.13), rng.uniform(0.4, 0.8)
        a.add(cylinder(r, tall).moved(x, y + tall / 2 + 0.05, 0), wax)
        a.add(ball(0.04, 0.09, 0.04, 16).moved(x, y + tall + 0.13, 0), flame)
        a.add(
            loft(
                refined([(0, y), (r * 1.3, y), (r * 1.7, y + 0.08), (r * 1.6, y + 0.1), (0, y + 0.05)], 0.05),
                circle(32),
            ),
            stand,
        )
        if x:
            a.add(tube(np.array([(0, 0.25, 0), (x * 0.6, 0.3, 0), (x, 0.38, 0), (x, 0.52, 0)]), 0.035), stand)
    a.add(
        loft(
            refined(
                np.vstack(
                    [
                        (0, 0),
                        (0.32, 0),
                        smooth_curve([(0.32, 0.04), (0.08, 0.12), (0.05, 0.3), (0.07, 0.5)], 20),
                        (0, 0.52),
                    ]
                ),
                0.07,
            ),
            circle(40),
        ),
        stand,
    )
    if count == 3:
        a.add(cylinder(0.045, 0.25).moved(y=0.58), stand)
    return a


def barrel(rng: np.random.Generator) -> Assembly:
    """Make a barrel, drum, jar or tin: a bulging body with hoops, perhaps a lid."""
    a, height, r = Assembly(), rng.uniform(0.9, 1.4), rng.uniform(0.35, 0.5)
    bulge = r * rng.uniform(1.0, 1.25)
    theme = ["wood", "paint", "ceramic", "metal"][rng.integers(4)]
    curve = smooth_curve([(r, 0.02), (bulge, height / 2), (r, height - 0.02)], 22)
    a.add(
        loft(
            refined(
                np.vstack(
                    [
                        (0, 0.04),
                        (r * 0.9, 0.04),
                        (r * 0.93, 0),
                        curve,
                        (r * 0.93, height),
                        (r * 0.9, height - 0.04),
                        (0, height - 0.04),
                    ]
                ),
                0.07,
            ),
            circle(48),
        ),
        tiles.pick(rng, theme),
    )
    hoop = tiles.pick(rng, "metal")
    shares: tuple[list[float], ...] = ([0.12, 0.3, 0.7, 0.88], [0.2, 0.8], [0.33, 0.66], [])
    for share in shares[rng.integers(4)]:
        radius = float(np.interp(share * height, curve[:, 1], curve[:, 0])) + 0.012
        profile = [(0, -0.035), (radius, -0.035), (radius, 0.035), (0, 0.035)]
        a.add(loft(refined(profile, 0.08), circle(48)).moved(y=share * height), hoop)
    if rng.uniform() < 0.4:
        a.add(
            loft(
                refined([(0, 0), (r * 1.08, 0), (r * 1.08, 0.06), (r * 0.5, 0.12), (0, 0.13)], 0.06), circle(48)
            ).moved(y=height - 0.01),
            tiles.pick(rng, theme),
        )
        a.add(ball(0.08, 0.07, None, 20).moved(y=height + 0.16), hoop)
    return a


KINDS = {
    "vase": vase,
    "bottle": bottle,
    "cup": cup,
    "teapot": teapot,
    "bowl": bowl,
    "goblet": goblet,
    "lamp": lamp,
    "candle": candle,
    "barrel": barrel,
}
