"""Remove the faces of a flat chart that lie on other parts of it, and give them to neighbouring charts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import edges_of
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.parameterize.flatten import (
    StretchMeasure,
    extend_conformally,
    flatten,
    is_disk,
    is_unfolded,
    overlapping_triangles,
    overlaps_itself,
)
from gdtool.unwrap.segment.charts import Adjacency, chart_mesh
from gdtool.unwrap.segment.merge import merged_stretch_limit

_MAX_REMOVED_SHARE = 0.2  # of a chart's area; where more overlaps the chart is cut
_MAX_NEIGHBOURS = 3  # charts that a piece is offered to, longest seam first
_MAX_WORK = 3  # faces flattened again for that in all, in units of the mesh's faces
_FIXED_FACTOR = 4  # times a piece's faces: a larger chart keeps its coordinates, and the piece is placed beside it
_MAX_PIECE_STRETCH = 1.1  # of a piece beside such a chart, at the chart's scale, in either direction


class OverlapPiece(NamedTuple):
    """Faces (k,) removed from a chart, and a face of that chart, which the piece is not offered to again."""

    home: int
    faces_idx: np.ndarray


def remove_overlaps(
    adjacency: Adjacency, faces_idx: np.ndarray, triangles: np.ndarray, face_idx: np.ndarray, overlapped: np.ndarray
) -> np.ndarray | None:
    """Choose the faces of a chart to keep so that none lies on another.

    faces_idx (k,); triangles (t, 3); face_idx (t,): the row in faces_idx of each triangle's face; overlapped (v, 2):
    the overlapping coordinates that flatten() returned. The smallest connected set of overlapping faces is removed,
    again and again, until nothing overlaps. Returns (k,) bool, or None where more than _MAX_REMOVED_SHARE of the area
    would go.
    """
    overlaps = overlapping_triangles(overlapped, triangles)
    keep, area = np.ones(len(faces_idx), bool), adjacency.area[faces_idx]
    while overlaps.any():
        faces = np.unique(face_idx[keep[face_idx]][overlaps])
        connected_set = adjacency.connected_sets(faces_idx[faces])
        keep[faces[connected_set == np.bincount(connected_set, area[faces]).argmin()]] = False
        if area[~keep].sum() > _MAX_REMOVED_SHARE * area.sum() or not keep.any():
            return None
        overlaps = overlapping_triangles(overlapped, triangles[keep[face_idx]])
    return keep


def give_to_neighbours(
    adjacency: Adjacency,
    mesh: QuadMesh,
    charts: list[Chart],
    pieces: list[OverlapPiece],
    good_stretch: float,
) -> list[OverlapPiece]:
    """Add each piece to a neighbouring chart that it lies flat with; return the pieces that fit nowhere.

    Changes `charts`. Chart and piece together may stretch as much as two merged charts.
    """
    vertices, faces = mesh.vertices, mesh.faces
    owner, number = np.full((2, adjacency.count), -1)
    for i, chart in enumerate(charts):
        owner[chart.faces_idx] = i
    for i, piece in enumerate(pieces):
        number[piece.faces_idx] = i
    sides = number[adjacency.pairs]
    rim = np.flatnonzero(sides[:, 0] != sides[:, 1])
    rows_of = _rows_by_number(sides[rim].T.ravel(), np.tile(rim, 2), len(pieces))
    unplaced, work = [], 0
    by_size = sorted(zip(rows_of, pieces, strict=True), key=lambda pair: len(pair[1].faces_idx), reverse=True)
    for rows, piece in by_size:
        beside = owner[adjacency.pairs[rows]].max(1)  # the piece itself has no owner yet
        beside = np.where(beside == owner[piece.home], -1, beside)
        seam = np.bincount(beside[beside >= 0], adjacency.cost[rows[beside >= 0]], len(charts))
        for i in np.argsort(-seam, kind="stable")[:_MAX_NEIGHBOURS].tolist():
            if not seam[i] or work > _MAX_WORK * adjacency.count:
                continue
            faces_idx = np.concatenate([charts[i].faces_idx, piece.faces_idx])
            work += len(faces_idx)
            both = chart_mesh(QuadMesh(vertices, faces[faces_idx]))
            triangles = TriMesh(both.vertices, both.triangulation.faces.astype(np.int64))
            max_stretch = merged_stretch_limit(good_stretch)
            if len(charts[i].faces_idx) > _FIXED_FACTOR * len(piece.faces_idx):
                uv = _extend_chart(both, triangles, charts[i], max_stretch)
            else:
                uv = flatten(triangles, good_stretch, max_stretch).uv
            if uv is not None:
                charts[i], owner[piece.faces_idx] = Chart(faces_idx, both.faces, uv, triangles.faces), i
                break
        else:
            unplaced.append(piece)
    return unplaced


def _extend_chart(both: QuadMesh, triangles: TriMesh, chart: Chart, max_stretch: float) -> np.ndarray | None:
    """Flatten a piece beside a chart that keeps its coordinates, conformally from their common seam on.

    both: a mesh of the chart's faces and then the piece's; triangles: the same, triangulated. max_stretch: L2, of both
    together. Returns uv (v, 2), or None where the piece does not lie flat this way, or where it would close a cut of
    the chart.
    """
    chart_corners = both.faces[: len(chart.corners)][chart.corners >= 0]
    chart_uv = chart.uv[chart.corners[chart.corners >= 0]]
    uv = np.full((len(both.vertices), 2), np.nan)
    uv[chart_corners] = chart_uv
    if (uv[chart_corners] != chart_uv).any():
        return None
    piece = TriMesh(triangles.vertices, triangles.faces[len(chart.triangles) :])
    uv = extend_conformally(piece, uv)
    if uv is None or not is_unfolded(uv, triangles.faces):
        return None
    piece_stretch, edges = StretchMeasure(piece).at_scale(uv), edges_of(triangles.faces)
    if (
        not 1 / _MAX_PIECE_STRETCH < piece_stretch < _MAX_PIECE_STRETCH
        or StretchMeasure(triangles).stretch(uv) > max_stretch
    ):
        return None
    return None if overlaps_itself(uv, triangles.faces, edges, is_disk(triangles, edges)) else uv


def _rows_by_number(number: np.ndarray, rows: np.ndarray, count: int) -> list[np.ndarray]:
    """Group the rows (r,) by number (r,) in 0 ... count - 1, in rising order; -1 belongs to no group."""
    order = np.lexsort((rows, number))
    return np.split(rows[order], np.searchsorted(number[order], np.arange(count + 1)))[1:-1]
