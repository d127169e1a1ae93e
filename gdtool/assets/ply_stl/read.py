"""Read PLY and STL files into a Scene: binary files of triangles directly, all others with trimesh."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gdtool.assets.ply_stl.binary_ply import columns, read_binary_ply
from gdtool.assets.scene import DEFAULT_MATERIAL, Scene
from gdtool.core.errors import InputError
from gdtool.core.reading import bytes_of
from gdtool.geometry.unique_rows import unique_rows

_STL_HEADER = 84
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True)
class _RawMesh:
    """Hold a file's vertices (v, 3), faces (f, 3), normals (v, 3) of any length, and 8-bit colours (v, 4)."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def read_ply_or_stl(path: str | Path) -> Scene:
    """Read a .ply or .stl: vertices, faces, and from PLY the normals and vertex colours, which are taken as sRGB.

    The material is DEFAULT_MATERIAL, white where vertices have colours. STL repeats the vertices of each face; equal
    ones are welded. Raises InputError.
    """
    path = Path(path)
    kind = path.suffix.lower()[1:]
    data = bytes_of(path)
    raw = (read_plain_stl if kind == "stl" else read_plain_ply)(data) or read_with_trimesh(data, kind, path)
    vertices, faces = raw.vertices, raw.faces
    if not len(faces):
        raise InputError(path, "has no faces", "export the model with its faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            path,
            f"a face refers to a vertex out of range (there are {len(vertices)})",
            "export it again with all its vertices",
        )
    notes = ["has no material: a dielectric of roughness 0.5", *raw.notes]
    if kind == "stl":
        if not np.isfinite(vertices).all():
            raise InputError(path, "has a vertex that is not finite", "remove that vertex or move it to a finite place")
        vertices, _, welded_idx = unique_rows(vertices)
        faces = welded_idx.astype(np.int32)[faces]
        return Scene(vertices.astype(np.float64), faces, name=path.stem, notes=tuple(notes))
    material, colors, normals = DEFAULT_MATERIAL, None, None
    if raw.colors is not None:
        from gdtool.images.color import linear_from_srgb, unit_range

        stored = unit_range(raw.colors).astype(np.float64)
        colors = np.concatenate([linear_from_srgb(stored[:, :3]), stored[:, 3:]], 1)
        material = replace(material, base_color=(1.0, 1.0, 1.0, 1.0))
    if raw.normals is not None:
        length = np.linalg.norm(raw.normals, axis=1, keepdims=True)
        if len(raw.normals) == len(vertices) and np.isfinite(raw.normals).all() and (length > 1e-6).all():
            normals = raw.normals / length
        else:
            notes.append("normals without a direction are ignored")
    return Scene(
        vertices.astype(np.float64),
        faces.astype(np.int32),
        (material,),
        normals=normals,
        colors=colors,
        name=path.stem,
        notes=tuple(notes),
    )


def read_plain_stl(data: bytes) -> _RawMesh | None:
    """Read a binary STL without welding; None where the length does not match the count of faces, as in a text file."""
    if (
        len(data) < _STL_HEADER
        or (len(data) - _STL_HEADER) != int.from_bytes(data[80:84], "little") * _STL_FACE.itemsize
    ):
        return None
    corners = np.frombuffer(data, _STL_FACE, offset=_STL_HEADER)["corners"].reshape(-1, 3)
    return _RawMesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))


def read_plain_ply(data: bytes) -> _RawMesh | None:
    """Read a binary PLY of triangles; None for other layouts.

    Vertices may have normals and 8-bit colours besides their position, but no texture coordinates.
    """
    try:
        records, faces = read_binary_ply(data)
    except ValueError:
        return None
    kinds = {name: records.dtype[name] for name in records.dtype.names or ()}
    colored = [name for name in ("red", "green", "blue", "alpha") if name in kinds]
    if not {"x", "y", "z"} <= set(kinds) or set(kinds) & {"u", "v", "s", "t", "texture_u", "texture_v"}:
        return None
    if any(kinds[name] != np.uint8 for name in colored) or colored and len(colored) < 3:
        return None
    colors = None
    if colored:
        colors = np.full((len(records), 4), 255, np.uint8)
        for i, name in enumerate(colored):
            colors[:, i] = records[name]
    return _RawMesh(
        columns(records, "x y z"),
        faces,
        columns(records, "nx ny nz") if {"nx", "ny", "nz"} <= set(kinds) else None,
        colors,
    )


def read_with_trimesh(data: bytes, kind: str, path: Path) -> _RawMesh:
    """Read any PLY or STL with trimesh. Raises InputError for what it cannot read."""
    import trimesh

    try:
        mesh: Any = trimesh.load(io.BytesIO(data), file_type=kind, process=False, force="mesh")
    except Exception as error:  # malformed bytes make the parsers raise anything
        raise InputError(
            path,
            f"is not a {kind.upper()} file that can be read ({type(error).__name__}: {str(error)[:60]!r})",
            f"export it again as binary {kind.upper()}",
        ) from None
    if not hasattr(mesh, "faces"):
        raise InputError(path, "has no faces", "export the model with its faces")
    vertices, faces = (
        np.asarray(mesh.vertices, np.float64).reshape(-1, 3),
        np.asarray(mesh.faces, np.int64).reshape(-1, 3),
    )
    stored = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
    names = getattr(getattr(stored, "dtype", None), "names", None) or (stored if isinstance(stored, dict) else ())
    normals = None
    if all(key in names for key in ("nx", "ny", "nz")):
        normals = np.stack([np.asarray(stored[key], np.float64).reshape(-1) for key in ("nx", "ny", "nz")], 1)
    return _RawMesh(
        vertices,
        faces,
        normals,
        np.asarray(mesh.visual.vertex_colors) if mesh.visual.kind == "vertex" else None,
        ("colors of faces are ignored",) if mesh.visual.kind == "face" else (),
    )
