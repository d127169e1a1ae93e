"""Make abstract shapes: CSG solids, supershapes, knots, gears, prisms, stacked primitives, blobs."""

from __future__ import annotations

import numpy as np

from gdtool.assets.procedural import patterns, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.parts import (
    ball,
    box,
    circle,
    cone,
    cylinder,
    extrusion,
    grid_part,
    loft,
    refined,
    subdivided,
    tube,
)


def csg(rng: np.random.Generator) -> Assembly:
    """Combine blocks, rods, balls and rings, mirrored in x, by union, difference and intersection."""

    def primitive(spread: float) -> solids.Distance:
        """Draw a primitive whose centre lies within `spread` of the origin in each axis."""
        c = rng.uniform(-spread, spread, 3)
        kind = rng.integers(4)
        if kind == 0:
            return solids.block(c, rng.uniform(0.2, 0.55, 3), rng.uniform(0.02, 0.1))
        if kind == 1:
            return solids.rod(c, rng.uniform(0.15, 0.4), rng.uniform(0.2, 0.7), "xyz"[rng.integers(3)])
        if kind == 2:
            return solids.ellipsoid(c, rng.uniform(0.25, 0.55, 3))
        return solids.ring(c, rng.uniform(0.3, 0.5), rng.uniform(0.08, 0.18), "xyz"[rng.integers(3)])

    a, width = Assembly(), rng.choice([0.02, 0.02, 0.1, 0.2])
    core = solids.blended(
        [
            solids.block((0, 0, 0), rng.uniform(0.3, 0.6, 3), 0.05),
            *[solids.both_sides(primitive(0.5)) for _ in range(rng.integers(1, 4))],
        ],
        width,
    )
    body = core
    for _ in range(int(rng.integers(1, 4))):
        body = solids.carved(body, solids.both_sides(primitive(0.7)), rng.choice([0.02, 0.06]))
    if rng.uniform() < 0.25:
        body = solids.common([core, solids.ellipsoid((0, 0, 0), rng.uniform(0.5, 0.8))], 0.03)
    a.add(solids.polygonised(body, 60, 1.8), tiles.pick(rng))
    if rng.uniform() < 0.5:
        a.add_pair(ball(rng.uniform(0.1, 0.25), count=28).moved(*rng.uniform(0.1, 0.6, 3)), tiles.pick(rng))
    return a


def supershape(rng: np.random.Generator) -> Assembly:
    """Make a closed surface from Gielis' superformula in two angles, perhaps on a base."""

    def radius(angle: np.ndarray, m: int, n1: float, n2: float, n3: float) -> np.ndarray:
        """Evaluate the superformula."""
        return (np.abs(np.cos(m * angle / 4)) ** n2 + np.abs(np.sin(m * angle / 4)) ** n3) ** (-1 / n1)

    a = Assembly()
    m1, m2 = int(rng.choice([0, 2, 3, 4, 5, 6, 8, 12])), int(rng.choice([0, 2, 4, 6]))
    n = rng.uniform(0.6, 4.0, 2), rng.uniform(0.6, 4.0, 2)
    theta, phi = -np.pi + 2 * np.pi * np.arange(120) / 120, np.linspace(-np.pi / 2, np.pi / 2, 64)
    r1 = np.clip(radius(theta, m1, n[0][0], n[0][1], n[0][1]), 0.3, 3)
    r2 = np.clip(radius(phi, m2, n[1][0], n[1][1], n[1][1]), 0.3, 3)
    r1, r2 = r1 / r1.max(), r2 / r2.max()
    flat = np.cos(phi) * r2
    flat[[0, -1]] = 0
    points = np.stack(
        [
            flat[:, None] * r1 * np.cos(theta),
            np.broadcast_to((r2 * np.sin(phi))[:, None], (64, 120)),
            flat[:, None] * r1 * np.sin(theta),
        ],
        -1,
    )
    a.add(grid_part(points * rng.uniform(0.6, 1.0, 3), crease_degrees=60), tiles.pick(rng))
    if rng.uniform() < 0.4:
        a.add(cylinder(0.4, 0.12).moved(y=-0.9), tiles.pick(rng))
    return a


def knot(rng: np.random.Generator) -> Assembly:
    """Make a tube along a torus knot or ring, perhaps with a ball in its middle."""
    a, t = Assembly(), 2 * np.pi * np.arange(220) / 220
    p, q = [(1, 0), (2, 3), (3, 2), (2, 5), (1, 4), (3, 4)][rng.integers(6)]
    r = 0.45 + rng.uniform(0.12, 0.25) * np.cos(q * t)
    path = np.stack([r * np.cos(p * t), r * np.sin(p * t), 0.25 * np.sin(q * t)], -1)
    outline = circle(20) if rng.uniform() < 0.6 else subdivided(circle(int(rng.integers(3, 6))), 5)
    a.add(
        tube(path, rng.uniform(0.07, 0.14), closed=True, outline=outline).turned("x", rng.choice([0, 90, 20])),
        tiles.pick(rng),
    )
    if rng.uniform() < 0.4:
        a.add(ball(rng.uniform(0.15, 0.3), count=30), tiles.pick(rng))
    return a


