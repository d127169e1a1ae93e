"""Wavefront OBJ with its MTL into a Scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gdtool.assets.obj_materials import obj_materials
from gdtool.assets.polygons import triangulate
from gdtool.assets.scene import Scene
from gdtool.core.errors import InputError, from_os_error


def read_obj(path: str | Path) -> Scene:
    """Read v (with colours), vt, vn, f, usemtl and mtllib; negative indices count back, polygons are triangulated.

    vt is flipped to the project's v downward. Vertex colours (v x y z r g b) are taken as sRGB, which is what scanners
    and MeshLab write; beyond 1 they count in 255ths. Without vn the faces are flat. Materials: obj_materials.
    Raises InputError with the line that is wrong.
    """
    path = Path(path)
    vertices: list[tuple[float, ...]] = []
    colors: list[tuple[float, ...]] = []
    uvs: list[tuple[float, float]] = []
    normals: list[tuple[float, ...]] = []
    corners: list[tuple[int, int, int]] = []
    sizes: list[int] = []
    groups: list[int] = []  # material of each polygon, into names
    names: dict[str, int] = {}
    libraries: list[str] = []
    current = names.setdefault("", 0)
    try:
        file = open(path, encoding="utf-8", errors="replace")
    except FileNotFoundError:
        raise InputError(path, "does not exist") from None
    except OSError as error:
        raise from_os_error(error, path) from None
    with file:
        carried = ""
        for number, line in enumerate(file, 1):
            if line.endswith("\\\n"):
                carried += line[:-2] + " "
                continue
            words, carried = (carried + line).split(), ""
            if not words:
                continue
            key = words[0]
            try:
                if key == "v":
                    vertices.append((float(words[1]), float(words[2]), float(words[3])))
                    if len(words) >= 7:
                        colors.append((float(words[4]), float(words[5]), float(words[6])))
                elif key == "vt":
                    uvs.append((float(words[1]), 1 - float(words[2]) if len(words) > 2 else 0.0))
                elif key == "vn":
                    normals.append((float(words[1]), float(words[2]), float(words[3])))
                elif key == "f":
                    counts = len(vertices), len(uvs), len(normals)
                    if len(words) < 4:
                        raise ValueError("a face has fewer than three corners")
                    corners += [_corner(word, counts) for word in words[1:]]
                    sizes.append(len(words) - 1)
                    groups.append(current)
                elif key == "usemtl":
                    current = names.setdefault(" ".join(words[1:]), len(names))
                elif key == "mtllib":
                    libraries.append(line.split(None, 1)[1].strip())
            except (ValueError, IndexError, OverflowError) as error:
                raise InputError(path, f"line {number} is not what OBJ says ({error})") from None
    if not sizes:
        raise InputError(path, "has no faces")
    return _scene(path, np.array(vertices, np.float64).reshape(-1, 3), colors, np.array(uvs, np.float64).reshape(-1, 2),
                  np.array(normals, np.float64).reshape(-1, 3), np.array(corners, np.int64), np.array(sizes), np.array(groups), names, libraries)


def _corner(word: str, counts: tuple[int, int, int]) -> tuple[int, int, int]:
    """v/vt/vn as indices from 0, -1 where absent."""
    out = [-1, -1, -1]
    for i, part in enumerate(word.split("/")):
        if part:
            index = int(part)
            out[i] = index - 1 if index > 0 else counts[i] + index
            if index == 0 or out[i] < 0:
                raise ValueError(f"index {index} is out of range")
    if out[0] < 0:
        raise ValueError("a corner has no vertex")
    return out[0], out[1], out[2]


def _scene(path: Path, vertices: np.ndarray, colors: list, uvs: np.ndarray, normals: np.ndarray, corners: np.ndarray, sizes: np.ndarray,
           groups: np.ndarray, names: dict[str, int], libraries: list[str]) -> Scene:
    notes: list[str] = []
    for column, array, what in ((0, vertices, "vertex"), (1, uvs, "texture coordinate"), (2, normals, "normal")):
        if corners[:, column].max() >= len(array):
            raise InputError(path, f"a face refers to {what} {int(corners[:, column].max()) + 1}, but there are {len(array)}")
        if not np.isfinite(array).all():
            raise InputError(path, f"{what} {int(np.argwhere(~np.isfinite(array))[0][0]) + 1} is not finite")
    has_normals = (corners[:, 2] >= 0).all()
    if not has_normals:
        if (corners[:, 2] >= 0).any():
            notes.append("normals are only on some faces and are ignored")
        corners = corners * (1, 1, 0) - (0, 0, 1)
    unique, corner_idx = np.unique(corners, axis=0, return_inverse=True)
    faces, polygon_idx = triangulate(vertices, corners[:, 0], sizes)
    used = sorted(set(groups.tolist()))
    materials, material_notes = obj_materials(path, libraries, [name for name, i in names.items() if i in used], bool(colors))
    place = np.zeros(len(names), np.int32)
    place[used] = np.arange(len(used))
    vertex_colors = None
    if len(colors) == len(vertices):
        from gdtool.images.color import linear_from_srgb

        encoded = np.array(colors, np.float64)
        if not np.isfinite(encoded).all():
            raise InputError(path, "a vertex color is not finite")
        encoded = np.clip(encoded / 255 if encoded.max() > 1 else encoded, 0, 1)
        vertex_colors = np.concatenate([linear_from_srgb(encoded), np.ones((len(encoded), 1))], 1)[unique[:, 0]]
    elif colors:
        notes.append("colors are only on some vertices and are ignored")
    coordinates = ()
    if (unique[:, 1] >= 0).any():
        coordinates = (np.where(unique[:, 1:2] >= 0, uvs[unique[:, 1]], 0.0),)
    elif any(m.base_color_texture or m.metallic_roughness_texture or m.normal_texture for m in materials):
        notes.append("has textures but no texture coordinates: the textures are left out")
        materials = tuple(replace(m, base_color_texture=None, metallic_roughness_texture=None, normal_texture=None, emissive_texture=None)
                          for m in materials)
    return Scene(
        vertices=vertices[unique[:, 0]],
        faces=corner_idx.reshape(-1)[faces].astype(np.int32),
        materials=materials,
        material_idx=place[groups[polygon_idx]],
        normals=_unit(normals[unique[:, 2]]) if has_normals else None,
        uvs=coordinates,
        colors=vertex_colors,
        name=path.stem,
        notes=(*notes, *material_notes),
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
