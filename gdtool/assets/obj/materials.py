"""Wavefront MTL materials as metallic-roughness, with the defaults that stand in for what a file does not say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.scene import DEFAULT_MATERIAL, Material, Texture
from gdtool.core.errors import GdtoolError
from gdtool.core.memory import require_memory
from gdtool.core.reading import bytes_of
from gdtool.core.references import is_readable, library_folder, map_name, obj_libraries, obj_texture

_CHANNELS = {"r": 0, "g": 1, "b": 2, "m": 3}
# Of one pixel while two maps become one: four float32 channels, resized, clipped, scaled and rounded.
_MERGED_BYTES = 48


def obj_materials(
    path: Path, libraries: list[str], names: list[str], has_colors: bool
) -> tuple[tuple[Material, ...], list[str]]:
    """Return the materials of an OBJ, one for each name in order, and notes about what was assumed.

    base color: map_Kd (then Kd is ignored, as Blender does), else Kd, linear. roughness: map_Pr, Pr, else from Ns where
    Ks reflects at all: (2 / (Ns + 2))^(1/4), the GGX width of that Blinn-Phong lobe; else 0.5. metallic: map_Pm, Pm,
    else 0. norm, or a map_Bump that is blue all over, is the normal map. Ke, map_Ke, d, Tr and map_d are read, Ni is
    not (exporters fill it at will). Faces without a material are DEFAULT_MATERIAL; white where vertices have colours. A
    missing library or texture is noted and its defaults taken; one that lies elsewhere than core/references.py allows,
    or is no regular file, is an InputError. ResourceError for textures that together take more memory than one input
    may."""
    notes: list[str] = []
    records: dict[str, dict[str, list[str]]] = {}
    textures = _Textures(path, notes)
    places: dict[str, tuple[Path, str]] = {}
    for line in dict.fromkeys(libraries):
        for name, library in obj_libraries(path, line):
            if not is_readable(library):
                notes.append(f"material library {name} is missing")
                continue
            for key, record in _read_library(library).items():
                records.setdefault(key, record)
                places.setdefault(key, (library, library_folder(name)))
    default = replace(DEFAULT_MATERIAL, base_color=(1.0, 1.0, 1.0, 1.0)) if has_colors else DEFAULT_MATERIAL
    out = []
    for name in names:
        if name in records:
            out.append(_material(name, records[name], places[name], textures, notes))
        else:
            notes.append(
                f"material {name!r} is not defined: a dielectric of roughness 0.5"
                if name
                else "faces without a material are a dielectric of roughness 0.5"
            )
            out.append(replace(default, name=name or default.name))
    return tuple(out), list(dict.fromkeys(notes))


def _read_library(path: Path) -> dict[str, dict[str, list[str]]]:
    """Material name to statements, keyword in lower case to words."""
    out: dict[str, dict[str, list[str]]] = {}
    current: dict[str, list[str]] | None = None
    for line in bytes_of(path).decode("utf-8", "replace").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] == "newmtl":
            current = out.setdefault(" ".join(words[1:]), {})
        elif current is not None:
            current[words[0].lower()] = words[1:]
    return out


def _material(
    name: str, record: dict[str, list[str]], place: tuple[Path, str], textures: _Textures, notes: list[str]
) -> Material:
    def numbers(key: str) -> list[float]:
        try:
            values = [float(word) for word in record.get(key, [])]
        except ValueError:
            notes.append(f"material {name!r}: {key} is not a number and is ignored")
            return []
        return values if np.isfinite(values).all() else []

    def image(key: str) -> np.ndarray | None:
        return textures.image(record[key], *place) if key in record else None

    def unit(x: float) -> float:
        return min(1.0, max(0.0, x))

    kd, ks, ns, ke = numbers("kd"), numbers("ks"), numbers("ns"), numbers("ke")
    alpha = unit(numbers("d")[0]) if numbers("d") else 1 - unit(numbers("tr")[0]) if numbers("tr") else 1.0
    roughness = 0.5
    if numbers("pr"):
        roughness = unit(numbers("pr")[0])
    elif ns and max(ks or [0.0]) > 0:
        roughness = unit((2 / (max(ns[0], 0.0) + 2)) ** 0.25)
    metallic = unit(numbers("pm")[0]) if numbers("pm") else 0.0
    color_map, alpha_map = image("map_kd"), image("map_d")
    color = (
        (1.0, 1.0, 1.0)
        if color_map is not None
        else tuple(unit(x) for x in (kd * 3)[:3])
        if kd
        else DEFAULT_MATERIAL.base_color[:3]
    )
    out = Material(
        name=name,
        base_color=(*color, alpha),
        roughness=roughness,
        metallic=metallic,
        alpha_mode="BLEND" if alpha < 1 else "OPAQUE",
        emissive=tuple(max(0.0, x) for x in (ke * 3)[:3]) if ke else (0.0, 0.0, 0.0),
    )
    if color_map is not None:
        color_map = _spread(color_map)
        if alpha_map is not None:
            _require_merged(textures.model, color_map, alpha_map)
            color_map = _with_alpha(color_map, alpha_map)
            out = replace(out, alpha_mode="BLEND")
        out = replace(out, base_color_texture=Texture(color_map, "srgb"))
    roughness_map, metallic_map = image("map_pr"), image("map_pm")
    if roughness_map is not None or metallic_map is not None:
        _require_merged(textures.model, roughness_map, metallic_map)
        packed = _packed(roughness_map, metallic_map)
        out = replace(
            out,
            metallic_roughness_texture=Texture(packed),
            roughness=1.0 if roughness_map is not None else roughness,
            metallic=1.0 if metallic_map is not None else metallic,
        )
    emissive_map = image("map_ke")
    if emissive_map is not None:
        out = replace(
            out,
            emissive_texture=Texture(_spread(emissive_map), "srgb"),
            emissive=out.emissive if max(out.emissive) > 0 else (1.0, 1.0, 1.0),
        )
    for key in ("norm", "map_norm", "map_bump", "bump"):
        normal_map = image(key)
        if normal_map is None:
            continue
        if "bump" in key and not _is_normal_map(normal_map):
            notes.append(f"material {name!r}: {key} is a height map and is ignored")
            continue
        return replace(out, normal_texture=Texture(_spread(normal_map)))
    return out


class _Textures:
    """The images of one model's materials: each is read once."""

    def __init__(self, model: Path, notes: list[str]):
        self.model, self.notes = model, notes
        self._images: dict[Path, np.ndarray | None] = {}
        self._held = 0  # bytes

    def image(self, words: list[str], library: Path, folder: str) -> np.ndarray | None:
        """Return the image of a texture statement, its one channel where -imfchan asks for it; None (and a note) when
        it cannot be read.

        words: those behind the keyword; library: the .mtl, and folder: its place relative to the model's.
        """
        name, letter = map_name(words)
        path = obj_texture(self.model, name, library, "the texture", folder)
        if path is None:
            self.notes.append("a texture has no name and is left out")
            return None
        if path not in self._images:
            self._images[path] = self._read(path, name)
        image, channel = self._images[path], _CHANNELS.get(letter or "")
        if image is not None and channel is not None and channel < image.shape[2]:
            return image[..., channel : channel + 1]
        return image

    def _read(self, path: Path, name: str) -> np.ndarray | None:
        from gdtool.images.io import read_image

        try:
            image = read_image(path)
        except GdtoolError as error:
            self.notes.append(f"texture {name}: {error.fact} and is left out")
            return None
        self._held += image.nbytes
        require_memory(self._held, self.model, f"the texture {name} and those before it", "scale the textures down")
        return image


