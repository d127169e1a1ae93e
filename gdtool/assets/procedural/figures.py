"""Make standing figures: people, robots, gnomes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gdtool.assets.procedural import colors, finishes, solids, tiles
from gdtool.assets.procedural.assembly import Assembly
from gdtool.assets.procedural.colors import hsv
from gdtool.assets.procedural.finishes import Finish
from gdtool.assets.procedural.heads import dress_head, eyes
from gdtool.assets.procedural.parts import Part, ball, circle, cylinder, tube


class _Build(NamedTuple):
    """Hold the measures of a figure.

    head: radius. hips, shoulder: half widths. depth: half depth of the chest. leg, torso: lengths.
    """

    head: float
    hips: float
    shoulder: float
    leg: float
    torso: float
    depth: float


class _Clothes(NamedTuple):
    """Hold the finishes of a figure."""

    skin: Finish
    shirt: Finish
    trousers: Finish
    shoe: Finish


def figure(rng: np.random.Generator) -> Assembly:
    """Make a standing person, robot, gnome or toy snowman of separate body parts."""
    a = Assembly()
    r, hips, shoulder = rng.uniform(0.16, 0.34), rng.uniform(0.14, 0.26), rng.uniform(0.2, 0.34)
    leg, torso = rng.uniform(0.25, 0.6), rng.uniform(0.35, 0.6)
    skin = finishes.plastic(
        rng,
        hsv(rng.uniform(0.04, 0.09), rng.uniform(0.25, 0.6), rng.uniform(0.35, 0.95))
        if rng.uniform() < 0.75
        else colors.any_color(rng),
    )
    shirt, trousers, shoe = tiles.pick(rng, "cloth"), tiles.pick(rng, "cloth"), tiles.pick(rng, "paint")
    build = _Build(r, hips, shoulder, leg, torso, shoulder * rng.uniform(0.5, 0.75))
    if robot := rng.uniform() < 0.3:
        skin, shirt, trousers = (tiles.pick(rng, "paint") for _ in range(3))
    clothes = _Clothes(skin, shirt, trousers, shoe)
    a.add(_chest(build, robot), clothes.shirt)
    _limbs(a, rng, build, clothes)
    if robot:
        _robot_head(a, rng, build, clothes.skin)
    else:
        _human_head(a, rng, build, clothes.skin)
    return a


def _chest(build: _Build, robot: bool) -> Part:
    """Make the torso: a rounded block for a robot, else blended belly and chest."""
    if robot:
        chest = solids.block(
            (0, build.leg + build.torso / 2, 0), (build.shoulder, build.torso / 2 + 0.02, build.depth), 0.05
        )
    else:
        belly = (build.hips * 1.2, build.torso * 0.35, build.depth)
        ribs = (build.shoulder, build.torso * 0.36, build.depth)
        chest = solids.blended(
            [
                solids.ellipsoid((0, build.leg + build.torso * 0.25, 0), belly),
                solids.ellipsoid((0, build.leg + build.torso * 0.7, 0), ribs),
            ],
            0.1,
        )
    return solids.polygonised(chest, 40)


def _limbs(a: Assembly, rng: np.random.Generator, build: _Build, clothes: _Clothes) -> None:
    """Add arms in a random pose, hands, legs and shoes."""
    pose, bend = rng.uniform(-15, 75) * (1 if rng.uniform() < 0.6 else 0.3), rng.uniform(-0.15, 0.3)
    reach = build.leg * 0.5 + build.torso * 0.6
    sx, sy = build.shoulder * 0.95, build.leg + build.torso * 0.85
    w = np.radians(pose)
    elbow = (sx + reach * 0.5 * np.cos(np.radians(70) - w), sy - reach * 0.5 * np.sin(np.radians(70) - w), 0.02)
    hand = (
        elbow[0] + reach * 0.4 * np.cos(np.radians(75) - w),
        elbow[1] - reach * 0.4 * np.sin(np.radians(75) - w),
        bend,
    )
    arm = np.array([(sx * 0.9, sy, 0), elbow, hand])
    a.add_pair(tube(arm, np.array([0.085, 0.075, 0.065]), outline=circle(20)), clothes.shirt)
    a.add_pair(ball(0.085, count=20).moved(*hand), clothes.skin)
    hips, leg = build.hips, build.leg
    thigh = np.array([(hips * 0.6, leg * 1.1, 0), (hips * 0.7, leg * 0.5, 0.02), (hips * 0.75, 0.06, 0)])
    a.add_pair(tube(thigh, np.array([0.12, 0.1, 0.09]), outline=circle(20)), clothes.trousers)
    a.add_pair(ball(0.11, 0.075, 0.17, 22).moved(hips * 0.78, 0.03, 0.06), clothes.shoe)


def _robot_head(a: Assembly, rng: np.random.Generator, build: _Build, skin: Finish) -> None:
    """Add a box with eyes, a slot for a mouth and an antenna."""
    r, y = build.head, build.leg + build.torso + build.head * 0.95
    a.add(solids.polygonised(solids.block((0.0, y, 0.0), (r * 1.05, r * 0.85, r * 0.9), 0.05), 32), skin)
    eyes(a, rng, r * 0.45, y + r * 0.1, r * 0.85, r * 0.22, 0.0)
    a.add(
        cylinder(r * 0.5, r * 0.1).turned("x", 90).scaled(1, 0.4, 1).moved(0, y - r * 0.4, r * 0.88),
        finishes.metal(rng),
    )
    a.add(cylinder(0.02, r * 0.6).moved(0, y + r * 1.1, 0), finishes.metal(rng))
    a.add(ball(0.05, count=16).moved(0, y + r * 1.4, 0), finishes.glossy(rng))


def _human_head(a: Assembly, rng: np.random.Generator, build: _Build, skin: Finish) -> None:
    """Add a head with eyes, nose and mouth, and perhaps hair, a beard and a hat."""
    r, y = build.head, build.leg + build.torso + build.head * 0.95
    a.add(ball(r, r * rng.uniform(0.95, 1.15), r * 0.95, 36).moved(0.0, y, 0.0), skin)
    eyes(a, rng, r * 0.36, y + r * 0.12, r * 0.85, r * rng.uniform(0.1, 0.18), 0.1)
    a.add(ball(r * 0.12, r * 0.14, r * 0.18, 16).moved(0, y - r * 0.1, r * 0.95), skin)
    t = np.linspace(-0.8, 0.8, 12)
    mouth = np.stack(
        [r * 0.4 * t, y - r * (0.5 - 0.12 * t**2), r * np.sqrt(np.maximum(0.86 - 0.45 * t**2, 0.3)) * 0.93], -1
    )
    a.add(tube(mouth, r * 0.045, outline=circle(8)), finishes.plastic(rng, hsv(0.98, 0.7, 0.5)))
    hair = tiles.pick(rng, "fur", hsv(rng.uniform(0.03, 0.12), rng.uniform(0.2, 0.8), rng.uniform(0.08, 0.8)))
    if rng.uniform() < 0.75:
        a.add(ball(r * 1.06, r * 1.0, r * 0.95, 30).moved(0, y + r * 0.2, -r * 0.18), hair)
    if rng.uniform() < 0.25:
        a.add(ball(r * 0.6, r * 0.6, r * 0.35, 24).moved(0, y - r * 0.75, r * 0.55), hair)
    dress_head(a, rng, (0.0, y, 0.0), r, 0.6)
