"""Make creatures with a face toward +Z: four-legged animals, birds, fish, turtles, dragons; figures.py adds people."""

from __future__ import annotations

import itertools

import numpy as np

from gdtool.assets.procedural import colors, finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.colors import hsv
from gdtool.assets.procedural.figures import figure
from gdtool.assets.procedural.heads import dress_head, ears, eyes, face, fur_color, horns
from gdtool.assets.procedural.parts import (
    Part,
    ball,
    circle,
    cone,
    extrusion,
    loft,
    subdivided,
    tube,
)


def quadruped(rng: np.random.Generator) -> Assembly:
    """Make a four-legged animal, from cat to elephant: body along z, legs, neck, head and tail in one blended solid."""
    a = Assembly()
    length, girth = rng.uniform(0.3, 0.6), rng.uniform(0.2, 0.36)
    leg, foot = rng.uniform(0.15, 0.55), girth * rng.uniform(0.22, 0.45)
    r = rng.uniform(0.2, 0.38)
    neck_y, neck_z = rng.uniform(0.0, 0.6), rng.uniform(0.1, 0.4)
    head = (0.0, girth * 0.5 + neck_y + 0.1, length + neck_z)
    spread = girth * rng.uniform(0.5, 0.75)
    body = [
        solids.ellipsoid(
            (0, 0, -length * 0.4), (girth * rng.uniform(0.8, 1.05), girth * rng.uniform(0.85, 1.1), length * 0.75)
        ),
        solids.ellipsoid((0, 0.02, length * 0.45), (girth * 0.95, girth * rng.uniform(0.85, 1.1), length * 0.65)),
        solids.limb((0, girth * 0.3, length * 0.7), (0, head[1] - 0.1 * r, head[2] - 0.1 * r), girth * 0.6, r * 0.6),
        solids.ellipsoid(head, (r, r * rng.uniform(0.85, 1.05), r * rng.uniform(0.9, 1.05))),
    ]
    bottom = -girth * 0.6 - leg
    knees = [
        solids.chain(
            [(spread, -0.1, z), (spread * 1.05, bottom * 0.6, z + bend), (spread * 1.05, bottom, z + 0.02)],
            [foot * 1.6, foot, foot * 1.05],
        )
        for z, bend in ((length * 0.65, 0.03), (-length * 0.75, -0.05))
    ]
    paws = [
        solids.ellipsoid((spread * 1.05, bottom, z + 0.08), (foot * 1.2, foot * 0.75, foot * 1.7))
        for z in (length * 0.65, -length * 0.75)
    ]
    body.append(solids.both_sides(solids.blended(knees + paws, 0.04)))
    t = np.linspace(0, 1, 6)
    lift, thick = (
        rng.uniform(-0.5, 0.8),
        max(foot * rng.uniform(0.3, 0.8), 0.045),
    )  # a thinner tail is missed by the grid
    tail = np.stack([0 * t, girth * 0.3 + lift * t**1.5, -length * 1.05 - rng.uniform(0.15, 0.5) * t], -1)
    body.append(solids.chain(tail, thick * (1.2 - 0.5 * t)))
    trunk = rng.uniform() < 0.18
    if trunk:
        t = np.linspace(0, 1, 7)
        path = np.stack(
            [0 * t, head[1] - 0.15 * r - (0.9 + 0.4 * r) * t, head[2] + r * (0.8 + 0.35 * np.sin(2.5 * t))], -1
        )
        path[:, 1] = np.maximum(path[:, 1], bottom)
        body.append(solids.chain(path, r * 0.38 * (1 - 0.55 * t)))
    coat = tiles.pick(rng, "fur", hsv(0.6, 0.05, rng.uniform(0.3, 0.7)) if trunk else fur_color(rng))
    a.add(solids.polygonised(solids.blended(body, rng.uniform(0.05, 0.12)), 60), coat)
    if trunk:
        a.add_pair(
            ball(r * 0.75, r * 0.9, r * 0.13, 26).turned("y", 30).moved(r * 1.2, head[1] + 0.1 * r, head[2] - 0.25 * r),
            coat,
        )
        eyes(a, rng, 0.6 * r, head[1] + 0.25 * r, head[2] + 0.72 * r, 0.1 * r, 0.8)
        t = np.linspace(0, 1, 10)
        a.add_pair(
            tube(
                np.stack(
                    [0.4 * r + 0.1 * t, head[1] - 0.4 * r - 0.3 * r * np.sin(2 * t), head[2] + 0.7 * r + 0.7 * r * t],
                    -1,
                ),
                0.1 * r * (1 - 0.8 * t),
            ),
            finishes.plastic(rng, hsv(0.12, 0.15, 0.9)),
        )
    else:
        face(a, rng, head, r, coat, rng.choice([0.0, 0.15, 0.35, 0.6]))
        ears(a, rng, head, r, coat)
        if rng.uniform() < 0.2:
            horns(a, rng, head, r)
    if rng.uniform() < 0.3:  # a collar
        n = np.linspace(0, 2 * np.pi, 36, endpoint=False)
        mid = np.array(
            [0, girth * 0.3 + 0.55 * (head[1] - girth * 0.3), length * 0.7 + 0.55 * (head[2] - length * 0.7)]
        )
        radius = (girth * 0.6 + r * 0.6) / 2 + 0.03
        a.add(
            tube(mid + radius * np.stack([np.cos(n), 0 * n, np.sin(n)], -1), 0.03, closed=True),
            tiles.pick(rng, "paint"),
        )
    return a


