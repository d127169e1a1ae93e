"""Checks and repairs of triangle meshes before anything native sees them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.native import imported
from gdtool.geometry.normals import face_normals
from gdtool.geometry.rows import first_equal, first_rows
from gdtool.geometry.topology import (
    compact,
    components,
    corner_fans,
    edges_of,
    even,
    is_watertight,
    one_fan_each,
    repeats,
    twins_of,
)

# Welding joins vertices closer than this share of the longest side: far below any detail, far above rounding.
WELD_SHARE = 1e-7
NO_AREA = "give a mesh with at least one triangle that has an area"


def check(vertices: np.ndarray, faces: np.ndarray, subject: object = "mesh") -> None:
    """Raise InputError when there is nothing to work on, an index is out of range or a coordinate is not finite."""
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


def clean(
    vertices: np.ndarray, faces: np.ndarray, subject: object = "mesh"
) -> tuple[np.ndarray, np.ndarray, dict[str, int | bool], bool]:
    """Return a manifold, consistently oriented mesh of the same shape, what had to be done to it, and whether it is
    watertight.

    vertices (v, 3) float, faces (f, 3). A closed, manifold mesh passes unchanged except for unused vertices. Raises
    InputError (see check), also when all faces have no area.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    check(vertices, faces, subject)
    report: dict[str, int | bool] = {}

    def note(name: str, count: int) -> None:
        if count:
            report[name] = int(count)

    vertices, faces = compact(vertices, faces)
    rows = np.ascontiguousarray(vertices.T)
    extent = float((rows.max(1) - rows.min(1)).max())
    if not extent > 0:
        raise InputError(subject, "all its faces lie in one point", NO_AREA)
    repeated = repeats(faces)
    if repeated.any():
        note("degenerate_faces", repeated.sum())
        faces = faces[~repeated]
    with ThreadPoolExecutor(1) as pool:
        measured = pool.submit(face_normals, vertices / extent, faces)
        fans = _one_fan(faces)
        sides = measured.result()
    if not sides[1].any():
        raise InputError(subject, "no face has an area", NO_AREA)
    if fans is None:
        # A closed mesh is left as its indices say: welding could join sheets that only touch.
        welded = _weld(vertices, faces, extent * WELD_SHARE)
        note("welded_vertices", _used(faces, len(vertices)) - _used(welded, len(vertices)))
        kept = np.flatnonzero(~repeats(welded))
        note("degenerate_faces", len(welded) - len(kept) + report.get("degenerate_faces", 0))
        faces, sides = welded.take(kept, 0), tuple(side.take(kept, 0) for side in sides)
        fans = _one_fan(faces, doubled=False)
    if fans:
        if report:
            vertices, faces = compact(vertices, faces)
        if _volume(vertices / extent, faces, *sides) < 0:
            report["turned_inside_out"] = True
            faces = faces[:, ::-1].copy()
        return vertices, faces, report, True
    first = first_rows(np.sort(faces, 1))
    note("duplicate_faces", len(faces) - len(first))
    faces = faces[first]
    if not len(faces):
        raise InputError(subject, "no face has an area", NO_AREA)
    flat = face_normals(vertices / extent, faces)[1] == 0
    if flat.any() and not is_watertight(faces):
        # In a closed mesh a flat face is a seam that keeps it closed.
        note("zero_area_faces", flat.sum())
        faces = faces[~flat]
    vertices, faces = compact(vertices, faces)
    edges = edges_of(faces)
    if (edges.count > 2).any() or edges.turned.any():
        note("nonmanifold_edges", (edges.count > 2).sum())
        note("turned_edges", edges.turned.sum())
        vertices, faces = _split(vertices, faces)
        faces = _oriented(vertices, faces)
        edges = edges_of(faces)
    fans, number = corner_fans(faces, edges=edges)
    closed = bool((edges.count == 2).all() and not edges.turned.any())  # fans that part keep their edges
    if (number > 1).any():
        note("nonmanifold_vertices", (number > 1).sum())
        vertices, faces = one_vertex_per_fan(vertices, faces, fans)
    if closed and _volume(vertices / extent, faces, *face_normals(vertices / extent, faces)) < 0:
        report["turned_inside_out"] = True
        faces = faces[:, ::-1].copy()
    return vertices, faces, report, closed


