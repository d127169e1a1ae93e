"""Writing a Scene as one binary glTF 2.0 file with embedded PNG textures."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from gdtool import __version__
from gdtool.assets.scene import Material, Scene, Texture
from gdtool.core.errors import OutputError, ResourceError, from_os_error
from gdtool.geometry.meshes import TriMesh

_COMPONENT = {"float32": 5126, "uint8": 5121, "uint16": 5123, "uint32": 5125}
_WRAP = {"repeat": 10497, "clamp": 33071, "mirror": 33648}
_FILTERS = {"linear": (9729, 9987), "nearest": (9728, 9984)}  # magnification; minification with mip maps
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963


def write_glb(
    path: str | Path, scene: Scene, extras: dict[str, Any] | None = None, made: dict[int, str | bytes] | None = None
) -> None:
    """Write a .glb: one node, one mesh, a primitive per material in use; the same scene gives the same bytes.

    Every metallicFactor and roughnessFactor is written out (the format's default metal is 1). Textures whose Texture
    shares one image array become one embedded PNG, so that occlusion and metallic-roughness can be one file. Colour
    textures are stored as sRGB and the others as linear, as the format demands. extras goes to asset.extras. made: by
    id of an image array, its PNG where there is one already: the bytes, or the name of the file beside the .glb that
    holds it, which is then referred to. Tangents are written where the material has a normal map, MikkTSpace's where
    the scene has none. Raises OutputError, ResourceError beyond 4 GiB."""
    content = glb_bytes(scene, extras, made)
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        whole = path.read_bytes() == content
    except OSError as error:
        raise from_os_error(error, path) from None
    if not whole:
        raise OutputError(
            path, "was not written whole (it reads back otherwise)", "free some space or choose another -o"
        )


def glb_bytes(scene: Scene, extras: dict[str, Any] | None = None, made: dict[int, str | bytes] | None = None) -> bytes:
    """Return the content of the file that write_glb writes."""
    _check(scene)
    document = _Document(made or {})
    uv_slots = [i for i, uv in enumerate(scene.uvs) if uv is not None]
    primitives = []
    for index in np.unique(scene.material_idx):
        material = scene.materials[index]
        faces = scene.faces[scene.material_idx == index]
        used, local, tangents = _split(scene, material, faces, uv_slots)
        primitives.append(
            {
                "attributes": _attributes(document, scene, used, tangents, uv_slots),
                "indices": document.accessor(local.reshape(-1), "SCALAR", _ELEMENT_ARRAY_BUFFER),
                "material": document.unique("materials", _material(document, material, uv_slots)),
            }
        )
    document.json["meshes"] = [{"name": scene.name, "primitives": primitives}]
    document.json["nodes"] = [{"name": scene.name, "mesh": 0}]
    document.json["scenes"] = [{"nodes": [0]}]
    if extras:
        document.json["asset"]["extras"] = extras
    return document.packed()


def _check(scene: Scene) -> None:
    """Raise ValueError for a scene that no caller may mean."""
    if not len(scene.faces):
        raise ValueError("a scene to write has no faces")
    if scene.faces.min() < 0 or scene.faces.max() >= len(scene.vertices):
        raise ValueError("a face of the scene to write refers to a vertex out of range")
    for name in ("vertices", "normals", "tangents", "colors"):
        array = getattr(scene, name)
        if array is not None and not np.isfinite(array).all():
            raise ValueError(f"{name} of the scene to write are not finite")
    for uv in scene.uvs:
        if uv is not None and not np.isfinite(uv).all():
            raise ValueError("uvs of the scene to write are not finite")


def _split(
    scene: Scene, material: Material, faces: np.ndarray, uv_slots: list[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Vertices (n,) that one primitive uses, its corners as positions among them, and tangents (n, 4) where it needs
    them.

    A vertex stands more than once where its faces' tangents differ.
    """
    used, local = np.unique(faces, return_inverse=True)
    if material.normal_texture is None or scene.normals is None:
        return used, local, None
    normals = _unit_normals(scene)
    if scene.tangents is not None:
        return used, local, _unit_tangents(scene.tangents[used], normals[used])
    if material.normal_texture.uv_set not in uv_slots:
        return used, local, None
    from gdtool.geometry.tangents import corner_tangents, number_distinct_rows

    uv = scene.uvs[material.normal_texture.uv_set]
    assert uv is not None  # uv_slots are those that there are
    tangents = corner_tangents(TriMesh(scene.vertices, faces), normals, uv, faces).reshape(-1, 4)
    corner = faces.reshape(-1, 1)
    split = number_distinct_rows(corner // 4096, corner % 4096, tangents)  # float32 holds no large index
    first = np.unique(split, return_index=True)[1]
    used = corner[first, 0]
    return used, split, _unit_tangents(tangents[first], normals[used])


def _attributes(
    document: _Document, scene: Scene, used: np.ndarray, tangents: np.ndarray | None, uv_slots: list[int]
) -> dict[str, int]:
    out = {
        "POSITION": document.accessor(np.asarray(scene.vertices, np.float32)[used], "VEC3", _ARRAY_BUFFER, bounds=True)
    }
    if scene.normals is not None:
        normals = _unit_normals(scene)[used]
        out["NORMAL"] = document.accessor(normals.astype(np.float32), "VEC3", _ARRAY_BUFFER)
        if tangents is not None:
            out["TANGENT"] = document.accessor(tangents, "VEC4", _ARRAY_BUFFER)
    for slot, index in enumerate(uv_slots):
        out[f"TEXCOORD_{slot}"] = document.accessor(
            np.asarray(scene.uvs[index], np.float32)[used], "VEC2", _ARRAY_BUFFER
        )
    if scene.colors is not None:
        colors = np.clip(scene.colors, 0, 1).astype(np.float32)
        opaque = scene.colors.shape[1] == 3 or bool((colors[:, 3] == 1).all())
        out["COLOR_0"] = document.accessor(
            colors[used][:, :3] if opaque else colors[used], "VEC3" if opaque else "VEC4", _ARRAY_BUFFER
        )
    return out


def _unit_normals(scene: Scene) -> np.ndarray:
    """(v, 3) unit; where a given normal has no length, the faces' own, and +Y where even they have none."""
    length = np.linalg.norm(scene.normals, axis=1, keepdims=True)
    normals = scene.normals / np.maximum(length, 1e-30)
    bad = length[:, 0] < 1e-6
    if bad.any():
        from gdtool.geometry.normals import vertex_normals

        normals[bad] = vertex_normals(TriMesh(scene.vertices, scene.faces))[bad]
        normals[np.linalg.norm(normals, axis=1) < 0.5] = (0, 1, 0)
    return normals


def _unit_tangents(tangents: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(v, 4) float32: unit directions and w exactly 1 or -1; any direction across the normal where one has no
    length."""
    direction = tangents[:, :3].astype(np.float64)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0, 0), (0, 1.0, 0)))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    direction = np.where(length > 1e-6, direction / np.maximum(length, 1e-30), across)
    return np.concatenate([direction, np.where(tangents[:, 3:] < 0, -1.0, 1.0)], 1).astype(np.float32)


def _material(document: _Document, material: Material, uv_slots: list[int]) -> dict[str, Any]:
    def info(texture: Texture | None, encoding: str, **extra: float) -> dict[str, Any] | None:
        return None if texture is None else document.texture(texture, encoding, uv_slots) | extra

    surface: dict[str, Any] = {
        "baseColorFactor": [float(x) for x in material.base_color],
        "baseColorTexture": info(material.base_color_texture, "srgb"),
        "metallicFactor": float(material.metallic),
        "roughnessFactor": float(material.roughness),
        "metallicRoughnessTexture": info(material.metallic_roughness_texture, "linear"),
    }
    strength = max(1.0, float(max(material.emissive)))
    out: dict[str, Any] = {
        "name": material.name,
        "pbrMetallicRoughness": {k: v for k, v in surface.items() if v is not None},
        "normalTexture": info(material.normal_texture, "linear", **_unless_one("scale", material.normal_scale)),
        "occlusionTexture": info(
            material.occlusion_texture, "linear", **_unless_one("strength", material.occlusion_strength)
        ),
        "emissiveTexture": info(material.emissive_texture, "srgb"),
        "emissiveFactor": [float(x) / strength for x in material.emissive] if max(material.emissive) > 0 else None,
        "alphaMode": material.alpha_mode if material.alpha_mode != "OPAQUE" else None,
        "alphaCutoff": float(material.alpha_cutoff) if material.alpha_mode == "MASK" else None,
        "doubleSided": True if material.double_sided else None,
    }
    extensions: dict[str, Any] = {}
    if strength > 1:
        extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": strength}
    if material.unlit:
        extensions["KHR_materials_unlit"] = {}
    if material.ior != 1.5:
        extensions["KHR_materials_ior"] = {"ior": float(material.ior)}
    if material.specular != 1.0:
        extensions["KHR_materials_specular"] = {"specularFactor": float(material.specular)}
    document.extensions.update(extensions)
    out["extensions"] = extensions or None
    return {k: v for k, v in out.items() if v is not None}


def _unless_one(name: str, value: float) -> dict[str, float]:
    return {} if value == 1 else {name: float(value)}


class _Document:
    """The JSON and binary halves of a GLB while they grow."""

    def __init__(self, made: dict[int, str | bytes]) -> None:
        self._made = made
        self.json: dict[str, Any] = {"asset": {"version": "2.0", "generator": f"gdtool {__version__}"}, "scene": 0}
        self.binary = bytearray()
        self.extensions: set[str] = set()
        self._images: dict[tuple[int, bool], tuple[np.ndarray, int]] = {}

    def unique(self, kind: str, item: dict[str, Any]) -> int:
        """Index of item in json[kind], added unless it is there."""
        items = self.json.setdefault(kind, [])
        if item not in items:
            items.append(item)
        return items.index(item)

    def view(self, content: bytes, target: int | None = None) -> int:
        """Index of a new buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(content)}
        if target:
            view["target"] = target
        self.binary += content
        return self._append("bufferViews", view)

    def accessor(self, array: np.ndarray, kind: str, target: int, bounds: bool = False) -> int:
        """Index of a new accessor; indices take the narrowest type that keeps clear of the restart value."""
        if target == _ELEMENT_ARRAY_BUFFER:
            array = array.astype(np.uint16 if array.max() < 65535 else np.uint32)
        array = np.ascontiguousarray(array)
        item: dict[str, Any] = {
            "bufferView": self.view(array.astype(array.dtype.newbyteorder("<")).tobytes(), target),
            "componentType": _COMPONENT[array.dtype.name],
            "count": len(array),
            "type": kind,
        }
        if bounds:
            item |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        return self._append("accessors", item)

    def texture(self, texture: Texture, encoding: str, uv_slots: list[int]) -> dict[str, Any]:
        """Return the textureInfo of a texture."""
        magnify, minify = _FILTERS[texture.filter]
        sampler = self.unique(
            "samplers",
            {"magFilter": magnify, "minFilter": minify, "wrapS": _WRAP[texture.wrap_u], "wrapT": _WRAP[texture.wrap_v]},
        )
        info: dict[str, Any] = {
            "index": self.unique("textures", {"sampler": sampler, "source": self._image(texture, encoding)})
        }
        uv_set = uv_slots.index(texture.uv_set) if texture.uv_set in uv_slots else 0
        if uv_set:
            info["texCoord"] = uv_set
        transform = {
            "offset": [float(x) for x in texture.offset],
            "rotation": float(texture.rotation),
            "scale": [float(x) for x in texture.scale],
        }
        if transform != {"offset": [0.0, 0.0], "rotation": 0.0, "scale": [1.0, 1.0]}:
            info["extensions"] = {"KHR_texture_transform": transform}
            self.extensions.add("KHR_texture_transform")
        return info

    def _image(self, texture: Texture, encoding: str) -> int:
        convert = texture.encoding != encoding
        key = (id(texture.image), convert)
        if key not in self._images:
            from gdtool.images.io import encode_png

            made = None if convert else self._made.get(id(texture.image))
            item: dict[str, Any] = {"uri": made, "mimeType": "image/png"}
            if not isinstance(made, str):
                content = encode_png(_encoded(texture.image, texture.encoding, encoding)) if made is None else made
                item = {"bufferView": self.view(content), "mimeType": "image/png"}
            # the array stays referenced, so that its id stays its own
            self._images[key] = texture.image, self._append("images", item)
        return self._images[key][1]

    def _append(self, kind: str, item: dict[str, Any]) -> int:
        self.json.setdefault(kind, []).append(item)
        return len(self.json[kind]) - 1

    def packed(self) -> bytes:
        """Return the GLB (glTF 2.0 specification, section 4)."""
        if self.extensions:
            self.json["extensionsUsed"] = sorted(self.extensions)
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["buffers"] = [{"byteLength": len(self.binary)}]
        text = json.dumps(self.json, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + 8 + len(self.binary)
        if total >= 1 << 32:
            raise ResourceError(
                "asset.glb",
                f"would have {total >> 30} GiB, more than the format's 4",
                "use fewer faces or smaller maps",
            )
        return b"".join(
            [
                struct.pack("<4sII", b"glTF", 2, total),
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(self.binary), b"BIN\0"),
                bytes(self.binary),
            ]
        )


def _encoded(image: np.ndarray, from_encoding: str, to_encoding: str) -> np.ndarray:
    """image with its colour channels in another encoding; alpha stays. As stored when the encodings agree."""
    if from_encoding == to_encoding:
        return image
    from gdtool.images.color import linear_from_srgb, srgb_from_linear, unit_range

    pixels = unit_range(image).reshape(*image.shape[:2], -1)
    colors = pixels.shape[2] - (pixels.shape[2] in (2, 4))
    convert = srgb_from_linear if to_encoding == "srgb" else linear_from_srgb
    return np.concatenate([convert(pixels[..., :colors]), pixels[..., colors:]], -1)
