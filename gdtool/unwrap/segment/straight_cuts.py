"""Flat charts cut where that makes them pack better: rings into arcs, thin arms off."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from functools import cached_property

import numpy as np

from gdtool.geometry.topology import triangulated
from gdtool.unwrap.segment.charts import Adjacency

_ANGLES = np.radians(np.arange(0, 180, 15.0))
_OFFSETS = np.linspace(0.06, 0.94, 23)
_WORTH = 0.003  # of all area, that rectangles around the charts have to lose for each chart that a cut adds
_TRIED = 16  # lines, best first
_SEEN = 1000  # faces of a chart that its rectangles are taken around
_SMALLEST = 0.004  # of all area, that a part has to have


def cut_to_pack(adjacency: Adjacency, charts: list, counts: list[int]) -> Iterator[list]:
    """Charts (faces_idx, corners, uv, triangles) with the ill-shaped ones cut along straight lines of their plane, as
    far as the quads allow: for each of the rising counts a list of about so many charts, until no cut is worth it.

    First come the cuts for which the smallest rectangles around the charts lose most, for each chart added. Texture
    coordinates stay: parts of what is flat are flat."""
    total = float(adjacency.area.sum())
    number = itertools.count()  # of equal ones the earlier
    whole, queue = [], []

    def add(piece: _Piece) -> None:
        if piece.rate < _WORTH * total:
            whole.append(piece.chart)
        else:
            heapq.heappush(queue, (-piece.rate, next(number), piece))

    for chart in charts:
        add(_Piece(adjacency, chart, _SMALLEST * total))
    for count in counts:
        changed = False
        while queue and len(whole) + len(queue) < count:
            for part in heapq.heappop(queue)[2].cut[1]:
                add(part)
            changed = True
        if changed:
            yield whole + [piece.chart for _, _, piece in sorted(queue, key=lambda one: one[1])]


class _Piece:
    """A chart, and how it would be cut."""

    def __init__(self, adjacency: Adjacency, chart: tuple, smallest: float):
        self._adjacency, self.chart, self._smallest = adjacency, chart, smallest

    @cached_property
    def cut(self) -> tuple[float, list[_Piece]] | None:
        """What the rectangles around its parts have less than its own, and these, two or three; None where no cut will
        do."""
        found = _halves(self._adjacency, self.chart, self._smallest)
        return found and (
            found[0],
            [_Piece(self._adjacency, part_of(self.chart, half), self._smallest) for half in found[1]],
        )

    @cached_property
    def rate(self) -> float:
        """The area that rectangles lose for each chart that is added, by this cut or by it and those of its parts: a
        ring's halves save nothing, their halves do."""
        if self.cut is None:
            return -np.inf
        saved, added = self.cut[0], len(self.cut[1]) - 1
        more = [part.cut for part in self.cut[1] if part.cut is not None and part.cut[0] > 0]
        return max(
            saved / added, (saved + sum(one for one, _ in more)) / (added + sum(len(parts) - 1 for _, parts in more))
        )


def _halves(adjacency: Adjacency, chart: tuple, smallest: float) -> tuple[float, list[np.ndarray]] | None:
    """The area that rectangles lose by a cut of the chart, and masks (k,) of its faces, two or three, each connected;
    None where none will do. Of straight lines the one is taken for which the rectangles are smallest."""
    faces_idx, corners, uv, _ = chart
    area = adjacency.area[faces_idx]
    if area.sum() < 2 * smallest:
        return None
    centre = uv[np.where(corners < 0, corners[:, :1], corners)].mean(1)
    # Rectangles around the faces' centres: their rims lie half a face farther out.
    rim = float(np.sqrt(area.mean()))
    across = np.stack([centre @ (np.cos(a), np.sin(a)) for a in _ANGLES])
    sample = across[:, :: -(-len(area) // _SEEN)]
    whole = float(_rectangles(np.ptp(sample, 1) + rim))
    found = []
    for row, seen in zip(across, sample, strict=True):
        line = row.min() + _OFFSETS * np.ptp(row)
        # Before each line.
        covered = np.bincount(np.searchsorted(line, row, "right"), area, len(line) + 1).cumsum()[:-1]
        order = np.argsort(seen, kind="stable")
        count = np.searchsorted(seen[order], line, "left")
        good = (count > 0) & (count < len(seen)) & (np.minimum(covered, area.sum() - covered) >= smallest)
        if good.any():
            before, behind = _spans(sample.take(order, 1), count[good])
            cost = _rectangles(before + rim) + _rectangles(behind + rim)
            found += [(float(c), row, place) for c, place in zip(cost, line[good], strict=True)]
    found.sort(key=lambda one: one[0])
    _, pairs = adjacency.within(faces_idx)
    for cost, row, place in found[:_TRIED]:
        number = _pieces(pairs, row < place, area, smallest)
        # A line across a ring leaves two arcs on one side: three parts are well, crumbs are not.
        if 1 < number.max() + 1 <= 3 and np.bincount(number, area).min() >= smallest:
            return whole - cost, [number == n for n in range(number.max() + 1)]
    return None


def _pieces(pairs: np.ndarray, half: np.ndarray, area: np.ndarray, smallest: float) -> np.ndarray:
    """(k,) number, from 0 on, of the connected part of its side, half (k,) bool, that each face is in; pairs (r, 2) of
    faces share an edge. Parts below `smallest`, which a line leaves along a rim that is not straight, change sides."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    for crumbs_may_change in (True, False):
        together = pairs[half[pairs[:, 0]] == half[pairs[:, 1]]]
        number = connected_components(
            coo_matrix((np.ones(len(together)), (together[:, 0], together[:, 1])), (len(half),) * 2), False
        )[1]
        crumb = np.bincount(number, area) < smallest
        if not crumbs_may_change or not crumb.any():
            break
        half = half ^ crumb[number]
    return number


def _spans(values: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far values (a, n) spread before each of the rising counts (c,), 0 < count < n, and from it on: (a, c)
    both."""
    first, at = np.unique(np.append(0, counts), return_inverse=True)
    high, low = np.maximum.reduceat(values, first, 1), np.minimum.reduceat(values, first, 1)
    before = np.maximum.accumulate(high, 1) - np.minimum.accumulate(low, 1)
    behind = np.maximum.accumulate(high[:, ::-1], 1) - np.minimum.accumulate(low[:, ::-1], 1)
    return before[:, at[1:] - 1], behind[:, ::-1][:, at[1:]]


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
