"""Make toy vehicles that drive toward +Z: cars, trucks, trains, boats, aeroplanes, rockets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gdtool.assets.procedural import colors, finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.parts import ball, box, circle, cone, cylinder, loft, refined, smooth_curve


def wheels(
    a: Assembly, rng: np.random.Generator, x: float, y: float, zs: Sequence[float], r: float, width: float
) -> None:
    """Add a pair of wheels of radius r at +x and -x for each z in zs."""
    tire, hub = finishes.matte(rng, np.full(3, rng.uniform(0.01, 0.06))), finishes.metal(rng)
    t = np.linspace(-np.pi / 2, np.pi / 2, 9)
    profile = np.vstack(
        [
            (0, -width / 2),
            np.stack([r - 0.25 * width + 0.25 * width * np.cos(t), width / 2 * np.sin(t)], -1),
            (0, width / 2),
        ]
    )
    part = loft(profile, circle(36)).turned("z", 90)
    disc = cylinder(r * 0.6, width * 0.2, 0.02, 28).turned("z", 90)
    for z in zs:
        a.add_pair(part.moved(x, y, z), tire)
        a.add_pair(disc.moved(x + width * 0.5, y, z), hub)


def car(rng: np.random.Generator) -> Assembly:
    """Make a car: body, cabin, windows, wheels."""
    a = Assembly()
    w, length, r = rng.uniform(0.26, 0.36), rng.uniform(0.6, 0.85), rng.uniform(0.13, 0.19)
    low, cab = rng.uniform(0.16, 0.26), rng.uniform(0.15, 0.28)
    paint, dark = tiles.pick(rng, "paint"), finishes.plastic(rng, np.full(3, 0.03))
    glass = finishes.glossy(rng, colors.hsv(0.58, 0.3, rng.uniform(0.1, 0.4)))
    shift = rng.uniform(-0.2, 0.05)
    body = solids.block((0, 0, 0), (w, low, length), rng.uniform(0.06, 0.14))
    roof = solids.block(
        (0, low + cab * 0.6, shift), (w * rng.uniform(0.75, 0.92), cab, length * rng.uniform(0.35, 0.6)), 0.11
    )
    shell = solids.blended([body, roof], rng.uniform(0.03, 0.15))
    for z in (length * 0.6, -length * 0.6):
        shell = solids.carved(shell, solids.rod((0, -low, z), r * 1.15, 2.0, "x"), 0.02)
    a.add(solids.polygonised(shell, 64), paint)
    # The windows are boxes lower than the cabin that reach beyond it in z or in x.
    for half in ((w * 0.7, cab * 0.5, length * 0.62), (w * 0.97, cab * 0.5, length * 0.36)):
        a.add(solids.polygonised(solids.block((0, low + cab * 0.75, shift), half, 0.07), 34), glass)
    wheels(a, rng, w * 0.95, -low, (length * 0.6, -length * 0.6), r, rng.uniform(0.1, 0.15))
    lamp = finishes.glossy(rng, colors.hsv(0.15, 0.2, 1.0))
    a.add_pair(ball(0.07, 0.06, 0.05, 20).moved(w * 0.62, 0.04, length * 0.97), lamp)
    a.add_pair(
        box(0.12, 0.06, 0.05).moved(w * 0.62, 0.04, -length * 0.99), finishes.glossy(rng, colors.hsv(0.0, 0.9, 0.7))
    )
    a.add(box(w * 0.8, low * 0.5, 0.05).moved(0, -0.05, length), tiles.pick(rng, "metal"))
    for z in (length, -length):
        a.add(
            box(w * 1.9, 0.07, 0.1, 0.02).moved(0, -low * 0.75, z), finishes.metal(rng) if rng.uniform() < 0.5 else dark
        )
    return a


def truck(rng: np.random.Generator) -> Assembly:
    """Make a truck: cabin, wheels, and a box, a tank or an open bed with a load."""
    a = Assembly()
    w, cab, bed, r = rng.uniform(0.26, 0.34), rng.uniform(0.35, 0.5), rng.uniform(0.7, 1.1), rng.uniform(0.13, 0.18)
    paint, dark = tiles.pick(rng, "paint"), finishes.plastic(rng, np.full(3, 0.03))
    front = bed * 0.5 + cab * 0.55
    tall = rng.uniform(0.5, 0.65)
    a.add(box(w * 1.5, 0.1, bed + cab, 0.02).moved(0, 0.0, cab * 0.25), dark)
    a.add(solids.polygonised(solids.block((0, tall / 2, front), (w, tall / 2, cab / 2), 0.07), 40), paint)
    glass = finishes.glossy(rng, colors.hsv(0.58, 0.3, rng.uniform(0.1, 0.4)))
    a.add(box(w * 1.6, tall * 0.32, 0.05).moved(0, tall * 0.68, front + cab / 2 - 0.01), glass)
    a.add(box(w * 2.03, tall * 0.3, cab * 0.45).moved(0, tall * 0.68, front + 0.03), glass)
    kind = rng.integers(3)
    if kind == 0:
        a.add(
            box(w * 2.1, tall * rng.uniform(0.9, 1.4), bed, 0.03, 10).moved(0, tall * 0.6, -0.08),
            tiles.pick(rng, "any"),
        )
    elif kind == 1:
        a.add(
            cylinder(w * 0.95, bed, 0.08, 44).turned("x", 90).moved(0, w * 0.95 + 0.05, -0.08), tiles.pick(rng, "paint")
        )
    else:
        side = tiles.pick(rng, "paint")
        a.add_pair(box(0.05, 0.28, bed).moved(w, 0.18, -0.08), side)
        for z in (bed / 2 - 0.1, -bed / 2 - 0.06):
            a.add(box(2 * w, 0.28, 0.05).moved(0, 0.18, z), side)
        load = tiles.pick(rng, "any")
        for _ in range(int(rng.integers(3, 9))):
            a.add(
                ball(rng.uniform(0.1, 0.16), count=20).moved(
                    rng.uniform(-0.6, 0.6) * w, rng.uniform(0.15, 0.35), rng.uniform(-0.35, 0.25) * bed
                ),
                load,
            )
    wheels(a, rng, w * 0.95, -0.05, (front, -bed * 0.2, -bed * 0.45), r, 0.12)
    a.add_pair(
        ball(0.06, 0.05, 0.04, 16).moved(w * 0.65, 0.15, front + cab / 2),
        finishes.glossy(rng, colors.hsv(0.15, 0.2, 1.0)),
    )
    a.add(box(w * 1.0, 0.14, 0.05).moved(0, 0.15, front + cab / 2), finishes.metal(rng))
    return a


def train(rng: np.random.Generator) -> Assembly:
    """Make a steam engine: boiler, chimney, domes, cabin, cow-catcher."""
    a, paint, metal = Assembly(), tiles.pick(rng, "paint"), tiles.pick(rng, "metal")
    r, length = rng.uniform(0.2, 0.28), rng.uniform(0.8, 1.1)
    a.add(cylinder(r, length, 0.03, 44).turned("x", 90).moved(0, 0.32, 0.15), paint)
    a.add(box(0.55, 0.1, length * 1.6).moved(0, 0.08, -0.05), finishes.matte(rng, np.full(3, 0.03)))
    for z in np.linspace(-0.2, 0.5, 3) * length:
        a.add(cylinder(r * 1.03, 0.05, 0.01, 44).turned("x", 90).moved(0, 0.32, 0.15 + z * 0.9), metal)
    a.add(box(0.54, 0.62, 0.42, 0.03).moved(0, 0.42, -length * 0.55), tiles.pick(rng, "paint"))
    a.add(box(0.66, 0.06, 0.54, 0.02).moved(0, 0.75, -length * 0.55), paint)
    a.add(box(0.56, 0.2, 0.22).moved(0, 0.55, -length * 0.55), finishes.glossy(rng, colors.hsv(0.58, 0.3, 0.15)))
    front = 0.15 + length / 2
    a.add(
        loft(refined([(0, 0), (0.07, 0), (0.07, 0.2), (0.13, 0.3), (0.13, 0.34), (0, 0.34)], 0.05), circle(32)).moved(
            0, 0.3 + r * 0.8, front - 0.15
        ),
        metal,
    )
    a.add(ball(0.1, 0.13, None, 24).moved(0, 0.32 + r, 0.1), metal)
    a.add(cylinder(r * 0.75, 0.06, 0.02, 36).turned("x", 90).moved(0, 0.32, front), finishes.metal(rng))
    a.add(ball(0.07, count=20).moved(0, 0.32 + r * 0.9, front), finishes.glossy(rng, colors.hsv(0.14, 0.3, 1)))
    wheels(a, rng, 0.27, 0.0, (0.45 * length, 0.1, -0.3 * length), rng.uniform(0.15, 0.2), 0.07)
    a.add(cone(0.3, 0.35, 4).scaled(1, 1, 0.5).turned("x", 55).moved(0, -0.02, front), metal)
    return a


def boat(rng: np.random.Generator) -> Assembly:
    """Make a sailing boat, or a steamer with cabins and funnels."""
    a, hull = Assembly(), tiles.pick(rng, "paint" if rng.uniform() < 0.6 else "wood")
    w, length, tall = rng.uniform(0.25, 0.38), rng.uniform(0.7, 0.9), rng.uniform(0.25, 0.35)
    body = solids.common(
        [
            solids.ellipsoid((0, tall * 0.4, -0.1), (w, tall * 1.4, length)),
            lambda p: p[:, 1] - tall * 0.4,
            solids.block((0, 0, 0.12), (1, 1, length), 0.02),
        ],
        0.03,
    )
    deck = solids.ellipsoid((0, tall * 0.95, -0.1), (w * 0.85, tall, length * 0.88))
    a.add(solids.polygonised(solids.carved(body, deck, 0.02), 64), hull)
    kind = rng.integers(2)
    if kind == 0:
        mast = tiles.pick(rng, "wood")
        a.add(cylinder(0.025, 1.3).moved(0, tall * 0.4 + 0.5, 0), mast)
        sail = solids.common(
            [
                solids.ellipsoid((0.0, 0.0, 0.0), (0.62, 0.75, 0.09)),
                lambda p: np.abs(p[:, 1]) - 0.45,
                lambda p: np.abs(p[:, 0]) - 0.42,
            ],
            0.03,
        )
        cloth = tiles.pick(rng, "cloth")
        a.add(solids.polygonised(sail, 44).turned("y", rng.uniform(-60, 60)).moved(0.0, tall * 0.4 + 0.62, 0.06), cloth)
        a.add(box(0.2, 0.1, 0.01, 0.003).moved(0.1, tall * 0.4 + 1.15, 0), tiles.pick(rng, "cloth"))
    else:
        y = tall * 0.3
        a.add(box(w * 1.0, 0.4, length * 0.7, 0.03).moved(0, y + 0.1, -0.15), tiles.pick(rng, "paint"))
        a.add(box(w * 0.7, 0.24, length * 0.4, 0.03).moved(0, y + 0.4, -0.1), tiles.pick(rng, "paint"))
        a.add(
            box(w * 0.74, 0.08, length * 0.35, 0.01).moved(0, y + 0.44, -0.09),
            finishes.glossy(rng, colors.hsv(0.58, 0.3, 0.15)),
        )
        for z in (-0.15, -0.4)[: int(rng.integers(1, 3))]:
            a.add(cylinder(0.08, 0.36, top_radius=0.07).moved(0, y + 0.6, z), tiles.pick(rng, "paint"))
    return a


def aeroplane(rng: np.random.Generator) -> Assembly:
    """Make an aeroplane with propellers or jets: fuselage, wings, tail, perhaps wheels."""
    a, paint, wing = Assembly(), tiles.pick(rng, "paint"), tiles.pick(rng, "paint")
    r, span, sweep = rng.uniform(0.11, 0.18), rng.uniform(0.7, 1.0), rng.uniform(0, 30)
    knots = [(0.02, -0.95), (r * 0.5, -0.6), (r, -0.1), (r, 0.45), (r * 0.7, 0.7), (0.03, 0.85)]
    curve = smooth_curve(knots, 36)
    a.add(loft(np.vstack([(0, -0.95), curve, (0, 0.86)]), circle(40)).turned("x", 90), paint)
    y = rng.choice([-0.4, 0.0, 0.9]) * r
    half = ball(span / 2, 0.03, rng.uniform(0.13, 0.2), 36).moved(span / 2 - 0.05, 0, 0)
    a.add_pair(half.turned("y", sweep).turned("z", rng.uniform(0, 6)).moved(0, y, 0.15), wing)
    a.add_pair(ball(0.2, 0.02, 0.09, 24).moved(0.17, 0, 0).turned("y", sweep).moved(0, 0.05, -0.8), wing)
    a.add(ball(0.02, 0.22, 0.12, 24).turned("x", -20).moved(0, 0.2, -0.82), wing)
    a.add(ball(r * 0.7, r * 0.7, 0.2, 26).moved(0, r * 0.75, 0.3), finishes.glossy(rng, colors.hsv(0.56, 0.4, 0.25)))
    metal = finishes.metal(rng)
    if rng.uniform() < 0.5:
        for turn in (0, 90) if rng.uniform() < 0.4 else (20,):
            a.add(ball(0.03, 0.36, 0.02, 24).turned("z", turn).moved(0, 0, 0.88), metal)
        a.add(cone(0.05, 0.12, 20).turned("x", 90).moved(0, 0, 0.84), metal)
    else:
        a.add_pair(cylinder(0.07, 0.3, 0.02, 28).turned("x", 90).moved(span * 0.42, y - 0.09, 0.18), metal)
    if rng.uniform() < 0.5:
        wheels(a, rng, r + 0.04, -r - 0.14, (0.3,), 0.08, 0.05)
        a.add_pair(cylinder(0.02, 0.2).moved(r * 0.8, -r - 0.05, 0.3), metal)
    return a


def rocket(rng: np.random.Generator) -> Assembly:
    """Make a rocket: body, nose, fins, a porthole."""
    a, paint, fin = Assembly(), tiles.pick(rng, "paint"), tiles.pick(rng, "paint")
    r, tall = rng.uniform(0.2, 0.32), rng.uniform(1.3, 1.7)
    curve = smooth_curve([(r * 0.7, 0.0), (r, tall * 0.35), (r * 0.85, tall * 0.65), (0.02, tall)], 36)
    a.add(loft(np.vstack([(0, 0), curve, (0, tall * 1.003)]), circle(48)), paint)
    cut = tall * 0.72
    nose = curve[curve[:, 1] > cut] + np.array([0.006, 0.004])
    a.add(loft(np.vstack([(0, nose[0, 1]), nose, (0, tall * 1.012)]), circle(48)), fin)
    count = int(rng.choice([3, 4]))
    for k in range(count):
        a.add(
            ball(0.025, 0.34, 0.26, 26)
            .turned("x", 30)
            .moved(0, 0.12, r * 0.95)
            .turned("y", 360 * k / count + 180 / count * (count == 4)),
            fin,
        )
    y = tall * 0.55
    hull = float(np.interp(y, curve[:, 1], curve[:, 0]))  # its radius at the porthole
    a.add(cylinder(0.13, 0.08, 0.02, 32).turned("x", 90).moved(0, y, hull - 0.01), finishes.metal(rng))
    a.add(
        cylinder(0.095, 0.08, 0.02, 32).turned("x", 90).moved(0, y, hull + 0.01),
        finishes.glossy(rng, colors.hsv(0.56, 0.5, 0.3)),
    )
    a.add(
        loft(refined([(0, -0.16), (r * 0.55, -0.16), (r * 0.4, 0.02), (0, 0.02)], 0.05), circle(36)),
        tiles.pick(rng, "metal"),
    )
    return a


KINDS = {"car": car, "truck": truck, "train": train, "boat": boat, "aeroplane": aeroplane, "rocket": rocket}