def _spread(image: np.ndarray) -> np.ndarray:
    """Grey (and alpha) to RGB (and alpha)."""
    return np.concatenate([np.repeat(image[..., :1], 3, -1), image[..., 1:]], -1) if image.shape[2] < 3 else image


def _require_merged(model: Path, *maps: np.ndarray | None) -> None:
    """Raise ResourceError when maps that become one, as high as the highest and as wide as the widest, would take too
    much memory."""
    given = [one for one in maps if one is not None]
    height, width = max(one.shape[0] for one in given), max(one.shape[1] for one in given)
    require_memory(
        height * width * _MERGED_BYTES,
        model,
        f"merging two maps at {width}x{height} pixels",
        "make the maps of one material equally large",
    )


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    return image[rows][:, columns]


def _grey(image: np.ndarray) -> np.ndarray:
    """(h, w) uint8: the first channel; scalar maps are grey or repeat it."""
    from gdtool.images.color import unit_range
    from gdtool.images.io import quantized

    return quantized(unit_range(image[..., 0]))


def _packed(roughness: np.ndarray | None, metallic: np.ndarray | None) -> np.ndarray:
    """(h, w, 3) uint8 with roughness in G and metallic in B, as glTF packs them; 255 for the one that is absent."""
    given = [_grey(x) for x in (roughness, metallic) if x is not None]
    height, width = max(x.shape[0] for x in given), max(x.shape[1] for x in given)
    out = np.full((height, width, 3), 255, np.uint8)
    for channel, image in ((1, roughness), (2, metallic)):
        if image is not None:
            out[..., channel] = _resized(_grey(image), height, width)
    return out


def _with_alpha(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """color (h, w, 3 or 4) with the alpha that map_d gives: its own alpha channel, else its brightness."""
    from gdtool.images.color import unit_range
    from gdtool.images.io import quantized

    source = alpha[..., -1:] if alpha.shape[2] in (2, 4) else alpha[..., :1]
    height, width = max(color.shape[0], source.shape[0]), max(color.shape[1], source.shape[1])
    pixels = np.concatenate(
        [_resized(unit_range(color[..., :3]), height, width), _resized(unit_range(source), height, width)], -1
    )
    return quantized(pixels)


def _is_normal_map(image: np.ndarray) -> bool:
    """Whether a bump map holds tangent-space normals: mostly blue, around (0.5, 0.5, 1)."""
    from gdtool.images.color import unit_range

    if image.shape[2] < 3:
        return False
    mean = unit_range(image[..., :3]).reshape(-1, 3).mean(0)
    return bool(mean[2] > 0.75 and abs(mean[0] - 0.5) < 0.15 and abs(mean[1] - 0.5) < 0.15)