def gear(rng: np.random.Generator) -> Assembly:
    """Make a gear, star or cog that stands up, with a hub and pins."""
    a, teeth, depth = Assembly(), int(rng.integers(5, 18)), rng.uniform(0.1, 0.4)
    k = np.arange(teeth * 8) % 8
    step = (
        np.array([0, 0, 0.5, 1, 1, 1, 0.5, 0])[k]
        if rng.uniform() < 0.7
        else np.array([0, 0.25, 0.5, 0.75, 1, 0.75, 0.5, 0.25])[k]
    )
    outline = circle(teeth * 8) * (0.8 * (1 - depth + depth * step))[:, None]
    thick, finish = rng.uniform(0.15, 0.5), tiles.pick(rng, "metal" if rng.uniform() < 0.5 else "any")
    a.add(extrusion(outline, thick, 0.02).moved(y=-thick / 2).turned("x", 90), finish)
    a.add(cylinder(rng.uniform(0.15, 0.3), thick * 1.5, 0.03, 40).turned("x", 90), tiles.pick(rng))
    pin = tiles.pick(rng, "metal")
    count = int(rng.integers(0, 7))
    for i in range(count):
        w = 2 * np.pi * i / count + np.pi / 2
        a.add(cylinder(0.06, thick * 1.25, 0.01, 24).turned("x", 90).moved(0.42 * np.cos(w), 0.42 * np.sin(w), 0), pin)
    return a


def prism(rng: np.random.Generator) -> Assembly:
    """Make a twisted or tapered prism over a random symmetric polygon, or a stack of up to three."""
    a, y = Assembly(), 0.0
    for _ in range(int(rng.integers(1, 4))):
        sides = int(rng.integers(3, 9))
        radii = 1 - rng.uniform(0, 0.45) * (np.arange(sides * 2) % 2)
        outline = subdivided(circle(sides * 2) * radii[:, None] * rng.uniform(0.3, 0.6), 4)
        tall, top = rng.uniform(0.3, 1.0), rng.uniform(0.3, 1.0)
        profile = refined([(0, 0), (0.95, 0), (1, 0.03), (top, tall - 0.02), (top * 0.95, tall), (0, tall)], 0.07)
        a.add(
            loft(profile, outline, 30, twist_degrees=rng.choice([0, 0, rng.uniform(-120, 120)])).moved(y=y),
            tiles.pick(rng),
        )
        y += tall
    return a


def stack(rng: np.random.Generator) -> Assembly:
    """Make a symmetric sculpture of two to five primitives."""
    a, y = Assembly(), 0.0
    for _ in range(int(rng.integers(2, 6))):
        s, finish = rng.uniform(0.2, 0.5), tiles.pick(rng)
        kind, turn = rng.integers(5), rng.choice([0, 0, 45])
        make, tall = [
            (lambda s: box(1.4 * s, 1.1 * s, 1.4 * s, 0.03, 10), 1.1 * s),
            (lambda s: ball(s, count=36), 2 * s),
            (lambda s: cylinder(s, s, count=44), s),
            (lambda s: cone(s, 1.6 * s, 40).moved(y=-0.8 * s), 1.6 * s),
            (
                lambda s: tube(
                    s * np.stack([np.cos(w := 2 * np.pi * np.arange(48) / 48), 0 * w, np.sin(w)], -1),
                    0.3 * s,
                    closed=True,
                    outline=circle(20),
                ),
                0.6 * s,
            ),
        ][kind]
        part = make(s).turned("y", turn).moved(y=y + tall / 2)
        if rng.uniform() < 0.35:
            a.add_pair(part.moved(s * rng.uniform(1.0, 1.5)), finish)
        else:
            a.add(part, finish)
            y += tall * rng.uniform(0.85, 1.0)
    return a


def blob(rng: np.random.Generator) -> Assembly:
    """Make a mirror-symmetric smooth blend of balls and limbs, perhaps with bumps."""
    a = Assembly()
    shapes = [solids.ellipsoid((0, 0, 0), rng.uniform(0.25, 0.45, 3))]
    for _ in range(int(rng.integers(2, 7))):
        d = rng.normal(size=3)
        end = d / np.linalg.norm(d) * rng.uniform(0.4, 0.95)
        shapes.append(
            solids.both_sides(
                solids.limb(
                    (0, 0, 0),
                    np.abs(end) * np.array([1, np.sign(end[1]), np.sign(end[2])]),
                    rng.uniform(0.1, 0.2),
                    rng.uniform(0.06, 0.25),
                )
            )
        )
    body, bump = solids.blended(shapes, rng.uniform(0.08, 0.25)), patterns.noise_field(rng, 1.5, 1.0)
    amount = np.float32(rng.choice([0.0, 0.02, 0.05]))
    a.add(
        solids.polygonised(
            lambda p: body(p) + amount * bump(np.abs(p) * np.array([1, 0, 0]) + p * np.array([0, 1, 1])), 56, 1.5
        ),
        tiles.pick(rng),
    )
    return a


KINDS = {"csg": csg, "supershape": supershape, "knot": knot, "gear": gear, "prism": prism, "stack": stack, "blob": blob}
