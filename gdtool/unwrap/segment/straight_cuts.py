"""Cut flat charts along straight lines where that makes them pack better: rings into arcs, thin arms off."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from functools import cached_property
from typing import NamedTuple

import numpy as np

from gdtool.geometry.topology import triangulated
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.segment.charts import Adjacency

_ANGLES = np.radians(np.arange(0, 180, 15.0))  # directions across the lines that are tried
_OFFSETS = np.linspace(0.06, 0.94, 23)  # positions of the lines, in shares of the chart's span
_MIN_GAIN = 0.003  # of all area, that rectangles around the charts have to lose for each chart that a cut adds
_MAX_LINES = 16  # lines tried on the faces, best first
_MAX_SAMPLES = 1000  # faces of a chart that its rectangles are taken around
_MIN_PART = 0.004  # of all area, that a part has to have


def cut_to_pack(adjacency: Adjacency, charts: list[Chart], counts: list[int]) -> Iterator[list[Chart]]:
    """Cut charts of awkward shape along straight lines in their plane, as far as the quads allow.

    counts: rising numbers of charts. Yields for each of them a list of about that many charts, until no cut is worth
    it. First come the cuts that save most area for each chart added; the area is that of the smallest rectangles around
    the charts. Texture coordinates stay: parts of a flat chart are flat.
    """
    total = float(adjacency.area.sum())
    number = itertools.count()  # of equal cuts the earlier comes first
    whole: list[Chart] = []
    queue: list[tuple[float, int, _CutCandidate]] = []

    def add(piece: _CutCandidate) -> None:
        if piece.rate < _MIN_GAIN * total:
            whole.append(piece.chart)
        else:
            heapq.heappush(queue, (-piece.rate, next(number), piece))

    for chart in charts:
        add(_CutCandidate(adjacency, chart, _MIN_PART * total))
    for count in counts:
        changed = False
        while queue and len(whole) + len(queue) < count:
            best = heapq.heappop(queue)[2].cut
            assert best is not None  # without a cut a piece gains nothing, and is not in the queue
            for part in best[1]:
                add(part)
            changed = True
        if changed:
            yield whole + [piece.chart for _, _, piece in sorted(queue, key=lambda entry: entry[1])]


class _CutCandidate:
    """A chart, and its best straight cut."""

    def __init__(self, adjacency: Adjacency, chart: Chart, smallest: float):
        self._adjacency, self.chart, self._smallest = adjacency, chart, smallest

    @cached_property
    def cut(self) -> tuple[float, list[_CutCandidate]] | None:
        """Find the best cut: the area that rectangles lose by it, and its two or three parts; None without a cut."""
        best = _best_cut(self._adjacency, self.chart, self._smallest)
        if best is None:
            return None
        area, halves = best
        return area, [_CutCandidate(self._adjacency, sub_chart(self.chart, half), self._smallest) for half in halves]

    @cached_property
    def rate(self) -> float:
        """Compute the area that rectangles lose for each chart added, by this cut, or by it and the cuts of its parts.

        Cutting a ring in half saves nothing, but cutting its halves does.
        """
        if self.cut is None:
            return -np.inf
        gained, charts_added = self.cut[0], len(self.cut[1]) - 1
        further_cuts = [part.cut for part in self.cut[1] if part.cut is not None and part.cut[0] > 0]
        return max(
            gained / charts_added,
            (gained + sum(gain for gain, _ in further_cuts))
            / (charts_added + sum(len(parts) - 1 for _, parts in further_cuts)),
        )


class _Line(NamedTuple):
    """A straight line across a chart.

    It has the area of the rectangles around both sides, the coordinate of each face across the line, and the line's
    offset there.
    """

    area: float
    across: np.ndarray
    offset: float


def _best_cut(adjacency: Adjacency, chart: Chart, smallest: float) -> tuple[float, list[np.ndarray]] | None:
    """Find the straight line for which the rectangles around the parts are smallest.

    Returns the area that the rectangles lose by the cut, and masks (k,) of the faces of its two or three connected
    parts; None where every line leaves a part smaller than `smallest`.
    """
    faces_idx, corners, uv, _ = chart
    area = adjacency.area[faces_idx]
    if area.sum() < 2 * smallest:
        return None
    centre = uv[np.where(corners < 0, corners[:, :1], corners)].mean(1)
    # Rectangles are taken around face centres: the rim of a chart lies half a face farther out.
    rim = float(np.sqrt(area.mean()))
    across = np.stack([centre @ (np.cos(a), np.sin(a)) for a in _ANGLES])
    sample = across[:, :: -(-len(area) // _MAX_SAMPLES)]
    whole = float(_rectangle_area(np.ptp(sample, 1) + rim))
    lines: list[_Line] = []
    for row, seen in zip(across, sample, strict=True):
        offsets = row.min() + _OFFSETS * np.ptp(row)
        area_before = np.bincount(np.searchsorted(offsets, row, "right"), area, len(offsets) + 1).cumsum()[:-1]
        order = np.argsort(seen, kind="stable")
        count = np.searchsorted(seen[order], offsets, "left")
        good = (count > 0) & (count < len(seen)) & (np.minimum(area_before, area.sum() - area_before) >= smallest)
        if good.any():
            before, behind = _prefix_suffix_spans(sample.take(order, 1), count[good])
            cost = _rectangle_area(before + rim) + _rectangle_area(behind + rim)
            lines += [_Line(float(c), row, offset) for c, offset in zip(cost, offsets[good], strict=True)]
    lines.sort(key=lambda line: line.area)
    _, pairs = adjacency.within(faces_idx)
    for line in lines[:_MAX_LINES]:
        number = _connected_sides(pairs, line.across < line.offset, area, smallest)
        # A line across a ring leaves two arcs on one side: three parts are fine, crumbs are not.
        if 1 < number.max() + 1 <= 3 and np.bincount(number, area).min() >= smallest:
            return whole - line.area, [number == n for n in range(number.max() + 1)]
    return None


def _connected_sides(pairs: np.ndarray, half: np.ndarray, area: np.ndarray, smallest: float) -> np.ndarray:
    """Find the connected part (k,), numbered from 0 on, that each face is in on its side of a line.

    half (k,) bool: the side; pairs (r, 2) of faces share an edge. Parts with less area than `smallest`, which a line
    leaves along a rough rim, change sides.
    """
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


def _prefix_suffix_spans(values: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the spans of the first `count` of values (a, n), and of the others: (a, c) each.

    counts (c,): rising, 0 < count < n.
    """
    first, at = np.unique(np.append(0, counts), return_inverse=True)
    high, low = np.maximum.reduceat(values, first, 1), np.minimum.reduceat(values, first, 1)
    before = np.maximum.accumulate(high, 1) - np.minimum.accumulate(low, 1)
    behind = np.maximum.accumulate(high[:, ::-1], 1) - np.minimum.accumulate(low[:, ::-1], 1)
    return before[:, at[1:] - 1], behind[:, ::-1][:, at[1:]]


def _rectangle_area(spans: np.ndarray) -> np.ndarray:
    """Compute the area of the smallest rectangle that has spans (angles, ...) along the directions _ANGLES."""
    quarter = len(_ANGLES) // 2
    return (spans[:quarter] * spans[quarter:]).min(0)


def connected_masks(adjacency: Adjacency, faces_idx: np.ndarray, side: np.ndarray) -> list[np.ndarray]:
    """Split a side (k,) bool of faces (k,) into its connected parts, as masks (k,)."""
    number = np.full(len(side), -1)
    number[side] = adjacency.connected_sets(faces_idx[side])
    return [number == n for n in range(number.max() + 1)]


def sub_chart(chart: Chart, half: np.ndarray) -> Chart:
    """Make a chart of some faces, half (k,) bool, of a chart; their coordinates stay."""
    faces_idx, corners, uv, _ = chart
    used, local = np.unique(corners[half], return_inverse=True)
    local = local.reshape(-1, 4)
    if used[0] < 0:
        used, local = used[1:], local - 1
    return Chart(faces_idx[half], local, uv[used], triangulated(local)[0])