def sitting(rng: np.random.Generator) -> Assembly:
    """Make a sitting toy cat, dog or bear: pear-shaped body, big head, paws in front."""
    a = Assembly()
    coat, r, girth = tiles.pick(rng, "fur", fur_color(rng)), rng.uniform(0.3, 0.45), rng.uniform(0.32, 0.5)
    head = (0.0, 0.42 + r * 0.75, 0.08)
    body = [
        solids.ellipsoid((0, -0.1, 0), (girth, 0.45, girth * 0.9)),
        solids.ellipsoid((0, 0.2, 0.02), (girth * 0.75, 0.35, girth * 0.7)),
        solids.ellipsoid(head, (r * rng.uniform(1, 1.15), r, r * 0.95)),
    ]
    arm = solids.chain(
        [(girth * 0.6, 0.22, 0.1), (girth * 0.75, -0.1, 0.3), (girth * 0.45, -0.48, 0.42)], [0.13, 0.11, 0.1]
    )
    leg = solids.blended(
        [
            solids.ellipsoid((girth * 0.85, -0.38, 0.05), (0.2, 0.2, 0.3)),
            solids.ellipsoid((girth * 0.8, -0.5, 0.36), (0.12, 0.09, 0.18)),
        ],
        0.05,
    )
    body.append(solids.both_sides(solids.blended([arm, leg], 0.03)))
    if rng.uniform() < 0.6:
        t = np.linspace(0, 1, 6)
        body.append(
            solids.chain(
                np.stack([girth * (0.4 + 0.9 * np.sin(2 * t)), -0.45 + 0.25 * t**2, -girth * 0.9 + 0.5 * t], -1),
                0.09 - 0.03 * t,
            )
        )
    a.add(solids.polygonised(solids.blended(body, 0.07), 56), coat)
    face(a, rng, head, r, coat, rng.choice([0.0, 0.1, 0.2, 0.35]))
    ears(a, rng, head, r, coat)
    if rng.uniform() < 0.5:
        a.add(
            ball(girth * 0.55, 0.3, 0.2, 26).moved(0, 0.02, girth * 0.62),
            tiles.pick(rng, "fur", colors.near_color(rng, fur_color(rng), 0.4)),
        )
    dress_head(a, rng, head, r, 0.3)
    return a


def bird(rng: np.random.Generator) -> Assembly:
    """Make an owl, penguin, chick or parrot: egg-shaped body, wings at its sides, beak, feet."""
    a = Assembly()
    coat, girth, tall = tiles.pick(rng, "fur", fur_color(rng)), rng.uniform(0.32, 0.48), rng.uniform(0.45, 0.65)
    separate = rng.uniform() < 0.5
    r = girth * rng.uniform(0.65, 0.9)
    y = tall * (0.95 if separate else 0.55)
    body = [
        solids.ellipsoid((0, 0, 0), (girth, tall, girth * 0.9)),
        solids.ellipsoid((0, y, 0.04), (r, r * 0.95, r * 0.95)),
        solids.limb(
            (0, -tall * 0.6, -girth * 0.5),
            (0, -tall * rng.uniform(0.9, 1.2), -girth * rng.uniform(0.9, 1.5)),
            0.12,
            0.07,
        ),
    ]
    a.add(solids.polygonised(solids.blended(body, 0.1), 52), coat)
    a.add(
        ball(girth * 0.72, tall * 0.72, girth * 0.5, 30).moved(0, -tall * 0.1, girth * 0.47),
        tiles.pick(rng, "fur", colors.near_color(rng, hsv(0.1, 0.2, 0.9), 0.3)),
    )
    wing = coat if rng.uniform() < 0.4 else tiles.pick(rng, "fur", fur_color(rng))
    a.add_pair(
        ball(0.09, tall * 0.75, girth * 0.55, 26).turned("z", rng.uniform(5, 40)).moved(girth * 1.02, -0.02, -0.05),
        wing,
    )
    size = r * rng.uniform(0.22, 0.38)
    if size > r * 0.3:
        a.add_pair(
            ball(size * 1.35, size * 1.35, size * 0.6, 26).moved(r * 0.42, y + r * 0.2, r * 0.78),
            finishes.matte(rng, hsv(0.1, 0.2, 0.9)),
        )
    eyes(a, rng, r * 0.42, y + r * 0.2, r * 0.92, size * 0.8, 0.15)
    orange = finishes.plastic(rng, hsv(rng.uniform(0.06, 0.14), 0.85, rng.uniform(0.5, 0.95)))
    a.add(
        cone(r * 0.2, r * rng.uniform(0.3, 0.7), 20).turned("x", rng.uniform(90, 120)).moved(0, y - r * 0.08, r * 0.92),
        orange,
    )
    for toe in (-0.07, 0.0, 0.07):
        a.add_pair(ball(0.04, 0.035, 0.11, 14).moved(girth * 0.45 + toe, -tall * 0.97, girth * 0.45), orange)
    if rng.uniform() < 0.4:
        a.add_pair(cone(r * 0.2, r * 0.5, 16).turned("z", -25).moved(r * 0.5, y + r * 0.7, 0), coat)
    dress_head(a, rng, (0, y, 0.04), r, 0.25)
    return a


