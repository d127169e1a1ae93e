"""The quick collapse of a large closed mesh: cut in two, one half collapsed by this process, the other by a copy of it."""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np

from gdtool.core.child import ChildFailed, beside
from gdtool.core.threads import cores
from gdtool.geometry.normals import face_normals
from gdtool.geometry.topology import even

Collapse = Callable[..., tuple[np.ndarray, np.ndarray]]  # (vertices, faces, target_faces, unit, keep_border)
LARGE = 200_000  # triangles from which a second process pays
_MOST_LEFT = 0.15  # of the triangles: where more are left, the rim, which stays as fine as it was, is too much of a half
_RIM_FACES = 2.25  # triangles that a half is left with for each vertex of its rim
_MOST_ON_RIM = 0.25  # of the triangles asked for
_RINGS, _SEAM_UNIT = 3, 0.1  # of triangles about the rim that are collapsed once the halves are one; the unit that this is done in, in that of the halves


def worth_halving(faces: np.ndarray, target_faces: int) -> bool:
    """Whether two processes collapse triangles (f, 3) sooner than one: there are many, few are left, and the mesh is closed, so that
    the border of each half is the rim where it was cut."""
    return (sys.platform == "linux" and cores() > 1 and len(faces) > LARGE and target_faces < _MOST_LEFT * len(faces)
            and even(faces))


def in_halves(collapse: Collapse, vertices: np.ndarray, faces: np.ndarray, target_faces: int, unit: float) -> tuple[np.ndarray, np.ndarray] | None:
    """What collapse() makes of a mesh, each half of it by a process of its own; None where the cut is too long or a half failed or lost its rim.

    vertices (v, 3), faces (f, 3). The halves keep their rims, by whose vertices, their first ones, they are joined; then
    what is about the seam is collapsed once more.
    """
    rows = np.ascontiguousarray(vertices.T)
    place = rows[np.ptp(rows, 1).argmax()].take(faces[:, 0])
    low = place < np.median(place)
    halves = [faces.take(np.flatnonzero(side), 0) for side in (low, ~low)]
    used = np.zeros((2, len(vertices)), bool)
    for own, half in zip(used, halves, strict=True):
        own[half] = True
    rim = np.flatnonzero(used.all(0))
    if not 0 < _RIM_FACES * len(rim) < _MOST_ON_RIM * target_faces:
        return None
    areas = [face_normals(vertices, half[::16])[1].sum() for half in halves]
    asked = [round(target_faces * area / sum(areas) + _RIM_FACES * len(rim) / 2) for area in areas]
    parts = [_first(rim, own, half) for own, half in zip(used, halves, strict=True)]
    try:
        other = beside(collapse, vertices.take(parts[1][0], 0), parts[1][1], asked[1], unit, True)
        first_vertices, first = collapse(vertices.take(parts[0][0], 0), parts[0][1], asked[0], unit, True)
        second_vertices, second = other()
    except (OSError, ChildFailed):  # no second process to be had, or it died
        return None
    rims = first_vertices[:len(rim)], second_vertices[:len(rim)]
    if not np.array_equal(*rims):
        return None
    out = np.concatenate([first_vertices, second_vertices[len(rim):]])
    joined = np.concatenate([first, np.where(second < len(rim), second, second + len(first_vertices) - len(rim))])
    return _seam_collapsed(collapse, out, joined, len(rim), target_faces, unit * _SEAM_UNIT)


def _first(rim: np.ndarray, used: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (u,) of the vertices that faces (f, 3) use, those of the rim (r,) first, and the faces by their place among these."""
    inner = used.copy()
    inner[rim] = False
    order = np.concatenate([rim, np.flatnonzero(inner)])
    number = np.empty(len(used), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return order, number.take(faces)


def _seam_collapsed(collapse: Collapse, vertices: np.ndarray, faces: np.ndarray, rim: int, target_faces: int, unit: float) -> tuple[np.ndarray, np.ndarray] | None:
    """A mesh whose first `rim` vertices are a seam, without the small triangles about it; None where these lost their border."""
    near = np.arange(len(vertices)) < rim
    for _ in range(_RINGS):
        about = near[faces].any(1)
        near[faces[about]] = True
    used = np.zeros((2, len(vertices)), bool)
    used[0, faces[about]], used[1, faces[~about]] = True, True
    border, rest = np.flatnonzero(used.all(0)), np.flatnonzero(used[1])
    order, few = _first(border, used[0], faces[about])
    made_vertices, made = collapse(vertices[order], few, target_faces - int((~about).sum()), unit, True)
    if len(made_vertices) < len(border) or not np.allclose(made_vertices[:len(border)], vertices[border], rtol=0, atol=1e-6 * np.ptp(vertices, 0).max()):
        return None
    number = np.empty(len(vertices), np.int64)
    number[rest] = np.arange(len(rest))
    place = np.concatenate([number[border], len(rest) + np.arange(len(made_vertices) - len(border))])
    return np.concatenate([vertices[rest], made_vertices[len(border):]]), np.concatenate([number[faces[~about]], place[made]])
