"""Maps as files hold them: packing, quantising, and what needs no map at all."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gdtool.bake.padding import Gutters
from gdtool.bake.target import Texels
from gdtool.core.threads import mapped

# Smaller differences than this, in stored units, are no detail: one step of 8 bits and rounding.
CONSTANT_RANGE = 1.5 / 255
# 99.5 % of a normal map within this angle of straight up is flat: 8 bits store normals to 0.4 degrees.
FLAT_DEGREES = 1.0
_ROWS_AT_ONCE = 64
HEIGHT_BITS = 16  # a step of 8 bits is a visible terrace


@dataclass(frozen=True)
class Maps:
    """Maps as stored, uint8 or uint16, (s, s, c), None where a factor or nothing takes their place.

    base_color RGB(A) sRGB; orm R occlusion, G roughness, B metallic; normal tangent space, +Y up; emissive RGB sRGB;
    extra: grey maps that no material refers to, height and confidence. factors: base_color linear RGBA, roughness,
    metallic, emissive linear RGB where anything shines, what the material's factors have to be; height, the distance
    that 0 and 1 of that map stand for below and above the surface. has_occlusion: orm's R means something.
    has_roughness_metallic: G and B do. skipped: (what, why, seconds that gutters and storing would have taken, those of
    one that is stored, or None)."""

    size: int
    base_color: np.ndarray | None
    orm: np.ndarray | None
    normal: np.ndarray | None
    factors: dict[str, tuple[float, ...]]
    has_occlusion: bool = False
    has_roughness_metallic: bool = False
    emissive: np.ndarray | None = None
    extra: dict[str, np.ndarray] = field(default_factory=dict)
    skipped: list[tuple[str, str, float | None]] = field(default_factory=list)


def quantise(image: np.ndarray, bits: int) -> np.ndarray:
    """[0, 1] floats to uint8 or uint16, to the nearest step."""
    top, kind = (255, np.uint8) if bits == 8 else (65535, np.uint16)
    scaled = np.clip(image, 0, 1)
    scaled *= image.dtype.type(top)
    return np.rint(scaled, out=scaled).astype(kind)


def constant_of(
    values: np.ndarray, tolerance: float = CONSTANT_RANGE, encoding: Callable = lambda x: x
) -> np.ndarray | None:
    """The middle of values (n,) or (n, c), float64, when no channel spans more than tolerance, else None; both as
    encoding, which is monotonic, has them."""
    if not len(values):
        return None
    low, high = (encoding(np.clip(end, 0, 1).astype(np.float64)) for end in (values.min(0), values.max(0)))
    return (low + high) / 2 if np.all(high - low <= tolerance) else None


def flat_angle(tangent_normals: np.ndarray) -> float:
    """Angle in degrees from straight up that 99.5 % of tangent-space normals (n, 3) stay within."""
    if not len(tangent_normals):
        return 0.0
    # The component that is straight up falls as the angle grows: its percentile is the angle's, and needs no sine.
    up = float(np.percentile(tangent_normals[:, 2], 0.5))
    return float(np.degrees(np.arccos(np.clip(up, -1, 1))))


def make_maps(
    texels: Texels,
    values: dict[str, np.ndarray],
    *,
    occlusion: np.ndarray | None = None,
    bits: int = 8,
    padding: int | None = None,
    normal_map: str = "auto",
    least_alpha: float = 0.5 / 255,
    threads: int = 1,
) -> Maps:
    """Maps of what texels read (bake.Baked.values): albedo, roughness, metallic, tangent_normal, perhaps alpha,
    emissive (n, 3) linear, height (n,) in the target's units, confidence (n,) in [0, 1].

    occlusion (n,) or None. normal_map "auto" leaves a flat map out. Gutters are filled over `padding` texels,
    everywhere when None. Color of less alpha than least_alpha is never seen: it is filled like a gutter, or filtering
    would draw what painters leave there, black mostly, around all that is seen."""
    from gdtool.images.color import linear_from_srgb, srgb_from_linear

    inside = slice(0, texels.inside)
    skipped: list[tuple[str, str]] = []
    layers: dict[str, list[np.ndarray | None]] = {}
    color = [values["albedo"][:, k] for k in range(3)]
    alpha = np.clip(values["alpha"], 0, 1) if "alpha" in values else None
    if alpha is not None and alpha[inside].min() >= 1 - CONSTANT_RANGE:
        alpha = None
        skipped.append(("alpha", "opaque everywhere"))
    constants = (
        [constant_of(channel[inside], encoding=srgb_from_linear) for channel in color] if alpha is None else [None]
    )
    if any(constant is None for constant in constants):
        factors: dict[str, tuple[float, ...]] = {"base_color": (1.0, 1.0, 1.0, 1.0)}
        layers["base_color"] = color if alpha is None else [*color, alpha]
    else:
        factors = {"base_color": (*(round(float(x), 6) for x in linear_from_srgb(np.array(constants))), 1.0)}
        skipped.append(("base_color map", "base color is constant: a factor says it"))
    packed: list[np.ndarray | None] = [None, None, None]
    for channel, name in ((1, "roughness"), (2, "metallic")):
        constant = constant_of(values[name][inside])
        if constant is None:
            factors[name] = (1.0,)
            packed[channel] = values[name]
        else:
            factors[name] = (round(float(constant), 6),)
    varies = any(channel is not None for channel in packed)
    if not varies:
        skipped.append(("roughness and metallic map", "both are constant: factors say them"))
    open_everywhere = occlusion is not None and occlusion[inside].min(initial=1) > 1 - 2 / 255
    if open_everywhere:
        skipped.append(("occlusion map", "nothing is occluded"))
    has_occlusion = occlusion is not None and not open_everywhere
    if has_occlusion:
        packed[0] = occlusion
    if varies or has_occlusion:
        layers["orm"] = packed
    angle = flat_angle(values["tangent_normal"][inside])
    if normal_map == "on" or (normal_map == "auto" and angle > FLAT_DEGREES):
        layers["normal"] = list(np.moveaxis(values["tangent_normal"], -1, 0))
    elif normal_map == "auto":
        skipped.append(("normal map", f"would be flat: {angle:.2f} degrees"))
    if "emissive" in values and (top := float(values["emissive"][inside].max(initial=0))) > CONSTANT_RANGE:
        shining = [values["emissive"][:, k] / np.float32(top) for k in range(3)]
        constants = [constant_of(channel[inside], encoding=srgb_from_linear) for channel in shining]
        if any(constant is None for constant in constants):
            factors["emissive"], layers["emissive"] = (round(top, 6),) * 3, shining
        else:
            factors["emissive"] = tuple(round(float(x) * top, 6) for x in linear_from_srgb(np.array(constants)))
            skipped.append(("emissive map", "emission is constant: a factor says it"))
    if "height" in values:
        reach = max(float(np.abs(values["height"][inside]).max(initial=0)), 1e-6)
        factors["height"], layers["height"] = (reach,), [0.5 + 0.5 * values["height"] / np.float32(reach)]
    if "confidence" in values:
        layers["confidence"] = [values["confidence"]]
    gutters = Gutters(texels.mask(), padding)
    planes = {
        name: [
            _Plane(channel, gutters, srgb_from_linear if name in ("base_color", "emissive") and k < 3 else None)
            # Alpha, the fourth channel, is never sRGB.
            for k, channel in enumerate(layer)
        ]
        for name, layer in layers.items()
    }
    if alpha is not None and (hidden := alpha < least_alpha).any() and not hidden.all():
        seen = Gutters(texels.image(~hidden), padding)
        planes["base_color"][:3] = [
            _Plane(np.where(hidden, np.float32(0), channel), seen, srgb_from_linear) for channel in color
        ]
    start = time.perf_counter()
    stored = _stored(texels, planes, {name: HEIGHT_BITS if name == "height" else bits for name in planes}, threads)
    one = (time.perf_counter() - start) / len(stored) if stored else None
    return Maps(
        texels.size,
        stored.get("base_color"),
        stored.get("orm"),
        stored.get("normal"),
        factors,
        has_occlusion,
        varies,
        stored.get("emissive"),
        {name: stored[name] for name in ("height", "confidence") if name in stored},
        [(what, why, one if what.endswith("map") else None) for what, why in skipped],
    )


@dataclass(frozen=True)
class _Plane:
    """One channel of a map: values (n,) in [0, 1], or of a unit vector; None for 1 everywhere. encoding: what they are
    put through first."""

    values: np.ndarray | None
    gutters: Gutters
    encoding: Callable | None


def _stored(
    texels: Texels, layers: dict[str, list[_Plane]], bits: dict[str, int], threads: int
) -> dict[str, np.ndarray]:
    """(s, s, c) uint8 or uint16 of each layer's channels, gutters filled; "normal" is stored as 0.5 n + 0.5 of unit
    vectors."""
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
    """A stored normal map with its green channel turned: +Y down."""
    out = normal.copy()
    out[..., 1] = np.iinfo(normal.dtype).max - normal[..., 1]
    return out


def contact_sheet_of(maps: Maps, width: int = 384) -> np.ndarray:
    """(h, w, 3) uint8 picture of the maps side by side, channels of the packed one apart; factors as plain squares."""
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
