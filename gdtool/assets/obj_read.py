"""Wavefront OBJ with its MTL into a Scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.obj_lines import read_lines
from gdtool.assets.obj_materials import obj_materials
from gdtool.assets.polygons import triangulate
from gdtool.assets.scene import Scene
from gdtool.core.errors import InputError
from gdtool.geometry.topology import renumbered
from gdtool.geometry.unique_rows import unique_rows


def read_obj(path: str | Path) -> Scene:
    """Read v (with colours), vt, vn, f, usemtl and mtllib; negative indices count back, polygons are triangulated.

    vt is flipped to the project's v downward. Vertex colours (v x y z r g b) are taken as sRGB, which is what scanners
    and MeshLab write; beyond 1 they count in 255ths. Without vn the faces are flat. Materials: obj_materials.
    Raises InputError with the line that is wrong.
    """
    path = Path(path)
    lines = read_lines(path)
    vertices, colors, uvs, normals, corners = (
        lines.vertices,
        lines.colors,
        lines.uvs * (1, -1) + (0, 1),
        lines.normals,
        lines.corners,
    )
    notes: list[str] = []
    for column, array, what in ((0, vertices, "vertex"), (1, uvs, "texture coordinate"), (2, normals, "normal")):
        if corners[:, column].max() >= len(array):
            raise InputError(
                path,
                f"a face refers to {what} {int(corners[:, column].max()) + 1}, but there are {len(array)}",
                "export it again with all its elements",
            )
        if not np.isfinite(array).all():
            raise InputError(
                path,
                f"{what} {int(np.argwhere(~np.isfinite(array))[0][0]) + 1} is not finite",
                "replace it by finite numbers",
            )
    has_normals = (corners[:, 2] >= 0).all()
    if not has_normals:
        if (corners[:, 2] >= 0).any():
            notes.append("normals are only on some faces and are ignored")
        corners = corners * (1, 1, 0) - (0, 0, 1)
    if (corners[:, 1:] < 0).all():
        places, corner_idx = renumbered(corners[:, 0], len(vertices))
        unique = np.stack([places, *np.full((2, len(places)), -1)], -1)
    else:
        unique, _, corner_idx = unique_rows(corners)
    faces, polygon_idx = triangulate(vertices, corners[:, 0], lines.sizes)
    used = np.unique(lines.groups).tolist()
    materials, material_notes = obj_materials(
        path, list(lines.libraries), [lines.names[i] for i in used], len(colors) > 0
    )
    place = np.zeros(len(lines.names), np.int32)
    place[used] = np.arange(len(used))
    vertex_colors = None
    if len(colors) == len(vertices):
        from gdtool.images.color import linear_from_srgb

        if not np.isfinite(colors).all():
            raise InputError(path, "a vertex color is not finite", "export it without vertex colors")
        encoded = np.clip(colors / 255 if colors.max() > 1 else colors, 0, 1)
        vertex_colors = np.concatenate([linear_from_srgb(encoded), np.ones((len(encoded), 1))], 1)[unique[:, 0]]
    elif len(colors):
        notes.append("colors are only on some vertices and are ignored")
    coordinates = ()
    if (unique[:, 1] >= 0).any():
        coordinates = (np.where(unique[:, 1:2] >= 0, uvs[unique[:, 1]], 0.0),)
    elif any(m.base_color_texture or m.metallic_roughness_texture or m.normal_texture for m in materials):
        notes.append("has textures but no texture coordinates: the textures are left out")
        materials = tuple(
            replace(
                m, base_color_texture=None, metallic_roughness_texture=None, normal_texture=None, emissive_texture=None
            )
            for m in materials
        )
    return Scene(
        vertices=vertices[unique[:, 0]],
        faces=corner_idx.astype(np.int32)[faces],
        materials=materials,
        material_idx=place[lines.groups[polygon_idx]],
        normals=_unit(normals[unique[:, 2]]) if has_normals else None,
        uvs=coordinates,
        colors=vertex_colors,
        name=path.stem,
        notes=(*notes, *material_notes),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
