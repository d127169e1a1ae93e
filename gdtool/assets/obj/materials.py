"""Convert Wavefront MTL materials to metallic-roughness, with defaults for what a file does not say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gdtool.assets.scene import DEFAULT_MATERIAL, Material, Texture
from gdtool.core.errors import GdtoolError
from gdtool.core.memory import require_memory
from gdtool.core.reading import bytes_of
from gdtool.core.references import is_readable, library_folder, map_name, obj_libraries, obj_texture

_CHANNELS = {"r": 0, "g": 1, "b": 2, "m": 3}  # of an image, by the letter of -imfchan
# Bytes of a pixel while two maps are merged: four float32 channels, resized, clipped, scaled and rounded.
_MERGED_BYTES = 48

Statements = dict[str, list[str]]  # of a material: keyword in lower case to the words behind it


class _Definition(NamedTuple):
    """Hold a material of a library: its statements, the .mtl file, and that file's folder relative to the model."""

    statements: Statements
    library: Path
    folder: str


def obj_materials(
    path: Path, libraries: list[str], names: list[str], has_colors: bool
) -> tuple[tuple[Material, ...], list[str]]:
    """Read the materials of an OBJ, one for each name in order, and notes about what was assumed.

    - Base colour: map_Kd, in which case Kd is ignored as Blender does, else Kd, taken as linear.
    - Roughness: map_Pr, Pr, else (2 / (Ns + 2))^(1/4) where Ks is not black (the width of the GGX lobe that is nearest
      to that Blinn-Phong lobe), else 0.5. Metallic: map_Pm, Pm, else 0.
    - Normal map: norm, or a map_Bump that looks like one. Ke, map_Ke, d, Tr and map_d are read; Ni is not, because
      exporters write arbitrary numbers.

    Faces without a material get DEFAULT_MATERIAL, or a white one where vertices have colours. A missing library or
    texture is noted, and defaults stand in for it.

    Raises InputError for references to places that core/references.py does not allow or to what is no regular file,
    and ResourceError for textures that together take more memory than one input may.
    """
    notes: list[str] = []
    definitions: dict[str, _Definition] = {}
    textures = _Textures(path, notes)
    for line in dict.fromkeys(libraries):
        for name, library in obj_libraries(path, line):
            if not is_readable(library):
                notes.append(f"material library {name} is missing")
                continue
            for key, statements in _read_library(library).items():
                definitions.setdefault(key, _Definition(statements, library, library_folder(name)))
    default = replace(DEFAULT_MATERIAL, base_color=(1.0, 1.0, 1.0, 1.0)) if has_colors else DEFAULT_MATERIAL
    materials = []
    for name in names:
        if name in definitions:
            materials.append(_material(name, definitions[name], textures, notes))
        else:
            notes.append(
                f"material {name!r} is not defined: a dielectric of roughness 0.5"
                if name
                else "faces without a material are a dielectric of roughness 0.5"
            )
            materials.append(replace(default, name=name or default.name))
    return tuple(materials), list(dict.fromkeys(notes))


def _read_library(path: Path) -> dict[str, Statements]:
    """Read the statements of each material of a .mtl file, by its name."""
    materials: dict[str, Statements] = {}
    current: Statements | None = None
    for line in bytes_of(path).decode("utf-8", "replace").splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] == "newmtl":
            current = materials.setdefault(" ".join(words[1:]), {})
        elif current is not None:
            current[words[0].lower()] = words[1:]
    return materials


def _material(name: str, definition: _Definition, textures: _Textures, notes: list[str]) -> Material:
    """Convert one material and read its textures."""
    statements = definition.statements

    def numbers(key: str) -> list[float]:
        """Return the finite numbers of a statement; none where it is absent or malformed."""
        try:
            values = [float(word) for word in statements.get(key, [])]
        except ValueError:
            notes.append(f"material {name!r}: {key} is not a number and is ignored")
            return []
        return values if np.isfinite(values).all() else []

    def image(key: str) -> np.ndarray | None:
        if key not in statements:
            return None
        return textures.image(statements[key], definition.library, definition.folder)

    diffuse, specular, exponent, emission = numbers("kd"), numbers("ks"), numbers("ns"), numbers("ke")
    alpha = _clipped(numbers("d")[0]) if numbers("d") else 1 - _clipped(numbers("tr")[0]) if numbers("tr") else 1.0
    roughness = 0.5
    if numbers("pr"):
        roughness = _clipped(numbers("pr")[0])
    elif exponent and max(specular or [0.0]) > 0:
        roughness = _clipped((2 / (max(exponent[0], 0.0) + 2)) ** 0.25)
    metallic = _clipped(numbers("pm")[0]) if numbers("pm") else 0.0
    color_map, alpha_map = image("map_kd"), image("map_d")
    red, green, blue = DEFAULT_MATERIAL.base_color[:3]
    if color_map is not None:
        red, green, blue = 1.0, 1.0, 1.0
    elif diffuse:
        red, green, blue = (_clipped(x) for x in (diffuse * 3)[:3])  # one number stands for three
    glow_red, glow_green, glow_blue = (max(0.0, x) for x in ((emission or [0.0]) * 3)[:3])
    emissive = (glow_red, glow_green, glow_blue)
    material = Material(
        name=name,
        base_color=(red, green, blue, alpha),
        roughness=roughness,
        metallic=metallic,
        alpha_mode="BLEND" if alpha < 1 else "OPAQUE",
        emissive=emissive,
    )
    if color_map is not None:
        color_map = _rgb(color_map)
        if alpha_map is not None:
            _require_merged(textures.model, color_map, alpha_map)
            color_map = _with_alpha(color_map, alpha_map)
            material = replace(material, alpha_mode="BLEND")
        material = replace(material, base_color_texture=Texture(color_map, "srgb"))
    roughness_map, metallic_map = image("map_pr"), image("map_pm")
    if roughness_map is not None or metallic_map is not None:
        _require_merged(textures.model, roughness_map, metallic_map)
        material = replace(
            material,
            metallic_roughness_texture=Texture(_packed(roughness_map, metallic_map)),
            roughness=1.0 if roughness_map is not None else roughness,
            metallic=1.0 if metallic_map is not None else metallic,
        )
    emissive_map = image("map_ke")
    if emissive_map is not None:
        material = replace(
            material,
            emissive_texture=Texture(_rgb(emissive_map), "srgb"),
            emissive=emissive if max(emissive) > 0 else (1.0, 1.0, 1.0),
        )
    for key in ("norm", "map_norm", "map_bump", "bump"):
        normal_map = image(key)
        if normal_map is None:
            continue
        if "bump" in key and not _is_normal_map(normal_map):
            notes.append(f"material {name!r}: {key} is a height map and is ignored")
            continue
        return replace(material, normal_texture=Texture(_rgb(normal_map)))
    return material


