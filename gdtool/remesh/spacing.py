"""Move the pieces of a mesh apart before remeshing, so that no quads are fitted to a neighbouring piece."""

from __future__ import annotations

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import closest_points
from gdtool.geometry.meshes import TriMesh

_MAX_FACES = 200_000  # pieces of larger meshes are not looked for: that takes too long
_MAX_PIECES = 1000  # more pieces stay where they are: all pairs of boxes are compared


class SeparatedPieces:
    """A mesh whose pieces were moved apart, and the offsets that move them back."""

    def __init__(self, mesh: TriMesh, piece: np.ndarray, offset: np.ndarray):
        """Move each piece of a mesh by its offset.

        piece (f,): the piece of each face. offset (pieces, 3): how far each piece moves.
        """
        self._piece, self._offset = piece, offset
        piece_of_vertex = np.zeros(len(mesh.vertices), np.int64)
        piece_of_vertex[mesh.faces.ravel()] = np.repeat(piece, 3)
        self.mesh = TriMesh(mesh.vertices + offset[piece_of_vertex], mesh.faces)

    def to_original(self, points: np.ndarray) -> np.ndarray:
        """Move points (n, 3) on or near the separated pieces back to where the pieces came from."""
        return points - self._offset[self._piece[closest_points(points, self.mesh)[1]]]


def separate_pieces(mesh: TriMesh, gap: float) -> SeparatedPieces | None:
    """Place the pieces in rows, with at least `gap` between their bounding boxes.

    Returns None where the boxes are that far apart already, or where the mesh or the number of its pieces is too large.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if len(faces) > _MAX_FACES:
        return None
    count, piece = topology.components(faces)
    if not 1 < count <= _MAX_PIECES:
        return None
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in faces.T:
        np.minimum.at(low, piece, vertices[corner])
        np.maximum.at(high, piece, vertices[corner])
    meet = (low[:, None] < high[None] + gap).all(2)
    if (meet & meet.T).sum() == count:
        return None
    size = high - low + gap
    row_width = max((size[:, 0] * size[:, 1]).sum() ** 0.5, size[:, 0].max())
    position, x, y, row_height = np.zeros((count, 3)), 0.0, 0.0, 0.0
    for k in np.argsort(-size[:, 1], kind="stable").tolist():
        if x + size[k, 0] > row_width:
            x, y, row_height = 0.0, y + row_height, 0.0
        position[k, :2] = x, y
        x, row_height = x + size[k, 0], max(row_height, size[k, 1])
    return SeparatedPieces(mesh, piece, position - low)