def _used(faces: np.ndarray, count: int) -> int:
    """How many of `count` vertices faces use."""
    marked = np.zeros(count, bool)
    marked[faces] = True
    return int(marked.sum())


def _one_fan(faces: np.ndarray, doubled: bool = True) -> bool | None:
    """Whether the faces around each vertex of a closed mesh form one fan; None of an open one. doubled: also where two
    have the same corners."""
    if not even(faces) or (twins := twins_of(faces)) is None:
        return None
    return (doubled or not _twice(twins)) and one_fan_each(faces, twins)


def _twice(twins: np.ndarray) -> bool:
    """Whether there are two triangles with the same corners among those that have twins (3 f,)."""
    beside = twins.reshape(-1, 3) // 3
    return bool(((beside[:, 0] == beside[:, 1]) & (beside[:, 1] == beside[:, 2])).any())


def without_crumbs(vertices: np.ndarray, faces: np.ndarray, pieces: int) -> tuple[np.ndarray, np.ndarray]:
    """Without the smallest pieces beyond the number there should be, if they are crumbs: 2 % of the faces or less."""
    count, piece = components(faces)
    if count <= pieces:
        return vertices, faces
    size = np.bincount(piece)
    keep = np.argsort(-size, kind="stable")[:pieces]
    if size[keep].sum() < 0.98 * len(faces):
        return vertices, faces
    return compact(vertices, faces[np.isin(piece, keep)])


def one_vertex_per_fan(
    vertices: np.ndarray, faces: np.ndarray, fans: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Bow-tie vertices doubled, so that each fan of faces (f, 3) or (f, 4) has its own; compact."""
    fans = corner_fans(faces)[0] if fans is None else fans
    used = faces >= 0
    _, first, new = np.unique(fans[used], return_index=True, return_inverse=True)
    out = np.full(faces.shape, -1, np.int64)
    out[used] = new.ravel()
    return vertices[faces[used][first]], out


def _volume(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> float:
    """Signed volume within a closed mesh of triangles (f, 3), whose normals (f, 3) and areas (f,) are known."""
    corners = (vertices - vertices[faces[0, 0]]).take(faces[:, 0], 0)
    return float(np.einsum("ij,ij,i", corners, normals, areas, optimize=False) / 3)


def _weld(vertices: np.ndarray, faces: np.ndarray, distance: float) -> np.ndarray:
    """Faces with one index for vertices that round to the same place."""
    grid = np.rint((vertices - vertices.min(0)) / distance)
    return first_equal(grid).take(faces)


def _split(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut along edges of more than two faces, faces that walk an edge alike turned first where that helps."""
    igl = imported("igl")
    faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(faces))[0])
    vertices, faces, _ = igl.split_nonmanifold(np.ascontiguousarray(vertices), np.ascontiguousarray(faces))
    return np.asarray(vertices), np.asarray(faces)


def _oriented(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Each closed piece turned to face outward; open ones keep the majority of the directions they had."""
    igl = imported("igl")
    faces = np.asarray(igl.bfs_orient(np.ascontiguousarray(faces))[0]).copy()
    count, piece = components(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    centre = (
        np.stack([np.bincount(piece, a[:, i], count) for i in range(3)], -1)
        / np.bincount(piece, minlength=count)[:, None]
    )
    volume = np.bincount(piece, np.einsum("ij,ij->i", a - centre[piece], np.cross(b - a, c - a)), count)
    inward = (volume < 0)[piece]
    faces[inward] = faces[inward][:, ::-1]
    return faces
