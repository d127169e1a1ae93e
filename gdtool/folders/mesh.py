"""Read and write `mesh` and `atlas` folders: quads as Wavefront OBJ (schemas/mesh.md, schemas/atlas.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.stage import Output
from gdtool.geometry.meshes import QuadMesh

_UNWRAP = "run gdtool unwrap on the mesh again"


def write_obj(path: Path, mesh: QuadMesh, header: tuple[str, ...] = ()) -> None:
    """Write v, vt (v up, OBJ's convention) and f lines; header lines come first."""
    lines = [*header]
    lines += ["v {:.9g} {:.9g} {:.9g}".format(*p) for p in mesh.vertices]
    if mesh.uv is not None and mesh.face_uvs is not None:
        lines += [f"vt {u:.9g} {1 - v:.9g}" for u, v in mesh.uv]
        for face, corners in zip(mesh.faces.tolist(), mesh.face_uvs.tolist(), strict=True):
            lines.append("f " + " ".join(f"{v + 1}/{t + 1}" for v, t in zip(face, corners, strict=True) if v >= 0))
    else:
        for face in mesh.faces.tolist():
            lines.append("f " + " ".join(str(v + 1) for v in face if v >= 0))
    path.write_text("\n".join(lines) + "\n")


def read_obj(path: Path) -> QuadMesh:
    """Read the v, vt and f lines of an OBJ as quads and triangles.

    Polygons of more corners are cut into quads and a triangle. Raises InputError for a damaged file.
    """
    from gdtool.assets.obj.lines import read_lines

    lines = read_lines(path)
    points, coordinates = lines.vertices, lines.uvs * (1, -1) + (0, 1)
    corner_idx = _cut(lines.sizes)
    quads, corners = (
        np.where(corner_idx >= 0, lines.corners[:, column].astype(np.int32)[corner_idx], -1) for column in (0, 1)
    )
    if quads.max() >= len(points):
        raise InputError(
            path,
            f"a face refers to a vertex out of range (there are {len(points)})",
            "export the mesh again with all its vertices",
        )
    if not np.isfinite(points).all():
        raise InputError(
            path,
            f"vertex {int(np.argwhere(~np.isfinite(points))[0][0]) + 1} is not finite",
            "remove that vertex or move it to a finite place",
        )
    if (corners[quads >= 0] < 0).any():
        return QuadMesh(points, quads)
    if corners.max() >= len(coordinates):
        raise InputError(
            path, f"a face refers to a texture coordinate out of range (there are {len(coordinates)})", _UNWRAP
        )
    if not np.isfinite(coordinates).all():
        raise InputError(path, "has a texture coordinate that is not finite", _UNWRAP)
    return QuadMesh(points, quads, coordinates, corners)


def _cut(sizes: np.ndarray) -> np.ndarray:
    """Cut polygons into quads and triangles, whose fourth corner is -1.

    sizes (p,): the number of corners of each polygon. Returns indices (q, 4) into the corners of all polygons, one
    polygon after the other.
    """
    first = np.cumsum(sizes) - sizes
    pieces = (sizes - 1) // 2
    polygon = np.repeat(np.arange(len(sizes)), pieces)
    step = 2 * (np.arange(len(polygon)) - np.repeat(np.cumsum(pieces) - pieces, pieces))[:, None] + np.array(
        [0, 1, 2, 3]
    )
    step[:, 0] = 0
    return np.where(step < sizes[polygon, None], first[polygon, None] + step, -1)


def write_mesh(out: Output, mesh: QuadMesh) -> None:
    """Write mesh.obj of a mesh or atlas folder; the stage sets out.content."""
    write_obj(out.path("mesh.obj"), mesh)


def read_mesh(folder: Folder) -> QuadMesh:
    """Read the mesh of a mesh or atlas folder. Raises InputError."""
    return read_obj(folder.file("mesh.obj"))
