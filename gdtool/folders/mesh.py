"""Reading and writing `mesh` and `atlas` folders: quads as Wavefront OBJ (schemas/mesh.md, schemas/atlas.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.stage import Output


@dataclass(frozen=True)
class QuadMesh:
    """Quads, and triangles where faces[:, 3] is -1; counter-clockwise seen from outside, normalised frame.

    vertices (v, 3) float64, faces (f, 4) int32. uv (c, 2) float64 in [0, 1], (0, 0) at the image's top left, and
    face_uvs (f, 4) int32 into uv (-1 with the triangle's fourth corner); both None without texture coordinates.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None = None
    face_uvs: np.ndarray | None = None

    @property
    def is_quad(self) -> np.ndarray:
        """(f,) bool."""
        return self.faces[:, 3] >= 0


def triangulated(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (t, 3) of quads (f, 4), each cut along corners 0 and 2, and the face (t,) each comes from."""
    quads = np.flatnonzero(faces[:, 3] >= 0)
    triangles = np.concatenate([faces[:, :3], faces[quads][:, [0, 2, 3]]])
    face_idx = np.concatenate([np.arange(len(faces)), quads])
    order = np.argsort(face_idx, kind="stable")
    return triangles[order].astype(np.int32), face_idx[order].astype(np.int32)


def write_obj(path: Path, mesh: QuadMesh, header: tuple[str, ...] = ()) -> None:
    """Write v, vt (v up, OBJ's convention) and f lines; header lines come first."""
    lines = [*header]
    lines += ["v %.9g %.9g %.9g" % tuple(p) for p in mesh.vertices]
    if mesh.uv is not None:
        lines += ["vt %.9g %.9g" % (u, 1 - v) for u, v in mesh.uv]
        for face, corners in zip(mesh.faces.tolist(), mesh.face_uvs.tolist(), strict=True):
            lines.append("f " + " ".join(f"{v + 1}/{t + 1}" for v, t in zip(face, corners, strict=True) if v >= 0))
    else:
        for face in mesh.faces.tolist():
            lines.append("f " + " ".join(str(v + 1) for v in face if v >= 0))
    path.write_text("\n".join(lines) + "\n")


def read_obj(path: Path) -> QuadMesh:
    """Read the v, vt and f lines of an OBJ of triangles and quads; other lines are passed over.

    Polygons of more corners are cut into quads and a triangle. Raises InputError for what is not so.
    """
    vertices, uvs, faces, face_uvs = [], [], [], []
    with open(path, encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            words = line.split()
            if not words:
                continue
            try:
                if words[0] == "v":
                    vertices.append((float(words[1]), float(words[2]), float(words[3])))
                elif words[0] == "vt":
                    uvs.append((float(words[1]), 1 - float(words[2])))
                elif words[0] == "f":
                    corners = []
                    for word in words[1:]:
                        parts = word.split("/")
                        v = int(parts[0])
                        t = int(parts[1]) if len(parts) > 1 and parts[1] else 0
                        corners.append((v - 1 if v > 0 else len(vertices) + v, t - 1 if t > 0 else len(uvs) + t if t else -1))
                    if len(corners) < 3:
                        raise ValueError("a face has fewer than three corners")
                    for i in range(1, len(corners) - 1, 2):
                        ring = [corners[0], *corners[i:i + 3]]
                        ring += [(-1, -1)] * (4 - len(ring))
                        faces.append([v for v, _ in ring])
                        face_uvs.append([t for _, t in ring])
            except (ValueError, IndexError) as error:
                raise InputError(path, f"line {number} is not what OBJ says ({error})") from None
    if not faces:
        raise InputError(path, "has no faces")
    points, quads = np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int32)
    if quads.max() >= len(points) or quads[:, :3].min() < 0:
        raise InputError(path, f"a face refers to a vertex out of range (there are {len(points)})")
    if not np.isfinite(points).all():
        raise InputError(path, f"vertex {int(np.argwhere(~np.isfinite(points))[0][0]) + 1} is not finite")
    corners, coordinates = np.array(face_uvs, np.int32), np.array(uvs, np.float64).reshape(-1, 2)
    if (corners[quads >= 0] < 0).any():
        return QuadMesh(points, quads)
    if corners.max() >= len(coordinates):
        raise InputError(path, f"a face refers to a texture coordinate out of range (there are {len(coordinates)})")
    if not np.isfinite(coordinates).all():
        raise InputError(path, "has a texture coordinate that is not finite")
    return QuadMesh(points, quads, coordinates, corners)


def write_mesh(out: Output, mesh: QuadMesh) -> None:
    """Write mesh.obj of a mesh or atlas folder; the stage sets out.content."""
    write_obj(out.path("mesh.obj"), mesh)


def read_mesh(folder: Folder) -> QuadMesh:
    """The mesh of a mesh or atlas folder. Raises InputError."""
    return read_obj(folder.file("mesh.obj"))
