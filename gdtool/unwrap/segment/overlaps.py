"""What lies on other parts of its own chart taken off it, and given to the charts around."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.topology import edges_of, triangulated
from gdtool.unwrap.parameterize.flatten import (
    Isometry,
    conformal_from,
    flatten,
    is_disk,
    lies_on_itself,
    overlapping,
    upright,
)
from gdtool.unwrap.segment.charts import Adjacency, own_corners
from gdtool.unwrap.segment.merge import joined_stretch

_MOST = 0.2  # of a chart's area, that is taken off; where more lies on itself the chart is cut
_NEIGHBOURS = 3  # charts that a piece is offered to
_WORK = 3  # faces that are laid flat again for that, in all, in units of the mesh's
_STAYS = 4  # times a piece's faces: a chart of more stays as it lies, and the piece is laid beside it
_STRETCH = 1.1  # of a piece beside such a chart, at its scale, either way


def peel(
    adjacency: Adjacency, faces_idx: np.ndarray, triangles: np.ndarray, face_idx: np.ndarray, overlapped: np.ndarray
) -> np.ndarray | None:
    """(k,) bool: faces of a chart that lie flat and apart from each other; None where too many would have to go.

    faces_idx (k,); triangles (t, 3); face_idx (t,) the face of each, a place in faces_idx; overlapped (v, 2): as
    flatten() gave it up. Of the faces that lie on others connected sets go, the smallest first, until none does."""
    on_others = overlapping(overlapped, triangles)
    keep, area = np.ones(len(faces_idx), bool), adjacency.area[faces_idx]
    while on_others.any():
        faces = np.unique(face_idx[keep[face_idx]][on_others])
        piece = adjacency.pieces(faces_idx[faces])
        keep[faces[piece == np.bincount(piece, area[faces]).argmin()]] = False
        if area[~keep].sum() > _MOST * area.sum() or not keep.any():
            return None
        on_others = overlapping(overlapped, triangles[keep[face_idx]])
    return keep


def onto_neighbours(
    adjacency: Adjacency,
    vertices: np.ndarray,
    faces: np.ndarray,
    charts: list,
    pieces: list[tuple[int, np.ndarray]],
    good_stretch: float,
) -> list[tuple[int, np.ndarray]]:
    """Which of the pieces lie flat with none of the charts beside them; the others join one, in place.

    charts (faces_idx, corners, uv, triangles), as flatten_all() returns them; pieces: a face of the chart that it lay
    on, and is not offered to again, and its faces. Chart and piece together stretch no more than two charts that are
    joined may."""
    owner, number = np.full((2, adjacency.count), -1)
    for i, chart in enumerate(charts):
        owner[chart[0]] = i
    for i, (_, piece) in enumerate(pieces):
        number[piece] = i
    sides = number[adjacency.pairs]
    rim = np.flatnonzero(sides[:, 0] != sides[:, 1])
    rows_of = _rows_of(sides[rim].T.ravel(), np.tile(rim, 2), len(pieces))
    left, work = [], 0
    for rows, (home, piece) in sorted(zip(rows_of, pieces, strict=True), key=lambda one: len(one[1][1]), reverse=True):
        beside = owner[adjacency.pairs[rows]].max(1)  # the piece itself has no owner yet
        beside = np.where(beside == owner[home], -1, beside)
        seam = np.bincount(beside[beside >= 0], adjacency.cost[rows[beside >= 0]], len(charts))
        for i in np.argsort(-seam, kind="stable")[:_NEIGHBOURS].tolist():
            if not seam[i] or work > _WORK * adjacency.count:
                continue
            faces_idx = np.concatenate([charts[i][0], piece])
            work += len(faces_idx)
            points, corners = own_corners(vertices, faces[faces_idx])
            triangles, most = triangulated(corners)[0].astype(np.int64), joined_stretch(good_stretch)
            if len(charts[i][0]) > _STAYS * len(piece):
                uv = _laid_beside(points, corners, triangles, charts[i], most)
            else:
                uv = flatten(points, triangles, good_stretch, most).uv
            if uv is not None:
                charts[i], owner[piece] = (faces_idx, corners, uv, triangles), i
                break
        else:
            left.append((home, piece))
    return left


def _laid_beside(
    points: np.ndarray, corners: np.ndarray, triangles: np.ndarray, chart: tuple, most: float
) -> np.ndarray | None:
    """uv (v, 2) of a chart and a piece, points (v, 3), corners (k, 4) of the chart's faces and then the piece's,
    triangles (t, 3) of both: the chart as it lies, the piece conformally from their seam on. None where it does not lie
    flat so, or a cut of the chart would close."""
    _, old, lies, own = chart
    at = corners[: len(old)][old >= 0]
    uv = np.full((len(points), 2), np.nan)
    uv[at] = lies[old[old >= 0]]
    if (uv[at] != lies[old[old >= 0]]).any():
        return None
    piece = triangles[len(own) :]
    uv = conformal_from(points, piece, uv)
    if uv is None or not upright(uv, triangles):
        return None
    by_piece, edges = Isometry(points, piece).at_scale(uv), edges_of(triangles)
    if not 1 / _STRETCH < by_piece < _STRETCH or Isometry(points, triangles).stretch(uv) > most:
        return None
    return None if lies_on_itself(uv, triangles, edges, is_disk(len(points), triangles, edges)) else uv


def _rows_of(number: np.ndarray, rows: np.ndarray, count: int) -> list[np.ndarray]:
    """The rows (r,) of each number (r,) below count, in rising order; -1 is none."""
    order = np.lexsort((rows, number))
    return np.split(rows[order], np.searchsorted(number[order], np.arange(count + 1)))[1:-1]
