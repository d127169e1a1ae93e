"""Check and repair triangle meshes before native libraries read them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.native import imported
from gdtool.geometry.meshes import Mesh, TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.topology import (
    compact,
    components,
    corner_fans,
    edges_of,
    has_even_edge_counts,
    has_one_fan_per_vertex,
    has_repeated_corner,
    is_watertight,
    twins_of,
)
from gdtool.geometry.unique_rows import index_of_first_equal, indices_of_distinct

WELD_SHARE = 1e-7  # of the longest side, within which vertices are welded: below any detail, above rounding
NO_AREA = "give a mesh with at least one triangle that has an area"
_MAX_SMALL_SHARE = 0.02  # of the faces: pieces beyond the expected number that are more than this are kept


class CleanMesh(NamedTuple):
    """Hold a repaired mesh.

    repairs: how many of each kind were made, by name; is_closed: whether the mesh is watertight.
    """

    mesh: TriMesh
    repairs: dict[str, int | bool]
    is_closed: bool


def check(mesh: TriMesh, subject: object = "mesh") -> None:
    """Raise InputError where there are no faces, an index is out of range or a coordinate is not finite.

    subject: what the error names.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces):
        raise InputError(subject, "has no faces", NO_AREA)
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            subject,
            f"a face refers to vertex {int(faces.max() if faces.min() >= 0 else faces.min())} of {len(vertices)}",
            "remove that face, or export the mesh again",
        )
    bad = ~np.isfinite(vertices).all(1)
    if bad.any():
        raise InputError(
            subject,
            f"vertex {int(np.argmax(bad))} is not finite ({int(bad.sum())} such)",
            "remove such vertices with their faces",
        )


def clean(mesh: TriMesh, subject: object = "mesh") -> CleanMesh:
    """Make a mesh manifold and consistently oriented, without a change of its shape.

    The result has float64 vertices and int64 faces. A closed, manifold mesh passes unchanged except for unused
    vertices and, where it is inside out, the direction of its faces. Raises InputError as check() does, and where no
    face has an area; subject: what the error names.
    """
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    check(TriMesh(vertices, faces), subject)
    repairs: dict[str, int | bool] = {}
    mesh = compact(TriMesh(vertices, faces))
    vertices, faces = mesh.vertices, mesh.faces
    rows = np.ascontiguousarray(vertices.T)  # a row for each coordinate: several times faster to reduce
    extent = float((rows.max(1) - rows.min(1)).max())
    if not extent > 0:
        raise InputError(subject, "all its faces lie in one point", NO_AREA)
    repeated = has_repeated_corner(faces)
    if repeated.any():
        _note(repairs, "degenerate_faces", repeated.sum())
        faces = faces[~repeated]
    with ThreadPoolExecutor(1) as pool:
        measured = pool.submit(face_normals, TriMesh(vertices / extent, faces))
        one_fan = _closed_with_one_fan(faces)
        normals, areas = measured.result()
    if not areas.any():
        raise InputError(subject, "no face has an area", NO_AREA)
    if one_fan is None:
        # A closed mesh keeps its indices: welding could join sheets that only touch.
        welded = _weld(TriMesh(vertices, faces), extent * WELD_SHARE)
        _note(repairs, "welded_vertices", _used_count(faces, len(vertices)) - _used_count(welded, len(vertices)))
        kept_idx = np.flatnonzero(~has_repeated_corner(welded))
        _note(repairs, "degenerate_faces", len(welded) - len(kept_idx) + repairs.get("degenerate_faces", 0))
        faces, normals, areas = (array.take(kept_idx, 0) for array in (welded, normals, areas))
        one_fan = _closed_with_one_fan(faces, allow_doubled=False)
    if not one_fan:
        return _repair_structure(TriMesh(vertices, faces), extent, repairs, subject)
    if repairs:
        mesh = compact(TriMesh(vertices, faces))
        vertices, faces = mesh.vertices, mesh.faces
    if _volume(TriMesh(vertices / extent, faces), normals, areas) < 0:
        repairs["turned_inside_out"] = True
        faces = faces[:, ::-1].copy()
    return CleanMesh(TriMesh(vertices, faces), repairs, True)


def _repair_structure(mesh: TriMesh, extent: float, repairs: dict[str, int | bool], subject: object) -> CleanMesh:
    """Finish clean() for a welded mesh that is open or not manifold; extent: its longest side."""
    vertices, faces = mesh.vertices, mesh.faces
    first = indices_of_distinct(np.sort(faces, 1))
    _note(repairs, "duplicate_faces", len(faces) - len(first))
    faces = faces[first]
    if not len(faces):
        raise InputError(subject, "no face has an area", NO_AREA)
    flat = face_normals(TriMesh(vertices / extent, faces))[1] == 0
    if flat.any() and not is_watertight(faces):
        # In a closed mesh a flat face is a seam that keeps it closed.
        _note(repairs, "zero_area_faces", flat.sum())
        faces = faces[~flat]
    mesh = compact(TriMesh(vertices, faces))
    edges = edges_of(mesh.faces)
    if (edges.count > 2).any() or edges.turned.any():
        _note(repairs, "nonmanifold_edges", (edges.count > 2).sum())
        _note(repairs, "turned_edges", edges.turned.sum())
        mesh = _orient(_split_nonmanifold(mesh))
        edges = edges_of(mesh.faces)
    fans, fan_count = corner_fans(mesh.faces, edges=edges)
    is_closed = bool((edges.count == 2).all() and not edges.turned.any())  # fans that part keep their edges
    if (fan_count > 1).any():
        _note(repairs, "nonmanifold_vertices", (fan_count > 1).sum())
        mesh = one_vertex_per_fan(mesh, fans)
    if is_closed:
        unit = TriMesh(mesh.vertices / extent, mesh.faces)
        if _volume(unit, *face_normals(unit)) < 0:
            repairs["turned_inside_out"] = True
            mesh = TriMesh(mesh.vertices, mesh.faces[:, ::-1].copy())
    return CleanMesh(mesh, repairs, is_closed)


