"""Read a glTF 2.0 file into one Scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.assets.gltf.document import SIMPLIFY, GltfFile
from gdtool.assets.gltf.geometry_size import check_geometry
from gdtool.assets.gltf.materials import MaterialReader
from gdtool.assets.gltf.nodes import joint_matrices, visible_nodes, world_matrices
from gdtool.assets.gltf.primitives import MeshPart, compact, placed, read_primitive, unit
from gdtool.assets.scene import DEFAULT_MATERIAL, Material, Scene
from gdtool.geometry.meshes import TriMesh


def read_gltf(path: str | Path) -> Scene:
    """Read the default scene of a .glb or .gltf: every triangle of every node, in world space and in rest pose.

    Skins take the joints' transforms that the nodes hold, without animation; morph targets their default weights.
    Strips and fans become triangles; points and lines are left out and noted. A primitive without a material gets
    DEFAULT_MATERIAL. Raises InputError with the file and the fault, among them a required extension that gdtool does
    not know. Raises ResourceError before any geometry is decoded where all of it would take more memory than one input
    may.
    """
    file = GltfFile(Path(path))
    parts: list[MeshPart] = []
    held = 0
    worlds = world_matrices(file)
    visible = visible_nodes(file)
    check_geometry(file, visible)
    for index in visible:
        node = file.document.nodes[index]
        if node.mesh is None:
            continue
        mesh = file.item(file.document.meshes, node.mesh, "mesh")
        for number, primitive in enumerate(mesh.primitives):
            subject = f"mesh {node.mesh}, primitive {number}"
            part = read_primitive(file, primitive, node.weights or mesh.weights, subject)
            if part is not None:
                matrices = joint_matrices(file, node, worlds, primitive, len(part.vertices), subject)
                parts.append(compact(placed(part, worlds[index] if matrices is None else matrices)))
                held += parts[-1].nbytes
                # A Draco stream may hold more vertices than the JSON, from which check_geometry predicts, says.
                file.check_memory(held, f"{subject} and the geometry before it", SIMPLIFY)
    if not parts:
        raise file.refuse("has no faces", "export the model with its meshes")
    return _joined(file, parts)


def _joined(file: GltfFile, parts: list[MeshPart]) -> Scene:
    """Join parts into one Scene; an attribute that only some parts have gets values that change no picture."""
    reader = MaterialReader(file)
    used = sorted({part.material for part in parts if part.material is not None})
    materials: list[Material] = [reader.material(index) for index in used]
    if any(part.material is None for part in parts):
        materials.append(DEFAULT_MATERIAL)
        file.notes.append("faces without a material get a grey dielectric of roughness 0.5")
    places: dict[int | None, int] = {index: i for i, index in enumerate(used)}
    places[None] = len(materials) - 1
    if any(part.normals is not None for part in parts):
        parts = [part if part.normals is not None else _flat_shaded(part) for part in parts]
    tangents = _common_tangents(file, parts, [materials[places[part.material]] for part in parts])
    uvs = _common_uvs(parts)
    _check_uv_sets(file, materials, len(uvs))
    starts = np.cumsum([0, *[len(part.vertices) for part in parts[:-1]]])
    normals = [part.normals for part in parts if part.normals is not None]  # of all parts, or of none
    return Scene(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]).astype(np.int32),
        materials=tuple(materials),
        material_idx=np.repeat([places[part.material] for part in parts], [len(part.faces) for part in parts]).astype(
            np.int32
        ),
        normals=np.concatenate(normals) if normals else None,
        tangents=tangents,
        uvs=uvs,
        colors=_common_colors(parts),
        name=file.path.stem,
        notes=tuple(dict.fromkeys(file.notes)),
    )


def _flat_shaded(part: MeshPart) -> MeshPart:
    """Give each face three vertices that it does not share, with the face's normal, as glTF asks where normals are
    missing.
    """
    from gdtool.geometry.normals import face_normals

    corner = part.faces.reshape(-1)
    vertices = part.vertices[corner]
    faces = np.arange(len(corner)).reshape(-1, 3)
    normals = np.repeat(face_normals(TriMesh(vertices, faces))[0], 3, axis=0)
    uvs = tuple(None if uv is None else uv[corner] for uv in part.uvs)
    colors = None if part.colors is None else part.colors[corner]
    return MeshPart(vertices, faces, part.material, normals, None, uvs, colors)


def _common_uvs(parts: list[MeshPart]) -> tuple[np.ndarray | None, ...]:
    """Join each UV set (v, 2), zeros for parts without it; None for a set that no part has."""
    uvs: list[np.ndarray | None] = []
    for k in range(max(len(part.uvs) for part in parts)):
        of_parts = [part.uvs[k] if k < len(part.uvs) else None for part in parts]
        if all(uv is None for uv in of_parts):
            uvs.append(None)
            continue
        filled = [
            np.zeros((len(part.vertices), 2)) if uv is None else uv for part, uv in zip(parts, of_parts, strict=True)
        ]
        uvs.append(np.concatenate(filled))
    return tuple(uvs)


def _check_uv_sets(file: GltfFile, materials: list[Material], set_count: int) -> None:
    """Raise InputError where a material looks up a UV set that no mesh has."""
    for material in materials:
        for texture in (material.base_color_texture, material.metallic_roughness_texture, material.normal_texture):
            if texture is not None and texture.uv_set >= set_count:
                raise file.refuse(
                    f"material {material.name!r} looks up texture coordinates {texture.uv_set}, which no mesh has",
                    "export it with that UV map",
                )


def _common_colors(parts: list[MeshPart]) -> np.ndarray | None:
    """Join vertex colours (v, 4), white for parts without them; None where no part has any."""
    if all(part.colors is None for part in parts):
        return None
    return np.concatenate([np.ones((len(p.vertices), 4)) if p.colors is None else p.colors for p in parts])


def _common_tangents(file: GltfFile, parts: list[MeshPart], materials: list[Material]) -> np.ndarray | None:
    """Join the tangents (v, 4) of all parts; None where no part has tangents, or a part that needs them has none.

    materials: of each part. A part whose material has no normal map needs no tangents, and gets any direction across
    the normal. With None the reader of the Scene computes all tangents alike.
    """
    if all(part.tangents is None for part in parts):
        return None
    if any(
        part.tangents is None and material.normal_texture is not None
        for part, material in zip(parts, materials, strict=True)
    ):
        file.notes.append("tangents are only on some parts and are computed anew")
        return None
    tangents = []
    for part in parts:
        if part.tangents is not None:
            tangents.append(part.tangents)
        elif part.normals is not None:
            axis = np.where(np.abs(part.normals[:, :1]) < 0.9, (1.0, 0, 0), (0, 1.0, 0))
            tangents.append(np.concatenate([unit(np.cross(part.normals, axis)), np.ones((len(axis), 1))], 1))
        else:
            return None
    return np.concatenate(tangents)