def _clipped(x: float) -> float:
    """Clip a factor to [0, 1]."""
    return min(1.0, max(0.0, x))


class _Textures:
    """Read the images of a model's materials, each once; notes gets a line for each image that is left out."""

    def __init__(self, model: Path, notes: list[str]) -> None:
        self.model, self.notes = model, notes
        self._images: dict[Path, np.ndarray | None] = {}
        self._held = 0  # bytes

    def image(self, words: list[str], library: Path, folder: str) -> np.ndarray | None:
        """Read the image of a texture statement, or the channel that -imfchan names; None where it cannot be read.

        words: those behind the keyword. library: the .mtl file; folder: that file's folder relative to the model.
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
        """Decode an image; None, with a note, where that fails. Raises ResourceError when all take too much memory."""
        from gdtool.images.io import read_image

        try:
            image = read_image(path)
        except GdtoolError as error:
            self.notes.append(f"texture {name}: {error.fact} and is left out")
            return None
        self._held += image.nbytes
        require_memory(self._held, self.model, f"the texture {name} and those before it", "scale the textures down")
        return image


def _rgb(image: np.ndarray) -> np.ndarray:
    """Repeat grey in three channels; alpha and RGB images stay."""
    return np.concatenate([np.repeat(image[..., :1], 3, -1), image[..., 1:]], -1) if image.shape[2] < 3 else image


def _require_merged(model: Path, *maps: np.ndarray | None) -> None:
    """Raise ResourceError where merging maps, to the greatest height and width of them, would take too much memory."""
    shapes = [image.shape for image in maps if image is not None]
    height, width = max(shape[0] for shape in shapes), max(shape[1] for shape in shapes)
    require_memory(
        height * width * _MERGED_BYTES,
        model,
        f"merging two maps at {width}x{height} pixels",
        "make the maps of one material equally large",
    )


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize an image to (height, width) by nearest neighbours."""
    rows = np.arange(height) * image.shape[0] // height
    columns = np.arange(width) * image.shape[1] // width
    return image[rows][:, columns]


def _grey(image: np.ndarray) -> np.ndarray:
    """Return the first channel (h, w) as uint8; the maps of a scalar are grey, or repeat it."""
    from gdtool.images.color import unit_range
    from gdtool.images.io import quantized

    return quantized(unit_range(image[..., 0]))


def _packed(roughness: np.ndarray | None, metallic: np.ndarray | None) -> np.ndarray:
    """Pack maps as glTF does, (h, w, 3) uint8: roughness in G, metallic in B, 255 for an absent one."""
    shapes = [image.shape for image in (roughness, metallic) if image is not None]
    height, width = max(shape[0] for shape in shapes), max(shape[1] for shape in shapes)
    out = np.full((height, width, 3), 255, np.uint8)
    for channel, image in ((1, roughness), (2, metallic)):
        if image is not None:
            out[..., channel] = _resized(_grey(image), height, width)
    return out


def _with_alpha(color: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Give a colour map the alpha of map_d, its alpha channel or else its first channel; returns (h, w, 4) uint8."""
    from gdtool.images.color import unit_range
    from gdtool.images.io import quantized

    source = alpha[..., -1:] if alpha.shape[2] in (2, 4) else alpha[..., :1]
    height, width = max(color.shape[0], source.shape[0]), max(color.shape[1], source.shape[1])
    pixels = np.concatenate(
        [_resized(unit_range(color[..., :3]), height, width), _resized(unit_range(source), height, width)], -1
    )
    return quantized(pixels)


def _is_normal_map(image: np.ndarray) -> bool:
    """Tell whether a bump map holds tangent-space normals: its mean colour is near (0.5, 0.5, 1)."""
    from gdtool.images.color import unit_range

    if image.shape[2] < 3:
        return False
    mean = unit_range(image[..., :3]).reshape(-1, 3).mean(0)
    return bool(mean[2] > 0.75 and abs(mean[0] - 0.5) < 0.15 and abs(mean[1] - 0.5) < 0.15)