def _note(repairs: dict[str, int | bool], name: str, count: int) -> None:
    """Record the number of repairs of one kind in `repairs`, where there were any."""
    if count:
        repairs[name] = int(count)


def _used_count(faces: np.ndarray, count: int) -> int:
    """Return how many of `count` vertices the faces use."""
    marked = np.zeros(count, bool)
    marked[faces] = True
    return int(marked.sum())


def _closed_with_one_fan(faces: np.ndarray, allow_doubled: bool = True) -> bool | None:
    """Tell whether the faces around each vertex of a closed mesh form one fan; None for an open mesh.

    allow_doubled: with False the answer is also False where two triangles have the same corners.
    """
    if not has_even_edge_counts(faces) or (twins := twins_of(faces)) is None:
        return None
    return (allow_doubled or not _has_doubled_triangle(twins)) and has_one_fan_per_vertex(faces, twins)


def _has_doubled_triangle(twins: np.ndarray) -> bool:
    """Tell whether two triangles have the same corners; twins (3 f,) as from twins_of()."""
    beside = twins.reshape(-1, 3) // 3
    return bool(((beside[:, 0] == beside[:, 1]) & (beside[:, 1] == beside[:, 2])).any())


def drop_small_pieces(mesh: Mesh, pieces: int) -> Mesh:
    """Drop the smallest pieces beyond the number there should be, where they are 2 % of the faces or less."""
    count, piece = components(mesh.faces)
    if count <= pieces:
        return mesh
    size = np.bincount(piece)
    keep = np.argsort(-size, kind="stable")[:pieces]
    if size[keep].sum() < (1 - _MAX_SMALL_SHARE) * len(mesh.faces):
        return mesh
    return compact(replace(mesh, faces=mesh.faces[np.isin(piece, keep)]))


def one_vertex_per_fan(mesh: Mesh, fans: np.ndarray | None = None) -> Mesh:
    """Double vertices where several fans of faces meet, so that each fan has its own; drop unused vertices.

    fans (f, c): the fan of each face corner, as from corner_fans().
    """
    faces = mesh.faces
    fans = corner_fans(faces)[0] if fans is None else fans
    used = faces >= 0
    _, first, new = np.unique(fans[used], return_index=True, return_inverse=True)
    out = np.full(faces.shape, -1, np.int64)
    out[used] = new.ravel()
    return replace(mesh, vertices=mesh.vertices[faces[used][first]], faces=out)


def _volume(mesh: TriMesh, normals: np.ndarray, areas: np.ndarray) -> float:
    """Return the signed volume of a closed mesh from the normals (f, 3) and areas (f,) of its faces."""
    corners = (mesh.vertices - mesh.vertices[mesh.faces[0, 0]]).take(mesh.faces[:, 0], 0)
    return float(np.einsum("ij,ij,i", corners, normals, areas, optimize=False) / 3)


def _weld(mesh: TriMesh, distance: float) -> np.ndarray:
    """Return the faces with one index for vertices that round to the same point of a grid of this step."""
    grid = np.rint((mesh.vertices - mesh.vertices.min(0)) / distance)
    return index_of_first_equal(grid).take(mesh.faces)


def _split_nonmanifold(mesh: TriMesh) -> TriMesh:
    """Cut the mesh along edges of more than two faces, after turning faces where that makes neighbours consistent."""
    igl = imported("igl")
    faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(mesh.faces))[0])
    vertices, faces, _ = igl.split_nonmanifold(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(faces))
    return TriMesh(np.asarray(vertices), np.asarray(faces))


def _orient(mesh: TriMesh) -> TriMesh:
    """Turn each closed piece so that its faces look outward; open pieces keep the direction of most of their faces."""
    igl = imported("igl")
    faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(mesh.faces))[0]).copy()
    count, piece = components(faces)
    a, b, c = (mesh.vertices[faces[:, i]] for i in range(3))
    centre = (
        np.stack([np.bincount(piece, a[:, i], count) for i in range(3)], -1)
        / np.bincount(piece, minlength=count)[:, None]
    )
    volume = np.bincount(piece, np.einsum("ij,ij->i", a - centre[piece], np.cross(b - a, c - a)), count)
    inward = (volume < 0)[piece]
    faces[inward] = faces[inward][:, ::-1]
    return TriMesh(mesh.vertices, faces)