def fish(rng: np.random.Generator) -> Assembly:
    """Make a fish: body, fins, tail, eyes."""
    a = Assembly()
    tall, wide = rng.uniform(0.25, 0.5), rng.uniform(0.14, 0.3)
    coat, fin = tiles.pick(rng, "fur", colors.any_color(rng)), tiles.pick(rng, "skin")
    body = solids.blended(
        [solids.ellipsoid((0, 0, 0.1), (wide, tall, 0.6)), solids.limb((0, 0, -0.2), (0, 0, -0.75), tall * 0.45, 0.06)],
        0.15,
    )
    a.add(solids.polygonised(body, 52), coat)
    a.add(ball(0.035, tall * rng.uniform(0.8, 1.2), 0.25, 26).moved(0, 0, -0.9), fin)
    a.add(ball(0.03, tall * 0.5, 0.3, 24).moved(0, tall * 0.9, -0.05), fin)
    a.add_pair(ball(0.28, 0.03, 0.14, 22).turned("z", -25).turned("y", 30).moved(wide + 0.1, -tall * 0.35, 0.15), fin)
    eyes(a, rng, wide * 0.72, tall * 0.2, 0.48, 0.075, 1.0)
    a.add(ball(wide * 0.35, 0.05, 0.06, 18).moved(0, -tall * 0.15, 0.68), fin)
    return a


def turtle(rng: np.random.Generator) -> Assembly:
    """Make a turtle, beetle or crab: a domed shell on a flat body with four or six limbs."""
    a = Assembly()
    dome, wide = rng.uniform(0.25, 0.5), rng.uniform(0.4, 0.55)
    shell = (
        finishes.crackled(np.random.default_rng(rng.integers(2**32))) if rng.uniform() < 0.5 else tiles.pick(rng, "any")
    )
    half = np.stack([np.cos(np.linspace(0, np.pi / 2, 16)), np.sin(np.linspace(0, np.pi / 2, 16))], -1)
    half[-1, 0] = 0
    a.add(loft(np.vstack([(0, -0.1), (0.6, -0.1), (0.98, -0.04), half]), circle(48)).scaled(wide, dome, 0.6), shell)
    coat, r = tiles.pick(rng, "skin"), rng.uniform(0.16, 0.24)
    head = (0.0, 0.08, 0.62 + r)
    limbs = [
        solids.limb((0, 0, 0.4), head, 0.12, r * 0.7),
        solids.ellipsoid(head, r),
        solids.ellipsoid((0, -0.05, 0), (wide * 0.85, 0.1, 0.5)),
    ]
    count = int(rng.integers(2, 4))
    for z in np.linspace(0.4, -0.4, count):
        reach = wide + rng.uniform(0.1, 0.3)
        limbs.append(
            solids.both_sides(
                solids.chain(
                    [(wide * 0.6, -0.02, z), (reach, -0.02, z * 1.15), (reach + 0.06, -0.2, z * 1.25)],
                    [0.1, 0.085, 0.07],
                )
            )
        )
    limbs.append(solids.limb((0, -0.05, -0.5), (0, -0.08, -0.8), 0.07, 0.02))
    a.add(solids.polygonised(solids.blended(limbs, 0.06), 56), coat)
    eyes(a, rng, r * 0.55, head[1] + r * 0.4, head[2] + r * 0.6, r * 0.25, 0.4)
    return a


