"""Find closed bodies that lie inside another one, where nobody sees them from outside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gdtool.geometry.distance import winding_number
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.topology import components, edges_of, has_even_edge_counts
from gdtool.geometry.unique_rows import index_of_first_equal

_SAMPLES = 8  # vertices of a body that are tested: all of them are inside, or the body sticks out
_MIN_WINDING = 0.5  # least winding number of a point inside a closed body: 1 inside, 0 outside
_MAX_OUTER = 200  # bodies tested for contents, the largest boxes first: limits the seconds for scenes of thousands


class EnclosedBodies(NamedTuple):
    """Hold how many closed bodies lie inside another closed body, and the share of all faces that belong to them."""

    bodies: int
    face_share: float


def enclosed_bodies(mesh: TriMesh, welded: bool = True) -> EnclosedBodies:
    """Count closed bodies inside other closed bodies.

    A body is a set of faces connected by edges. Open bodies neither enclose nor count. A closed body counts where a few
    of its vertices (_SAMPLES) all have a winding number of about 1 or -1 in one other body. welded: False where
    vertices at one position have several indices, as along seams of texture coordinates.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if not welded:
        faces = index_of_first_equal(vertices).take(faces)
    count, body = components(faces)
    if count < 2:
        return EnclosedBodies(0, 0.0)
    sizes = np.bincount(body, minlength=count)
    low, high = _bounding_boxes(TriMesh(vertices, faces), body, count)
    closed = _closed_bodies(faces, body, count)
    order = np.argsort(body, kind="stable")
    start = np.concatenate([[0], np.cumsum(sizes)])
    inside = np.zeros(count, bool)
    by_size = np.argsort(-np.prod(high - low, axis=1), kind="stable")
    for outer in by_size[closed[by_size]][:_MAX_OUTER]:
        boxed = closed & ~inside & (low >= low[outer]).all(1) & (high <= high[outer]).all(1)
        boxed[outer] = False
        inner = np.flatnonzero(boxed)
        if not len(inner):
            continue
        sampled = np.stack([start[inner] + (sizes[inner] - 1) * k // (_SAMPLES - 1) for k in range(_SAMPLES)], 1)
        points = vertices[faces[order[sampled]].reshape(-1, 3)[:, 0]]
        winding = winding_number(points, TriMesh(vertices, faces[order[start[outer] : start[outer + 1]]]))
        inside[inner] = (np.abs(winding).reshape(len(inner), _SAMPLES) > _MIN_WINDING).all(1)
    return EnclosedBodies(int(inside.sum()), float(sizes[inside].sum() / len(faces)))


def enclosed_bodies_warning(mesh: TriMesh, welded: bool = True) -> str | None:
    """Return a warning where enclosed_bodies(mesh, welded) finds any, else None."""
    count, share = enclosed_bodies(mesh, welded)
    if not count:
        return None
    bodies = "1 closed body lies" if count == 1 else f"{count} closed bodies lie"
    return (
        f"{bodies} inside another, with {share:.1%} of the faces, not visible from outside; remove what is not wanted"
    )


def _bounding_boxes(mesh: TriMesh, body: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest corner (count, 3) of each body's box; body (f,): the body of each face."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in mesh.faces.T:
        np.minimum.at(low, body, mesh.vertices[corner])
        np.maximum.at(high, body, mesh.vertices[corner])
    return low, high


def _closed_bodies(faces: np.ndarray, body: np.ndarray, count: int) -> np.ndarray:
    """Return (count,) bool: which bodies are closed, with an even number of faces at each edge.

    faces (f, 3). body (f,): the body of each face.
    """
    closed = np.ones(count, bool)
    if not has_even_edge_counts(faces):
        edges = edges_of(faces)
        odd = (edges.count % 2 == 1)[edges.half_edge_idx]
        closed[body[edges.half_face[odd]]] = False
    return closed
