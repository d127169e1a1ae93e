"""Make the maps to store: pack and quantise values, and leave out what is constant."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from gdtool.bake.padding import Gutters
from gdtool.bake.target import Texels
from gdtool.core.errors import ResourceError
from gdtool.core.threads import mapped

# A channel that spans no more than this, in stored units, is constant: one step of 8 bits, and rounding.
CONSTANT_RANGE = 1.5 / 255
# A normal map is flat when 99.5 % of it lies within this angle of straight up: 8 bits store normals to 0.4 degrees.
FLAT_DEGREES = 1.0
_ROWS_AT_ONCE = 64  # few enough that intermediate rows stay in the cache
# Bytes of memory per texel of a bake: benchmarks/bake/sweep.py at 2048 and 4096, on an atlas that is 72 % full.
BYTES_PER_TEXEL = 130
HEIGHT_BITS = 16  # a step of 8 bits is a visible terrace


class SkippedMap(NamedTuple):
    """A map that was left out: its name, the reason, and the seconds that storing it would have taken.

    seconds is None where leaving it out saves no time.
    """

    what: str
    why: str
    seconds: float | None


@dataclass(frozen=True)
class MapOptions:
    """Options for storing maps.

    bits: 8 or 16 per channel. padding: width in texels of the gutters around charts; None fills all free texels.
    normal_map: "on", "off", or "auto", which leaves a flat map out. least_alpha: alpha below which a texel's color is
    never seen. Such texels are filled like gutters. Their color is mostly black, and filtering would mix it into their
    surroundings.
    """

    bits: int = 8
    padding: int | None = None
    normal_map: Literal["auto", "on", "off"] = "auto"
    least_alpha: float = 0.5 / 255
    threads: int = 1


@dataclass(frozen=True)
class Maps:
    """Maps as stored, (s, s, c) uint8 or uint16; None where a factor replaces the map or the material has no such map.

    base_color: sRGB, with alpha as a fourth channel unless all is opaque. orm: R occlusion, G roughness, B metallic.
    normal: tangent space, +Y up. emissive: sRGB. extra: grey maps that no material refers to, height and confidence.

    factors: the material's factors by name: base_color linear RGBA, roughness, metallic, and emissive linear RGB where
    anything emits light. factors["height"] is the distance from the surface, above and below, that 1 and 0 in the
    height map stand for. has_occlusion: whether R of orm is to be used; has_roughness_metallic: whether G and B are.
    """

    size: int
    base_color: np.ndarray | None
    orm: np.ndarray | None
    normal: np.ndarray | None
    factors: dict[str, tuple[float, ...]]
    has_occlusion: bool = False
    has_roughness_metallic: bool = False
    emissive: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    skipped: list[SkippedMap] = field(default_factory=list)


def require_map_memory(name: str, size: int) -> None:
    """Raise ResourceError when maps of size x size texels will not fit into free memory.

    Without this check the process would be killed midway. name: the object's name, for the message.
    """
    needed = BYTES_PER_TEXEL * size * size
    try:
        free = next(
            int(line.split()[1]) * 1024
            for line in Path("/proc/meminfo").read_text().splitlines()
            if line.startswith("MemAvailable")
        )
    except (OSError, StopIteration):
        return
    if needed > free:
        raise ResourceError(
            name,
            f"maps of {size} texels need about {needed / 2**30:.0f} GB of memory, {free / 2**30:.0f} GB are free",
            "lower --size",
        )


def quantise(image: np.ndarray, bits: int) -> np.ndarray:
    """Round floats in [0, 1] to the nearest step of uint8 or uint16."""
    top, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    scaled = np.clip(image, 0, 1)
    scaled *= image.dtype.type(top)
    return np.rint(scaled, out=scaled).astype(kind)


def constant_of(
    values: np.ndarray, tolerance: float = CONSTANT_RANGE, encoding: Callable = lambda x: x
) -> np.ndarray | None:
    """Return the middle of values (n,) or (n, c), float64, where no channel spans more than `tolerance`, else None.

    The span and the result are those of encoding(values); encoding is monotonic.
    """
    if not len(values):
        return None
    low, high = (encoding(np.clip(end, 0, 1).astype(np.float64)) for end in (values.min(0), values.max(0)))
    return (low + high) / 2 if np.all(high - low <= tolerance) else None


def flat_angle(tangent_normals: np.ndarray) -> float:
    """Measure the angle in degrees from straight up within which 99.5 % of tangent-space normals (n, 3) lie."""
    if not len(tangent_normals):
        return 0.0
    # The upward component falls as the angle grows: its percentile is the cosine of the angle's.
    up = float(np.percentile(tangent_normals[:, 2], 0.5))
    return float(np.degrees(np.arccos(np.clip(up, -1, 1))))


def make_maps(
    texels: Texels,
    values: dict[str, np.ndarray],
    occlusion: np.ndarray | None = None,
    options: MapOptions = MapOptions(),
) -> Maps:
    """Make the maps to store from the values of n texels.

    Args:
        texels: where the n texels lie.
        values: arrays by name, as in bake.pipeline.Baked.values: albedo, roughness, metallic, tangent_normal, and where
            the source has them alpha, emissive (n, 3) linear, height (n,) in the target's units, confidence (n,) in
            [0, 1].
        occlusion: (n,) ambient visibility in [0, 1], 1 where nothing is occluded; None without.
        options: how to store them.
    """
    from gdtool.images.color import srgb_from_linear

    layers = _Layers()
    color = [values["albedo"][:, k] for k in range(3)]
    alpha = _add_base_color(layers, texels, values, color)
    has_roughness_metallic, has_occlusion = _add_orm(layers, texels, values, occlusion)
    _add_normal(layers, texels, values, options)
    _add_emissive(layers, texels, values)
    _add_extra(layers, texels, values)
    gutters = Gutters(texels.mask(), options.padding)
    planes = {
        name: [
            _Plane(channel, gutters, srgb_from_linear if name in ("base_color", "emissive") and k < 3 else None)
            # Alpha, the fourth channel, is never sRGB.
            for k, channel in enumerate(channels)
        ]
        for name, channels in layers.channels.items()
    }
    if alpha is not None and (hidden := alpha < options.least_alpha).any() and not hidden.all():
        seen = Gutters(texels.image(~hidden), options.padding)
        planes["base_color"][:3] = [
            _Plane(np.where(hidden, np.float32(0), channel), seen, srgb_from_linear) for channel in color
        ]
    start = time.perf_counter()
    bits = {name: HEIGHT_BITS if name == "height" else options.bits for name in planes}
    stored = _stored(texels, planes, bits, options.threads)
    each = (time.perf_counter() - start) / len(stored) if stored else None
    return Maps(
        texels.size,
        stored.get("base_color"),
        stored.get("orm"),
        stored.get("normal"),
        layers.factors,
        has_occlusion,
        has_roughness_metallic,
        stored.get("emissive"),
        {name: stored[name] for name in ("height", "confidence") if name in stored},
        [SkippedMap(what, why, each if what.endswith("map") else None) for what, why in layers.skipped],
    )


@dataclass
class _Layers:
    """The maps to store, while they are chosen.

    channels: by map name, the values (n,) of each channel; None is 1 everywhere. factors: the material's, by name.
    skipped: what was left out, and why.
    """

    channels: dict[str, list[np.ndarray | None]] = field(default_factory=dict)
    factors: dict[str, tuple[float, ...]] = field(default_factory=dict)
    skipped: list[tuple[str, str]] = field(default_factory=list)


def _add_base_color(
    layers: _Layers, texels: Texels, values: dict[str, np.ndarray], color: list[np.ndarray]
) -> np.ndarray | None:
    """Add the base color as a map or a factor; return alpha (n,), None where everything is opaque."""
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    inside = slice(0, texels.inside)
    alpha = np.clip(values["alpha"], 0, 1) if "alpha" in values else None
    if alpha is not None and alpha[inside].min() >= 1 - CONSTANT_RANGE:
        alpha = None
        layers.skipped.append(("alpha", "opaque everywhere"))
    constants = (
        [constant_of(channel[inside], encoding=srgb_from_linear) for channel in color] if alpha is None else [None]
    )
    if any(constant is None for constant in constants):
        layers.factors["base_color"] = (1.0, 1.0, 1.0, 1.0)
        layers.channels["base_color"] = color if alpha is None else [*color, alpha]
    else:
        layers.factors["base_color"] = (*(round(float(x), 6) for x in linear_from_srgb(np.array(constants))), 1.0)
        layers.skipped.append(("base_color map", "base color is constant: a factor stores it"))
    return alpha


def _add_orm(
    layers: _Layers, texels: Texels, values: dict[str, np.ndarray], occlusion: np.ndarray | None
) -> tuple[bool, bool]:
    """Add roughness, metallic and occlusion to the packed map.

    Returns whether roughness or metallic varies, and whether occlusion is stored.
    """
    inside = slice(0, texels.inside)
    packed: list[np.ndarray | None] = [None, None, None]
    for channel, name in ((1, "roughness"), (2, "metallic")):
        constant = constant_of(values[name][inside])
        if constant is None:
            layers.factors[name] = (1.0,)
            packed[channel] = values[name]
        else:
            layers.factors[name] = (round(float(constant), 6),)
    varies = any(channel is not None for channel in packed)
    if not varies:
        layers.skipped.append(("roughness and metallic map", "both are constant: factors store them"))
    open_everywhere = occlusion is not None and occlusion[inside].min(initial=1) > 1 - 2 / 255
    if open_everywhere:
        layers.skipped.append(("occlusion map", "nothing is occluded"))
    has_occlusion = occlusion is not None and not open_everywhere
    if has_occlusion:
        packed[0] = occlusion
    if varies or has_occlusion:
        layers.channels["orm"] = packed
    return varies, has_occlusion


def _add_normal(layers: _Layers, texels: Texels, values: dict[str, np.ndarray], options: MapOptions) -> None:
    """Add the normal map, unless the options or its flatness leave it out."""
    angle = flat_angle(values["tangent_normal"][: texels.inside])
    if options.normal_map == "on" or (options.normal_map == "auto" and angle > FLAT_DEGREES):
        layers.channels["normal"] = list(np.moveaxis(values["tangent_normal"], -1, 0))
    elif options.normal_map == "auto":
        layers.skipped.append(("normal map", f"would be flat: {angle:.2f} degrees"))


def _add_emissive(layers: _Layers, texels: Texels, values: dict[str, np.ndarray]) -> None:
    """Add emission, as a map scaled to [0, 1] with a factor, or as a factor alone."""
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    inside = slice(0, texels.inside)
    if "emissive" not in values or (top := float(values["emissive"][inside].max(initial=0))) <= CONSTANT_RANGE:
        return
    scaled = [values["emissive"][:, k] / np.float32(top) for k in range(3)]
    constants = [constant_of(channel[inside], encoding=srgb_from_linear) for channel in scaled]
    if any(constant is None for constant in constants):
        layers.factors["emissive"], layers.channels["emissive"] = (round(top, 6),) * 3, scaled
    else:
        layers.factors["emissive"] = tuple(round(float(x) * top, 6) for x in linear_from_srgb(np.array(constants)))
        layers.skipped.append(("emissive map", "emission is constant: a factor stores it"))


def _add_extra(layers: _Layers, texels: Texels, values: dict[str, np.ndarray]) -> None:
    """Add the height and confidence maps where `values` has them."""
    if "height" in values:
        reach = max(float(np.abs(values["height"][: texels.inside]).max(initial=0)), 1e-6)
        layers.factors["height"] = (reach,)
        layers.channels["height"] = [0.5 + 0.5 * values["height"] / np.float32(reach)]
    if "confidence" in values:
        layers.channels["confidence"] = [values["confidence"]]


@dataclass(frozen=True)
class _Plane:
    """One channel of a map before it is stored.

    values (n,): in [0, 1], or a component of unit vectors in [-1, 1]; None is 1 everywhere. encoding: function applied
    before storing, such as sRGB.
    """

    values: np.ndarray | None
    gutters: Gutters
    encoding: Callable | None


def _stored(
    texels: Texels, layers: dict[str, list[_Plane]], bits: dict[str, int], threads: int
) -> dict[str, np.ndarray]:
    """Store each map's channels as (s, s, c) uint8 or uint16, with gutters filled.

    bits: by map name. The map "normal" is scaled to unit length after filling, and stored as 0.5 n + 0.5.
    """
    out = {
        name: np.empty((texels.size, texels.size, len(layer)), np.uint8 if bits[name] == 8 else np.uint16)
        for name, layer in layers.items()
    }
    normal: dict[int, np.ndarray] = {}

    def store(at: tuple[str, int]) -> None:
        name, k = at
        plane = layers[name][k]
        if plane.values is None:
            out[name][..., k] = np.iinfo(out[name].dtype).max
            return
        image = plane.gutters.fill(
            texels.image(plane.values if plane.encoding is None else plane.encoding(np.clip(plane.values, 0, 1)))
        )
        if name == "normal":
            normal[k] = image
            return
        for row in range(0, texels.size, _ROWS_AT_ONCE):
            out[name][row : row + _ROWS_AT_ONCE, :, k] = quantise(image[row : row + _ROWS_AT_ONCE], bits[name])

    def turn(row: int) -> None:
        rows = [normal[k][row : row + _ROWS_AT_ONCE] for k in range(3)]
        length = np.sqrt(sum(component * component for component in rows))
        scale = np.float32(0.5) / np.where(length > 0, length, np.float32(1))
        for k, component in enumerate(rows):
            out["normal"][row : row + _ROWS_AT_ONCE, :, k] = quantise(
                component * scale + np.float32(0.5), bits["normal"]
            )

    for _ in mapped(store, [(name, k) for name, layer in layers.items() for k in range(len(layer))], threads):
        pass
    for _ in mapped(turn, list(range(0, texels.size, _ROWS_AT_ONCE)) if normal else [], threads):
        pass
    return out


def directx(normal: np.ndarray) -> np.ndarray:
    """Invert the green channel of a stored normal map, so that +Y points down; returns a copy."""
    out = normal.copy()
    out[..., 1] = np.iinfo(normal.dtype).max - normal[..., 1]
    return out


def contact_sheet_of(maps: Maps, width: int = 384) -> np.ndarray:
    """Draw the maps side by side, (h, w, 3) uint8: packed channels one by one, factors as plain squares."""
    from gdtool.images.color import srgb_from_linear
    from gdtool.images.contact import contact_sheet

    def small(image: np.ndarray) -> np.ndarray:
        values = image.astype(np.float32) / np.iinfo(image.dtype).max
        step = max(1, image.shape[0] // width)
        cut = values.shape[0] // step * step
        values = values[:cut, :cut].reshape(cut // step, step, cut // step, step, -1).mean((1, 3))
        return values[..., :3] if values.shape[2] > 2 else values[..., 0]

    def plain(value) -> np.ndarray:
        return np.broadcast_to(np.asarray(value, np.float32), (64, 64, 3))

    factors = maps.factors
    tiles = {
        "base color": small(maps.base_color)
        if maps.base_color is not None
        else plain(srgb_from_linear(np.array(factors["base_color"][:3])))
    }
    if maps.has_occlusion:
        tiles["occlusion"] = small(maps.orm[..., :1])
    for channel, name in ((1, "roughness"), (2, "metallic")):
        tiles[name] = (
            small(maps.orm[..., channel : channel + 1]) * factors[name][0]
            if maps.has_roughness_metallic
            else plain(factors[name][0])
        )
    if maps.normal is not None:
        tiles["normal"] = small(maps.normal)
    if maps.emissive is not None:
        tiles["emissive"] = small(maps.emissive)
    tiles |= {name: small(image) for name, image in maps.extra.items()}
    return contact_sheet([list(tiles.values())], labels_top=list(tiles))
