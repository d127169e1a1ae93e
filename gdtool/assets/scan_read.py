"""PLY and STL into a Scene: binary files of triangles by their arrays, all others through trimesh."""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gdtool.assets.ply import binary_ply, columns
from gdtool.assets.scene import DEFAULT_MATERIAL, Scene
from gdtool.core.errors import InputError
from gdtool.core.reading import bytes_of
from gdtool.geometry.unique_rows import unique_rows

_STL_HEADER = 84
_STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True)
class _Scan:
    """vertices (v, 3) and faces (f, 3); normals (v, 3) as they stand and 8-bit colors (v, 4), or None."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colors: np.ndarray | None = None
    notes: tuple[str, ...] = ()


def read_scan(path: str | Path) -> Scene:
    """Read a .ply or .stl: vertices, faces, and of PLY normals and vertex colours (taken as sRGB).

    The material is DEFAULT_MATERIAL (a dielectric of roughness 0.5), white under vertex colours. STL's vertices, which
    repeat for each face, are welded where they are equal. Raises InputError.
    """
    path = Path(path)
    kind = path.suffix.lower()[1:]
    data = bytes_of(path)
    scan = (_plain_stl if kind == "stl" else _plain_ply)(data) or _by_trimesh(data, kind, path)
    vertices, faces = scan.vertices, scan.faces
    if not len(faces):
        raise InputError(path, "has no faces", "export the model with its faces")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            path,
            f"a face refers to a vertex out of range (there are {len(vertices)})",
            "export it again with all its vertices",
        )
    notes = ["has no material: a dielectric of roughness 0.5", *scan.notes]
    if kind == "stl":
        if not np.isfinite(vertices).all():
            raise InputError(path, "has a vertex that is not finite", "remove that vertex or move it to a finite place")
        vertices, _, place = unique_rows(vertices)
        return Scene(vertices.astype(np.float64), place.astype(np.int32)[faces], name=path.stem, notes=tuple(notes))
    material, colors, normals = DEFAULT_MATERIAL, None, None
    if scan.colors is not None:
        from gdtool.images.color import linear_from_srgb, unit_range

        stored = unit_range(scan.colors).astype(np.float64)
        colors = np.concatenate([linear_from_srgb(stored[:, :3]), stored[:, 3:]], 1)
        material = replace(material, base_color=(1.0, 1.0, 1.0, 1.0))
    if scan.normals is not None:
        length = np.linalg.norm(scan.normals, axis=1, keepdims=True)
        if len(scan.normals) == len(vertices) and np.isfinite(scan.normals).all() and (length > 1e-6).all():
            normals = scan.normals / length
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


def _plain_stl(data: bytes) -> _Scan | None:
    """Return a binary STL; None for what is not as long as that says it is."""
    if (
        len(data) < _STL_HEADER
        or (len(data) - _STL_HEADER) != int.from_bytes(data[80:84], "little") * _STL_FACE.itemsize
    ):
        return None
    corners = np.frombuffer(data, _STL_FACE, offset=_STL_HEADER)["corners"].reshape(-1, 3)
    return _Scan(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))


def _plain_ply(data: bytes) -> _Scan | None:
    """Return a binary PLY of triangles whose vertices have places, normals and 8-bit colours, if not more; None for
    others."""
    try:
        records, faces = binary_ply(data)
    except ValueError:
        return None
    kinds = {name: records.dtype[name] for name in records.dtype.names}
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
    return _Scan(
        columns(records, "x y z"),
        faces,
        columns(records, "nx ny nz") if {"nx", "ny", "nz"} <= set(kinds) else None,
        colors,
    )


def _by_trimesh(data: bytes, kind: str, path: Path) -> _Scan:
    import trimesh

    try:
        mesh = trimesh.load(io.BytesIO(data), file_type=kind, process=False, force="mesh")
    except Exception as error:  # the parsers raise whatever the malformed bytes lead to
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
    return _Scan(
        vertices,
        faces,
        normals,
        np.asarray(mesh.visual.vertex_colors) if mesh.visual.kind == "vertex" else None,
        ("colors of faces are ignored",) if mesh.visual.kind == "face" else (),
    )
