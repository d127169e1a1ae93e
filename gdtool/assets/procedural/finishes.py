"""Define finishes: what a part is made of, as plain factors, tiled images, or lookup tables over a solid field.

A finish is drawn first, with its random parameters, and applied once the object's shape is known: it is a function of
`Shape` that returns a `Look`. Finishes of tiled images use the first UV set. A finish of a solid field, such as wood or
marble, stores its pattern in the second UV set, as coordinates into a small lookup image. A threshold in that image is
then a crisp line on the surface, however coarse the mesh is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from gdtool.assets.procedural import patterns
from gdtool.assets.procedural.colors import METALS, any_color, any_metal, hsv, near_color
from gdtool.assets.procedural.parts import product
from gdtool.assets.procedural.patterns import Field
from gdtool.assets.scene import Material, Texture, Wrap


@dataclass(frozen=True)
class Shape:
    """Hold the surface that a finish is applied to, in the normalised object: points (v, 3), normals (v, 3).

    convexity() returns (v,), the curvature of assembly.convexity, positive on outward edges.
    """

    points: np.ndarray
    normals: np.ndarray
    convexity: Callable[[], np.ndarray]


@dataclass(frozen=True)
class Look:
    """Hold a finish's result: a material, its second UV set (v, 2) or None, and tiles per unit length of the first."""

    material: Material
    field_uv: np.ndarray | None = None
    tiles_per_unit: float = 1.0


Finish = Callable[[Shape], Look]


def _srgb8(color: np.ndarray) -> np.ndarray:
    """Encode linear colours as 8-bit sRGB."""
    c = np.clip(color, 0, 1)
    srgb = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
    return np.round(srgb * 255).astype(np.uint8)


def textured_material(
    name: str,
    color: np.ndarray,
    metallic: np.ndarray | float,
    roughness: np.ndarray,
    uv_set: int,
    wrap: Wrap,
    normal: np.ndarray | None = None,
) -> Material:
    """Make a material of maps: linear colour (h, w, 3) or (3,), metallic and roughness (h, w), perhaps a normal map.

    Metallic may be a constant. Values are clipped to [0, 1] and stored with 8 bits.
    """
    shape = roughness.shape
    orm = np.stack([np.ones(shape), roughness, np.broadcast_to(metallic, shape)], -1)
    orm = np.round(np.clip(orm, 0, 1) * 255).astype(np.uint8)

    def texture(image: np.ndarray, encoding: Literal["srgb", "linear"]) -> Texture:
        """Make a texture of an image in the material's UV set."""
        return Texture(image, encoding, uv_set=uv_set, wrap_u=wrap, wrap_v=wrap)

    return Material(
        name=name,
        base_color=(1.0, 1.0, 1.0, 1.0),
        metallic=1.0,
        roughness=1.0,
        base_color_texture=texture(_srgb8(np.broadcast_to(color, (*shape, 3))), "srgb"),
        metallic_roughness_texture=texture(orm, "linear"),
        normal_texture=None if normal is None else texture(normal, "linear"),
    )


# --- factors only -----------------------------------------------------------------------------------------------------


def plain(color: np.ndarray, roughness: float, metallic: float = 0.0, name: str = "plain") -> Finish:
    """Make a finish of one linear colour, roughness and metallic."""
    r, g, b = (float(c) for c in np.clip(color, 0, 1))
    material = Material(name=name, base_color=(r, g, b, 1.0), metallic=float(metallic), roughness=float(roughness))
    return lambda shape: Look(material)


