"""Closed bodies that lie inside another one, which nobody sees from outside."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.distance import winding_number
from gdtool.geometry.rows import first_equal
from gdtool.geometry.topology import components, edges_of, even

_POINTS = 8  # vertices of a body that are asked for: all of them are inside, or the body sticks out
_INSIDE = 0.5  # least winding number of a point inside a closed body: 1 inside, 0 outside
# Bodies that are looked into, those of the largest boxes first: the cost of a scene of thousands of bodies.
_MOST_OUTER = 200


def internal_shells(vertices: np.ndarray, faces: np.ndarray, welded: bool = True) -> tuple[int, float]:
    """How many closed bodies lie inside another closed body, and the share of all faces that are theirs.

    vertices (v, 3), faces (f, 3). Bodies are connected by edges; open ones neither enclose nor count. A body counts
    where _POINTS of its vertices have a winding number of about 1 in one other body, whichever way that faces. welded:
    False where vertices at one place have several indices, as along seams of texture coordinates."""
    if not welded:
        faces = first_equal(vertices).take(faces)
    count, body = components(faces)
    if count < 2:
        return 0, 0.0
    sizes = np.bincount(body, minlength=count)
    low, high = _boxes(vertices, faces, body, count)
    closed = _closed(faces, body, count)
    order = np.argsort(body, kind="stable")
    start = np.concatenate([[0], np.cumsum(sizes)])
    inside = np.zeros(count, bool)
    by_size = np.argsort(-np.prod(high - low, axis=1), kind="stable")
    for outer in by_size[closed[by_size]][:_MOST_OUTER]:
        held = closed & ~inside & (low >= low[outer]).all(1) & (high <= high[outer]).all(1)
        held[outer] = False
        inner = np.flatnonzero(held)
        if not len(inner):
            continue
        chosen = np.stack([start[inner] + (sizes[inner] - 1) * k // (_POINTS - 1) for k in range(_POINTS)], 1)
        points = vertices[faces[order[chosen]].reshape(-1, 3)[:, 0]]
        winding = winding_number(points, vertices, faces[order[start[outer] : start[outer + 1]]])
        inside[inner] = (np.abs(winding).reshape(len(inner), _POINTS) > _INSIDE).all(1)
    return int(inside.sum()), float(sizes[inside].sum() / len(faces))


def _boxes(vertices: np.ndarray, faces: np.ndarray, body: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (count, 3) of each body's box."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in faces.T:
        np.minimum.at(low, body, vertices[corner])
        np.maximum.at(high, body, vertices[corner])
    return low, high


def _closed(faces: np.ndarray, body: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool: bodies each of whose edges has an even number of faces."""
    closed = np.ones(count, bool)
    if not even(faces):
        edges = edges_of(faces)
        odd = (edges.count % 2 == 1)[edges.half_edge_idx]
        closed[body[edges.half_face[odd]]] = False
    return closed


def told(vertices: np.ndarray, faces: np.ndarray, welded: bool = True) -> str | None:
    """Return a line for the user where there are internal shells; None where there are none. Arguments as of
    internal_shells()."""
    count, share = internal_shells(vertices, faces, welded)
    if not count:
        return None
    bodies = "1 closed body lies" if count == 1 else f"{count} closed bodies lie"
    return (
        f"{bodies} inside another, with {share:.1%} of the faces, seen from nowhere outside; remove what is not wanted"
    )