def dragon(rng: np.random.Generator) -> Assembly:
    """Make a dragon: long neck and tail, wings, spikes along the back, horns."""
    a = Assembly()
    coat = tiles.pick(rng, "fur", colors.any_color(rng))
    r, lift = rng.uniform(0.17, 0.26), rng.uniform(0.25, 0.6)
    head = (0.0, 0.45 + lift, 0.5)
    spine = np.array(
        [
            (0, head[1], head[2]),
            (0, 0.3 + lift, 0.3),
            (0, 0.3, 0.25),
            (0, 0.0, 0.0),
            (0, -0.15, -0.35),
            (0, -0.35, -0.75),
            (0, -0.38 + rng.uniform(0, 0.5), -1.2),
        ]
    )
    body = [
        solids.chain(spine, [0.12, 0.12, 0.2, 0.3, 0.24, 0.12, 0.04], 0.1),
        solids.ellipsoid(head, (r, r * 0.85, r)),
        solids.ellipsoid((0, head[1] - 0.08 * r, head[2] + r), (r * 0.6, r * 0.45, r * 0.8)),
    ]
    body.append(
        solids.both_sides(
            solids.blended(
                [
                    solids.chain([(0.22, 0.1, 0.2), (0.34, -0.15, 0.35), (0.3, -0.42, 0.35)], [0.1, 0.08, 0.07]),
                    solids.chain([(0.2, -0.1, -0.25), (0.38, -0.15, -0.1), (0.34, -0.45, -0.25)], [0.15, 0.12, 0.08]),
                    solids.ellipsoid((0.3, -0.45, 0.42), (0.09, 0.05, 0.13)),
                    solids.ellipsoid((0.35, -0.46, -0.18), (0.1, 0.05, 0.14)),
                ],
                0.05,
            )
        )
    )
    a.add(solids.polygonised(solids.blended(body, 0.06), 64), coat)
    spike = tiles.pick(rng, "paint")
    for t in np.linspace(0.08, 0.9, int(rng.integers(6, 12))):
        at = np.array([np.interp(t, np.linspace(0, 1, len(spine)), spine[:, k]) for k in range(3)])
        thick = np.interp(t, np.linspace(0, 1, 7), [0.12, 0.12, 0.2, 0.3, 0.24, 0.12, 0.04])
        back = np.array([0, 1, 0]) if t > 0.45 else np.array([0, 0.5, -0.85])
        a.add(
            cone(0.06, 0.16, 12)
            .scaled(0.5, 1, 1)
            .turned("x", 0 if t > 0.45 else -60)
            .moved(*(at + 0.85 * thick * back)),
            spike,
        )
    wing, span, rise = tiles.pick(rng, "skin"), rng.uniform(0.6, 0.95), rng.uniform(0.3, 0.6)
    fingers = np.array([(0.45, 1.0), (1.0, 0.62), (0.9, 0.0), (0.5, -0.18)]) * np.array([span, rise])
    rim = [(0.0, 0.1), tuple(fingers[0])]
    for start, end in itertools.pairwise(fingers):  # the membrane sags between the fingers
        rim += [tuple(0.82 * (start + end) / 2 + 0.18 * np.array([0.4 * span, 0.3 * rise])), tuple(end)]
    middle = np.array([0.42 * span, 0.35 * rise])
    fold, lean = rng.uniform(-10, 35), rng.uniform(-25, 15)

    def unfolded(part: Part) -> Part:
        """Place a part of the wing, which is modelled flat, at the shoulder."""
        return part.turned("x", lean).turned("y", fold).moved(0.16, 0.2, -0.05)

    skin = (
        extrusion(subdivided(np.array(rim + [(0.0, -0.05)]) - middle, 4), 0.03, 0.004).moved(y=-0.015).turned("x", -90)
    )
    a.add_pair(unfolded(skin.moved(*middle)), wing)
    wrist = np.array([0.45 * span, 0.97 * rise])

    def bone(start: np.ndarray, end: np.ndarray, radius: float) -> Part:
        """Make a tapering bone of the wing between two points (2,)."""
        path = np.c_[np.linspace(start, end, 4), np.zeros(4)]
        return unfolded(tube(path, np.linspace(radius, 0.6 * radius, 4), outline=circle(10)))

    a.add_pair(bone(np.array([0.0, 0.08]), wrist, 0.05), coat)
    for tip in fingers[1:]:
        a.add_pair(bone(wrist, tip, 0.032), coat)
    eyes(a, rng, r * 0.6, head[1] + r * 0.35, head[2] + r * 0.6, r * 0.2, 0.6)
    horns(a, rng, (head[0], head[1], head[2] - 0.3 * r), r)
    return a


KINDS = {
    "quadruped": quadruped,
    "sitting": sitting,
    "bird": bird,
    "figure": figure,
    "fish": fish,
    "turtle": turtle,
    "dragon": dragon,
}
