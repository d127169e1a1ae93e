"""Write a Scene as one binary glTF 2.0 file (.glb) with embedded PNG textures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gdtool.assets.gltf.builder import ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, GlbBuilder
from gdtool.assets.scene import Material, Scene, Texture
from gdtool.core.errors import OutputError, from_os_error
from gdtool.geometry.meshes import TriMesh

_MIN_LENGTH = 1e-6  # of a normal or tangent, which should be 1; a shorter one has no usable direction


def write_glb(
    path: str | Path, scene: Scene, extras: dict[str, Any] | None = None, pngs: Mapping[int, str | bytes] | None = None
) -> None:
    """Write a .glb with one node, one mesh and a primitive for each material in use.

    The same scene gives the same bytes. metallicFactor and roughnessFactor are always written, because the format's
    default is a metal. Textures that share an image array share an embedded PNG, so that occlusion and
    metallic-roughness can be one image. Colour textures are stored as sRGB and the others as linear, as the format
    demands. Tangents are written where the material has a normal map: the scene's, else MikkTSpace's.

    extras: written to asset.extras. pngs: by the id of an image array, its PNG where there is one already. Bytes are
    embedded; a name is that of a file beside the .glb, which is then referred to.

    Raises OutputError, and ResourceError beyond 4 GiB.
    """
    content = glb_bytes(scene, extras, pngs)
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        whole = path.read_bytes() == content
    except OSError as error:
        raise from_os_error(error, path) from None
    if not whole:
        raise OutputError(
            path, "was not written whole (it reads back differently)", "free some space or choose another -o"
        )


def glb_bytes(
    scene: Scene, extras: dict[str, Any] | None = None, pngs: Mapping[int, str | bytes] | None = None
) -> bytes:
    """Make the content of the file that write_glb writes."""
    _check(scene)
    builder = GlbBuilder(pngs or {})
    uv_slots = [i for i, uv in enumerate(scene.uvs) if uv is not None]
    primitives = []
    for index in np.unique(scene.face_materials):
        material = scene.materials[index]
        faces = scene.faces[scene.face_materials == index]
        vertices = _primitive_vertices(scene, material, faces, uv_slots)
        primitives.append(
            {
                "attributes": _attributes(builder, scene, vertices, uv_slots),
                "indices": builder.accessor(vertices.corners.reshape(-1), "SCALAR", ELEMENT_ARRAY_BUFFER),
                "material": builder.unique("materials", _material(builder, material, uv_slots)),
            }
        )
    builder.json["meshes"] = [{"name": scene.name, "primitives": primitives}]
    builder.json["nodes"] = [{"name": scene.name, "mesh": 0}]
    builder.json["scenes"] = [{"nodes": [0]}]
    if extras:
        builder.json["asset"]["extras"] = extras
    return builder.packed()


def _check(scene: Scene) -> None:
    """Raise ValueError for a scene without faces, with indices out of range or with numbers that are not finite."""
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


class _PrimitiveVertices(NamedTuple):
    """Hold the scene's vertices (n,) that a primitive uses, its corners as indices into them, and tangents (n, 4).

    Tangents are None where the material needs none. A vertex is listed more than once where the tangents of its faces
    differ.
    """

    used: np.ndarray
    corners: np.ndarray
    tangents: np.ndarray | None


def _primitive_vertices(scene: Scene, material: Material, faces: np.ndarray, uv_slots: list[int]) -> _PrimitiveVertices:
    """Choose the vertices of the primitive of some faces (f, 3), and compute tangents where its material needs them."""
    used, local = np.unique(faces, return_inverse=True)
    if material.normal_texture is None or scene.normals is None:
        return _PrimitiveVertices(used, local, None)
    normals = _unit_normals(scene)
    if scene.tangents is not None:
        return _PrimitiveVertices(used, local, _unit_tangents(scene.tangents[used], normals[used]))
    uv_set = material.normal_texture.uv_set
    uv = scene.uvs[uv_set] if uv_set in uv_slots else None
    if uv is None:
        return _PrimitiveVertices(used, local, None)
    from gdtool.geometry.tangents import corner_tangents, number_distinct_rows

    tangents = corner_tangents(TriMesh(scene.vertices, faces), normals, uv, faces).reshape(-1, 4)
    corner = faces.reshape(-1, 1)
    split = number_distinct_rows(corner // 4096, corner % 4096, tangents)  # float32 is not exact for large indices
    first = np.unique(split, return_index=True)[1]
    used = corner[first, 0]
    return _PrimitiveVertices(used, split, _unit_tangents(tangents[first], normals[used]))


def _attributes(builder: GlbBuilder, scene: Scene, vertices: _PrimitiveVertices, uv_slots: list[int]) -> dict[str, int]:
    """Add the vertex attributes of a primitive and return their accessors by name."""
    used = vertices.used
    accessors = {
        "POSITION": builder.accessor(np.asarray(scene.vertices, np.float32)[used], "VEC3", ARRAY_BUFFER, bounds=True)
    }
    if scene.normals is not None:
        normals = _unit_normals(scene)[used]
        accessors["NORMAL"] = builder.accessor(normals.astype(np.float32), "VEC3", ARRAY_BUFFER)
        if vertices.tangents is not None:
            accessors["TANGENT"] = builder.accessor(vertices.tangents, "VEC4", ARRAY_BUFFER)
    for slot, index in enumerate(uv_slots):
        accessors[f"TEXCOORD_{slot}"] = builder.accessor(
            np.asarray(scene.uvs[index], np.float32)[used], "VEC2", ARRAY_BUFFER
        )
    if scene.colors is not None:
        colors = np.clip(scene.colors, 0, 1).astype(np.float32)
        opaque = scene.colors.shape[1] == 3 or bool((colors[:, 3] == 1).all())
        accessors["COLOR_0"] = builder.accessor(
            colors[used][:, :3] if opaque else colors[used], "VEC3" if opaque else "VEC4", ARRAY_BUFFER
        )
    return accessors


def _unit_normals(scene: Scene) -> np.ndarray:
    """Return unit normals (v, 3): for a normal without length those of the faces, +Y where they have none either."""
    stored = scene.normals
    assert stored is not None
    length = np.linalg.norm(stored, axis=1, keepdims=True)
    normals = stored / np.maximum(length, 1e-30)
    bad = length[:, 0] < _MIN_LENGTH
    if bad.any():
        from gdtool.geometry.normals import vertex_normals

        normals[bad] = vertex_normals(TriMesh(scene.vertices, scene.faces))[bad]
        normals[np.linalg.norm(normals, axis=1) < 0.5] = (0, 1, 0)
    return normals


def _unit_tangents(tangents: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return tangents (v, 4) float32 with unit directions and w exactly 1 or -1, as the format demands.

    A tangent without length becomes some direction across the normal.
    """
    direction = tangents[:, :3].astype(np.float64)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    across = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0, 0), (0, 1.0, 0)))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    direction = np.where(length > _MIN_LENGTH, direction / np.maximum(length, 1e-30), across)
    return np.concatenate([direction, np.where(tangents[:, 3:] < 0, -1.0, 1.0)], 1).astype(np.float32)


def _material(builder: GlbBuilder, material: Material, uv_slots: list[int]) -> dict[str, Any]:
    """Make the JSON of a material and add its textures; properties at the format's default are left out."""

    def info(texture: Texture | None, encoding: str, **extra: float) -> dict[str, Any] | None:
        return None if texture is None else builder.texture(texture, encoding, uv_slots) | extra

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
    builder.extensions.update(extensions)
    out["extensions"] = extensions or None
    return {k: v for k, v in out.items() if v is not None}


def _unless_one(name: str, value: float) -> dict[str, float]:
    """Return {name: value}, or {} for the format's default of 1."""
    return {} if value == 1 else {name: float(value)}