def plastic(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw a fairly smooth dielectric finish."""
    return plain(any_color(rng) if color is None else color, rng.uniform(0.2, 0.6), name="plastic")


def metal(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw a metallic finish."""
    return plain(any_metal(rng) if color is None else color, rng.uniform(0.12, 0.55), 1.0, name="metal")


def matte(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw a rough dielectric finish."""
    return plain(any_color(rng) if color is None else color, rng.uniform(0.65, 0.98), name="matte")


def glossy(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw a polished dielectric finish."""
    return plain(any_color(rng) if color is None else color, rng.uniform(0.06, 0.22), name="glossy")


# --- lookup tables over solid fields ----------------------------------------------------------------------------------


class _Substance(NamedTuple):
    """Hold a material of one kind: linear colour (3,), roughness, metallic."""

    color: np.ndarray
    roughness: float
    metallic: float = 0.0


class _Layer(NamedTuple):
    """Hold a substance and the place in [0, 1] of a lookup table's first axis from which it is used."""

    start: float
    substance: _Substance


def _table(
    name: str,
    layers: list[_Layer],
    softness: float = 0.01,
    speckle: float = 0.25,
    wrap: Wrap = "clamp",
) -> Material:
    """Make a lookup image over (pattern, dirt): the layers follow each other along u.

    softness: half the width of u in which a layer replaces the one before. Along v, which is dirt, the colour darkens
    and the roughness grows by `speckle`.
    """
    u, v = patterns.tile_grid(256)
    u, v = u[:64], (v[:64] * 4)
    value = np.broadcast_to(np.r_[layers[0].substance], (*u.shape, 5))
    for start, substance in layers[1:]:
        weight = patterns.smoothstep(start - softness, start + softness, u)[..., None]
        value = value * (1 - weight) + np.r_[substance] * weight
    color = value[..., :3] * (1 + speckle * (0.5 - v))[..., None]
    roughness = np.clip(value[..., 3] + speckle * 0.5 * (v - 0.5), 0.04, 1)
    return textured_material(name, np.clip(color, 0, 1), value[..., 4], roughness, 1, wrap)


def _dirt(rng: np.random.Generator) -> Field:
    """Draw a smooth field in [0, 1] over points (n, 3): how dirty the surface is."""
    field = patterns.noise_field(rng, rng.uniform(2, 6), 2.5)
    return lambda points: np.clip(0.5 + 0.22 * field(points), 0.01, 0.99)


def _field(
    name: str, material: Material, pattern: Callable[[Shape], np.ndarray], dirt: Field, clip: bool = True
) -> Finish:
    """Make a finish that looks its material up by a pattern along u and by dirt along v.

    clip: keep u inside the image; without it u repeats, for materials whose texture does.
    """

    def apply(shape: Shape) -> Look:
        """Evaluate pattern and dirt at the vertices."""
        u = np.asarray(pattern(shape), float)
        u = np.clip(u, 0.004, 0.996) if clip else np.clip(u, -30, 30)
        return Look(material, np.stack([u, dirt(shape.points)], -1))

    return apply


def _any_substance(rng: np.random.Generator, color: np.ndarray) -> _Substance:
    """Draw a dielectric of a colour, or (15 %) a metal."""
    if rng.uniform() < 0.15:
        roughness = rng.uniform(0.15, 0.5)
        return _Substance(any_metal(rng), roughness, 1.0)
    return _Substance(color, rng.uniform(0.15, 0.9))


def banded(
    rng: np.random.Generator, color: np.ndarray | None = None, axis: int | None = None, frequency: float | None = None
) -> Finish:
    """Draw stripes across an axis, in two or three substances."""
    color = any_color(rng) if color is None else color
    direction = np.eye(3)[rng.choice(3, p=[0.2, 0.6, 0.2]) if axis is None else axis] + rng.normal(0, 0.02, 3)
    frequency = rng.uniform(1.5, 7) if frequency is None else frequency
    first = _any_substance(rng, color)
    second = _any_substance(rng, any_color(rng))
    layers = [_Layer(0, first), _Layer(rng.uniform(0.35, 0.75), second)]
    if rng.uniform() < 0.4:
        third = _any_substance(rng, any_color(rng))
        layers.append(_Layer(rng.uniform(0.8, 0.92), third))
    wobble, size = patterns.noise_field(rng, 2.0, 1.0), rng.choice([0.0, 0.08, 0.3])
    shift = rng.uniform()
    return _field(
        "stripes",
        _table("stripes", layers, 0.012, wrap="mirror"),
        lambda s: 2 * frequency * (product(s.points, direction)) + size * wobble(s.points) + shift,
        _dirt(rng),
        clip=False,
    )


def gradient(rng: np.random.Generator, color: np.ndarray | None = None, direction: np.ndarray | None = None) -> Finish:
    """Draw a smooth change of colour along a direction, by default upward."""
    color = any_color(rng) if color is None else color
    other = near_color(rng, any_color(rng) if rng.uniform() < 0.5 else color, 0.6)
    axis = np.array([0.0, 1.0, 0.0]) if direction is None else np.asarray(direction, float)
    roughness = rng.uniform(0.15, 0.8)
    material = _table(
        "gradient",
        [_Layer(0, _Substance(color, roughness)), _Layer(rng.uniform(0.3, 0.7), _Substance(other, roughness))],
        rng.uniform(0.2, 0.6),
    )
    wobble = patterns.noise_field(rng, 2.0, 1.0)
    return _field("gradient", material, lambda s: 0.5 + product(s.points, axis) + 0.04 * wobble(s.points), _dirt(rng))


def marble(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw marble: veins along the zero set of a noise field."""
    color = any_color(rng) if color is None else color
    vein = any_metal(rng) if (gilded := rng.uniform() < 0.25) else near_color(rng, color, 1.0)
    roughness = rng.uniform(0.08, 0.35)
    layers = [
        _Layer(0, _Substance(vein, rng.uniform(0.15, 0.4), float(gilded))),
        _Layer(rng.uniform(0.05, 0.15), _Substance(near_color(rng, color, 0.3), roughness)),
        _Layer(0.55, _Substance(color, roughness)),
    ]
    field = patterns.noise_field(rng, rng.uniform(1.2, 2.5), 2.0)
    return _field("marble", _table("marble", layers, 0.04), lambda s: np.abs(field(s.points)) * 0.8, _dirt(rng))


def blotched(rng: np.random.Generator, color: np.ndarray | None = None, other: np.ndarray | None = None) -> Finish:
    """Draw irregular patches of two or three substances: cows, camouflage, corroded paint."""
    color = any_color(rng) if color is None else color
    first, second = _any_substance(rng, color), _any_substance(rng, any_color(rng) if other is None else other)
    level = rng.uniform(0.45, 0.65)
    layers = [_Layer(0, first), _Layer(level, second)]
    if rng.uniform() < 0.4:
        layers.append(_Layer(level + 0.12, second._replace(color=near_color(rng, second.color, 0.5))))
    field = patterns.noise_field(rng, rng.uniform(1.2, 4), 1.0)
    return _field("patches", _table("patches", layers, 0.012), lambda s: 0.5 + 0.2 * field(s.points), _dirt(rng))


def spotted(rng: np.random.Generator, color: np.ndarray | None = None, other: np.ndarray | None = None) -> Finish:
    """Draw round spots around random sites."""
    color, other = any_color(rng) if color is None else color, any_color(rng) if other is None else other
    first, second = _any_substance(rng, color), _any_substance(rng, other)
    count = int(rng.integers(60, 260))
    radius = 0.62 * count ** (-1 / 3) * rng.uniform(0.5, 0.8)
    field = patterns.cell_field(rng, count)
    material = _table("spots", [_Layer(0, second), _Layer(0.5, first)], 0.03)
    return _field("spots", material, lambda s: 0.5 * field(s.points)[:, 0] / radius, _dirt(rng))


def crackled(rng: np.random.Generator, color: np.ndarray | None = None, other: np.ndarray | None = None) -> Finish:
    """Draw cells with joints between them: giraffe, dry earth, crackle glaze, leaded glass."""
    color = any_color(rng) if color is None else color
    joint = near_color(rng, color, 1.0) if other is None else other
    field, width = patterns.cell_field(rng, int(rng.integers(40, 260))), rng.uniform(0.02, 0.05)
    roughness = rng.uniform(0.2, 0.8)
    material = _table(
        "cells", [_Layer(0, _Substance(joint, rng.uniform(0.3, 0.95))), _Layer(0.5, _Substance(color, roughness))], 0.06
    )

    def pattern(s: Shape) -> np.ndarray:
        """Measure the distance to the joint between the two nearest sites."""
        near = field(s.points)
        return 0.5 * (near[:, 1] - near[:, 0]) / width

    return _field("cells", material, pattern, _dirt(rng))


def chequered(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw a chequerboard in the first UV set."""
    color = any_color(rng) if color is None else color
    first, second = _any_substance(rng, color), _any_substance(rng, any_color(rng))
    u, v = patterns.tile_grid(64)
    odd = ((u < 0.5) ^ (v < 0.5))[..., None]
    value = np.where(odd, np.r_[first], np.r_[second])
    material = textured_material("checks", value[..., :3], value[..., 4], value[..., 3], 0, "repeat")
    tiles = rng.uniform(1.5, 5)
    return lambda shape: Look(material, None, tiles)


def wooden(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw wood: the rings of a trunk, cut by the surface."""
    color = hsv(rng.uniform(0.04, 0.11), rng.uniform(0.35, 0.75), rng.uniform(0.35, 0.85)) if color is None else color
    dark, roughness = color * rng.uniform(0.35, 0.7), rng.uniform(0.3, 0.8)
    material = _table(
        "wood",
        [_Layer(0, _Substance(color, roughness)), _Layer(0.55, _Substance(dark, roughness + 0.1))],
        0.4,
        0.2,
        wrap="mirror",
    )
    axis = int(rng.choice(3, p=[0.35, 0.45, 0.2]))
    across = [i for i in range(3) if i != axis]
    center, rings = rng.uniform(-0.6, 0.6, 2), rng.uniform(9, 22)
    squeeze = np.where(np.arange(3) == axis, 0.25, 1.0)
    field = patterns.noise_field(rng, 2.5, 2.0)

    def pattern(s: Shape) -> np.ndarray:
        """Measure the distance from the trunk's axis, wobbling, in rings."""
        radius = np.hypot(s.points[:, across[0]] - center[0], s.points[:, across[1]] - center[1])
        return rings * radius + 0.5 * field(s.points * squeeze)

    return _field("wood", material, pattern, _dirt(rng), clip=False)


def worn_paint(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw paint that is gone on outward edges and in scratches, with metal beneath."""
    color, bare = any_color(rng) if color is None else color, any_metal(rng)
    roughness = rng.uniform(0.2, 0.6)
    layers = [
        _Layer(0, _Substance(color, roughness)),
        _Layer(0.58, _Substance(color * 0.5, 0.8)),
        _Layer(0.63, _Substance(bare, rng.uniform(0.25, 0.5), 1.0)),
    ]
    chips, fine, amount = (
        patterns.noise_field(rng, 3.0, 3.0),
        patterns.noise_field(rng, 14.0, 1.0),
        rng.uniform(0.6, 1.5),
    )
    return _field(
        "worn paint",
        _table("worn paint", layers, 0.012),
        lambda s: 0.32 + amount * 0.3 * s.convexity() + 0.09 * chips(s.points) + 0.04 * fine(s.points),
        _dirt(rng),
    )


def rusty(rng: np.random.Generator, color: np.ndarray | None = None) -> Finish:
    """Draw metal that rusts in patches and from below, or copper with verdigris."""
    bare = any_metal(rng) if color is None else color
    rust = hsv(rng.uniform(0.03, 0.08), rng.uniform(0.6, 0.85), rng.uniform(0.3, 0.6))
    if rng.uniform() < 0.2:  # verdigris on copper
        bare, rust = np.array(METALS["copper"]), hsv(rng.uniform(0.4, 0.47), 0.4, rng.uniform(0.5, 0.7))
    layers = [
        _Layer(0, _Substance(bare, rng.uniform(0.2, 0.45), 1.0)),
        _Layer(0.5, _Substance(rust * 0.6, 0.8, 0.3)),
        _Layer(0.6, _Substance(rust, 0.92)),
    ]
    field, amount = patterns.noise_field(rng, 2.0, 3.0), rng.uniform(0.25, 0.6)
    return _field(
        "rust",
        _table("rust", layers, 0.03),
        lambda s: amount + 0.2 * field(s.points) - 0.25 * s.points[:, 1],
        _dirt(rng),
    )


def topped(rng: np.random.Generator, color: np.ndarray | None = None, top: np.ndarray | None = None) -> Finish:
    """Draw a layer on all that faces up: snow, moss, icing, dust."""
    color = any_color(rng) if color is None else color
    top = (
        (hsv(0.6, 0.03, 0.95) if rng.uniform() < 0.4 else hsv(rng.uniform(0.2, 0.35), 0.6, 0.5)) if top is None else top
    )
    field = patterns.noise_field(rng, 4.0, 1.5)
    material = _table(
        "topped",
        [_Layer(0, _Substance(color, rng.uniform(0.4, 0.9))), _Layer(0.7, _Substance(top, rng.uniform(0.7, 0.95)))],
        0.04,
    )
    return _field("topped", material, lambda s: 0.4 + 0.4 * s.normals[:, 1] + 0.06 * field(s.points), _dirt(rng))


def gazing(
    rng: np.random.Generator, direction: np.ndarray, iris: np.ndarray | None = None, white: np.ndarray | None = None
) -> Finish:
    """Draw the finish of a pair of eyeballs that look along `direction`: black pupil, coloured iris, white.

    The ring is chosen by the angle between normal and direction. direction is the right eye's (x >= 0); the left eye
    mirrors it.
    """
    iris = any_color(rng) if iris is None else iris
    white = np.array([0.9, 0.9, 0.87]) if white is None else white
    black = np.array([0.01, 0.01, 0.012])
    pupil = rng.uniform(0.3, 0.55)
    layers = [
        _Layer(0, _Substance(black, 0.08)),
        _Layer(pupil, _Substance(iris, 0.12)),
        _Layer(pupil + rng.uniform(0.15, 0.35), _Substance(white, 0.15)),
    ]
    material = _table("eye", layers, 0.02, speckle=0.0)
    direction = np.asarray(direction, float) / np.linalg.norm(direction)

    def apply(shape: Shape) -> Look:
        """Evaluate the angle to the gaze at the vertices."""
        sign = np.where(shape.points[:, 0] < 0, -1.0, 1.0)[:, None]  # the left eye is the mirror image of the right one
        toward = product(shape.normals * np.concatenate([sign, np.ones((len(sign), 2))], 1), direction)
        angle = np.degrees(np.arccos(np.clip(toward, -1, 1))) / 90.0
        return Look(material, np.stack([np.clip(angle, 0.004, 0.996), np.full(len(angle), 0.5)], -1))

    return apply
