"""Read a Wavefront OBJ file, with its MTL materials, into a Scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.obj.lines import read_lines
from gdtool.assets.obj.materials import obj_materials
from gdtool.assets.obj.polygons import triangulate
from gdtool.assets.scene import Scene
from gdtool.core.errors import InputError
from gdtool.geometry.topology import renumbered
from gdtool.geometry.unique_rows import unique_rows


def read_obj(path: str | Path) -> Scene:
    """Read v (with colours), vt, vn, f, usemtl and mtllib lines; polygons are cut into triangles.

    Texture coordinates are flipped, because OBJ counts v upward and a Scene downward. Vertex colours (v x y z r g b)
    are taken as sRGB, which is what scanners and MeshLab write; where one exceeds 1, all are divided by 255. Without
    vn lines the faces are flat. Materials: see `obj_materials`.

    Raises InputError with the line that is wrong, ResourceError.
    """
    path = Path(path)
    lines = read_lines(path)
    vertices, colors, normals, corners = lines.vertices, lines.colors, lines.normals, lines.corners
    uvs = lines.uvs * (1, -1) + (0, 1)
    _check_elements(path, corners, {"vertex": vertices, "texture coordinate": uvs, "normal": normals})
    notes: list[str] = []
    has_normals = (corners[:, 2] >= 0).all()
    if not has_normals:
        if (corners[:, 2] >= 0).any():
            notes.append("normals are only on some faces and are ignored")
        corners = corners * (1, 1, 0) - (0, 0, 1)
    # A vertex of the scene for each combination of position, texture coordinate and normal (u, 3).
    if (corners[:, 1:] < 0).all():
        positions, corner_idx = renumbered(corners[:, 0], len(vertices))
        unique = np.stack([positions, *np.full((2, len(positions)), -1)], -1)
    else:
        unique, _, corner_idx = unique_rows(corners)
    faces, polygon_idx = triangulate(vertices, corners[:, 0], lines.sizes)
    used = np.unique(lines.groups).tolist()
    materials, material_notes = obj_materials(
        path, list(lines.libraries), [lines.names[i] for i in used], len(colors) > 0
    )
    material_of_group = np.zeros(len(lines.names), np.int32)
    material_of_group[used] = np.arange(len(used))
    vertex_colors = None
    if len(colors) == len(vertices):
        vertex_colors = _linear_colors(path, colors)[unique[:, 0]]
    elif len(colors):
        notes.append("colors are only on some vertices and are ignored")
    uv_sets: tuple[np.ndarray, ...] = ()
    if (unique[:, 1] >= 0).any():
        uv_sets = (np.where(unique[:, 1:2] >= 0, uvs[unique[:, 1]], 0.0),)
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
        material_idx=material_of_group[lines.groups[polygon_idx]],
        normals=_unit(normals[unique[:, 2]]) if has_normals else None,
        uvs=uv_sets,
        colors=vertex_colors,
        name=path.stem,
        notes=(*notes, *material_notes),
    )


def _check_elements(path: Path, corners: np.ndarray, elements: dict[str, np.ndarray]) -> None:
    """Raise InputError where a corner's index is out of range or a number is not finite; elements by column."""
    for column, (name, array) in enumerate(elements.items()):
        if corners[:, column].max() >= len(array):
            raise InputError(
                path,
                f"a face refers to {name} {int(corners[:, column].max()) + 1}, but there are {len(array)}",
                "export it again with all its elements",
            )
        if not np.isfinite(array).all():
            raise InputError(
                path,
                f"{name} {int(np.argwhere(~np.isfinite(array))[0][0]) + 1} is not finite",
                "replace it by finite numbers",
            )


def _linear_colors(path: Path, colors: np.ndarray) -> np.ndarray:
    """Decode sRGB vertex colours (v, 3), in [0, 1] or [0, 255], to linear ones with alpha 1 (v, 4)."""
    from gdtool.images.color import linear_from_srgb

    if not np.isfinite(colors).all():
        raise InputError(path, "a vertex color is not finite", "export it without vertex colors")
    encoded = np.clip(colors / 255 if colors.max() > 1 else colors, 0, 1)
    return np.concatenate([linear_from_srgb(encoded), np.ones((len(encoded), 1))], 1)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (n, 3) to length 1; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
