"""Flat charts cut where that makes them pack better: rings into arcs, thin arms off."""

from __future__ import annotations

import heapq
import itertools

import numpy as np

from gdtool.folders.mesh import triangulated
from gdtool.geometry.repair import edges_of
from gdtool.texture.unwrap_charts import Adjacency
from gdtool.texture.unwrap_pack import upright_box

_ANGLES = np.radians(np.arange(0, 180, 15.0))
_OFFSETS = np.linspace(0.06, 0.94, 23)
_WELL_FILLED = 0.62  # of its smallest upright rectangle: such a chart stays whole
_WORTH = 0.15  # of the rectangle, that a cut has to save
_WORTH_OF_A_RING = -0.05  # halves of a ring save nothing, their halves do
_TRIED = 16  # lines, best first
_SEEN = 1000  # faces of a chart that its rectangles are taken around
_SMALLEST = 0.004  # of all area, that a part has to have


def cut_to_pack(adjacency: Adjacency, charts: list, most: int, rings: bool) -> list:
    """Charts (faces_idx, corners, uv, triangles) with the ill-shaped ones cut along straight lines of their plane, as far
    as the quads allow; at most `most` in all. Texture coordinates stay: parts of what is flat are flat.

    rings: cut those with a hole as well, which makes many charts of one.
    """
    smallest = _SMALLEST * adjacency.area.sum()
    out: list[tuple] = []
    queue: list[tuple[float, int, tuple]] = []  # the one whose rectangle is emptiest first
    number = itertools.count()  # and of equal ones the earlier

    def add(chart: tuple) -> None:
        uv, triangles = upright_box(chart[2]), chart[3]
        a, b = uv[triangles[:, 1]] - uv[triangles[:, 0]], uv[triangles[:, 2]] - uv[triangles[:, 0]]
        covered = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()) / 2
        heapq.heappush(queue, (covered - float(np.prod(np.ptp(uv, 0))), next(number), chart))

    for chart in charts:
        add(chart)
    while queue:
        _, _, chart = heapq.heappop(queue)
        halves = _halves(adjacency, chart, smallest, rings) if len(out) + len(queue) + 2 <= most else None
        if halves is None:
            out.append(chart)
        else:
            for half in halves:
                add(part_of(chart, half))
    return out


def _halves(adjacency: Adjacency, chart: tuple, smallest: float, rings: bool) -> list[np.ndarray] | None:
    """Two masks (k,) of the chart's faces, each connected, whose rectangles are smallest together; None to leave it whole."""
    faces_idx, corners, uv, triangles = chart
    area = adjacency.area[faces_idx]
    if area.sum() < 2 * smallest:
        return None
    centre = uv[np.where(corners < 0, corners[:, :1], corners)].mean(1)
    # Rectangles around the faces' centres: their rims lie half a face farther out.
    rim = float(np.sqrt(area.mean()))
    across = np.stack([centre @ (np.cos(a), np.sin(a)) for a in _ANGLES])
    sample = across[:, :: -(-len(area) // _SEEN)]
    whole = float(_rectangles(np.ptp(sample, 1) + rim))
    if area.sum() > _WELL_FILLED * whole:
        return None
    found = []
    for row, seen in zip(across, sample, strict=True):
        line = row.min() + _OFFSETS * np.ptp(row)
        covered = np.bincount(np.searchsorted(line, row, "right"), area, len(line) + 1).cumsum()[:-1]  # before each line
        sorted_by = sample[:, np.argsort(seen, kind="stable")]
        before, behind = _spans(sorted_by), _spans(sorted_by[:, ::-1])[:, ::-1]
        count = np.searchsorted(np.sort(seen), line, "left")
        good = (count > 0) & (count < len(seen)) & (np.minimum(covered, area.sum() - covered) >= smallest)
        cost = _rectangles(before[:, count[good] - 1] + rim) + _rectangles(behind[:, count[good]] + rim)
        found += [(float(c), row, place) for c, place in zip(cost, line[good], strict=True)]
    found.sort(key=lambda one: one[0])
    edges = edges_of(triangles)
    ring = rings and len(uv) - len(edges.ends) + len(triangles) < 1
    for cost, row, place in found[:_TRIED]:
        if cost > (1 - (_WORTH_OF_A_RING if ring else _WORTH)) * whole:
            return None
        half = row < place
        parts = [part for side in (half, ~half) for part in connected(adjacency, faces_idx, side)]
        # A line across a ring leaves two arcs on one side: three parts are well, crumbs are not.
        if len(parts) <= 3 and min(area[part].sum() for part in parts) >= smallest:
            return parts
    return None


def _spans(values: np.ndarray) -> np.ndarray:
    """(a, n): how far values (a, n) up to each one spread."""
    return np.maximum.accumulate(values, 1) - np.minimum.accumulate(values, 1)


def _rectangles(spans: np.ndarray) -> np.ndarray:
    """Area of the smallest of the rectangles that have spans (angles, …) along _ANGLES."""
    quarter = len(_ANGLES) // 2
    return (spans[:quarter] * spans[quarter:]).min(0)


def connected(adjacency: Adjacency, faces_idx: np.ndarray, side: np.ndarray) -> list[np.ndarray]:
    """The connected parts of a side (k,) of faces (k,), as masks (k,)."""
    number = np.full(len(side), -1)
    number[side] = adjacency.pieces(faces_idx[side])
    return [number == n for n in range(number.max() + 1)]


def part_of(chart: tuple, half: np.ndarray) -> tuple:
    """A chart (faces_idx, corners, uv, triangles) of some of its faces (k,) bool, which stay where they lie."""
    faces_idx, corners, uv, _ = chart
    used, local = np.unique(corners[half], return_inverse=True)
    local = local.reshape(-1, 4)
    if used[0] < 0:
        used, local = used[1:], local - 1
    return faces_idx[half], local, uv[used], triangulated(local)[0]
