"""Pieces of a mesh laid out beside one another, so that nothing made of one is drawn onto another that it nearly
touches."""

from __future__ import annotations

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import closest_points

# Of larger meshes pieces are not looked for; more pieces are left where they are.
_MOST_FACES, _MOST_PIECES = 200_000, 1000


class Spread:
    """The mesh with its pieces apart: vertices (v, 3), the faces (f, 3) as they were."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, piece: np.ndarray, offset: np.ndarray):
        self._faces, self._piece, self._offset = faces, piece, offset
        of_vertex = np.zeros(len(vertices), np.int64)
        of_vertex[faces.ravel()] = np.repeat(piece, 3)
        self.vertices = vertices + offset[of_vertex]

    def back(self, vertices: np.ndarray) -> np.ndarray:
        """Where points (n, 3) on or near the spread pieces were before."""
        return vertices - self._offset[self._piece[closest_points(vertices, self.vertices, self._faces)[1]]]


def spread(vertices: np.ndarray, faces: np.ndarray, gap: float) -> Spread | None:
    """The pieces in rows, their bounding boxes `gap` apart at least; None where they are so already, or are too many to
    tell.

    vertices (v, 3), faces (f, 3).
    """
    if len(faces) > _MOST_FACES:
        return None
    count, piece = topology.components(faces)
    if not 1 < count <= _MOST_PIECES:
        return None
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in faces.T:
        np.minimum.at(low, piece, vertices[corner])
        np.maximum.at(high, piece, vertices[corner])
    meet = (low[:, None] < high[None] + gap).all(2)
    if (meet & meet.T).sum() == count:
        return None
    size = high - low + gap
    width = max((size[:, 0] * size[:, 1]).sum() ** 0.5, size[:, 0].max())
    place, x, y, row = np.zeros((count, 3)), 0.0, 0.0, 0.0
    for k in np.argsort(-size[:, 1], kind="stable").tolist():
        if x + size[k, 0] > width:
            x, y, row = 0.0, y + row, 0.0
        place[k, :2] = x, y
        x, row = x + size[k, 0], max(row, size[k, 1])
    return Spread(vertices, faces, piece, place - low)
