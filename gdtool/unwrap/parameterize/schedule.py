"""All charts laid flat: small ones joined, those that lie on themselves peeled, cut where that does not help or all of
them stretch too much."""

from __future__ import annotations

import heapq
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.geometry.topology import triangulated
from gdtool.unwrap.parameterize.flatten import Flat, flatten, onto_plane, stretch, upright
from gdtool.unwrap.segment.charts import Adjacency, bisect, own_corners
from gdtool.unwrap.segment.merge import joined, joined_stretch
from gdtool.unwrap.segment.overlaps import onto_neighbours, peel
from gdtool.unwrap.segment.straight_cuts import connected, part_of

_WHOLE = 1.4  # stretch of all charts together over 1, in units of what is good for one: with more the worst are cut
_MOST_RELIEVED = 16, 0.5  # charts that are cut for that: so many, and this share of all
_LATE = "was left when the time was over"


@dataclass
class Laid:
    """charts (faces_idx, corners (k, 4), uv (c, 2) v up, triangles), corners into uv; `off`: sets of faces taken off
    them, each with a face of the chart that it came off; how many were cut for each reason."""

    charts: list[tuple] = field(default_factory=list)
    off: list[tuple[int, np.ndarray]] = field(default_factory=list)
    cut: Counter = field(default_factory=Counter)

    def add(self, more: Laid) -> None:
        self.charts += more.charts
        self.off += more.off
        self.cut += more.cut

    def reasons(self) -> list[str]:
        return [f"{count} charts were cut: a chart {reason}" for reason, count in self.cut.items()]


def flatten_all(
    vertices: np.ndarray,
    faces: np.ndarray,
    label: np.ndarray,
    good_stretch: float,
    max_stretch: float,
    proxy: tuple[np.ndarray, np.ndarray] | None = None,
    by: tuple[float, float] = (np.inf, np.inf),
    part: np.ndarray | None = None,
) -> tuple[list, list[str]]:
    """Each chart of faces (f, 4), label (f,), laid flat, and what was cut: Laid.charts and a line for each reason.

    proxy, vertices and triangles: a coarse mesh of the surface, on which joining is tried. Without one nothing is
    joined and charts are laid flat by projection alone, cut until that works. by: when, on the clock time.monotonic,
    projection alone goes on with what is left, and when each face of that becomes a chart. part (f,): what stays
    together where a chart is cut, if it can."""
    adjacency, part = Adjacency(vertices, faces), label if part is None else part
    vertices, faces = one_vertex_per_fan(vertices, faces)

    def further(sets: list[np.ndarray], **how: bool) -> Laid:
        return lay(adjacency, vertices, faces, label, part, sets, good_stretch, max_stretch, by, **how)

    if proxy is None:
        laid = further(_sets(label), projected=True)
        return laid.charts, laid.reasons()
    joined_label = joined(vertices, faces, label, *proxy, good_stretch) if time.monotonic() < by[0] else label
    laid = further(_sets(joined_label), peeling=True)
    if time.monotonic() < by[0]:
        laid.off = onto_neighbours(adjacency, vertices, faces, laid.charts, laid.off, good_stretch)
    laid.add(further([faces_idx for _, faces_idx in laid.off]))
    if time.monotonic() < by[0]:
        _relieve(adjacency, vertices, faces, part, laid, further, good_stretch)
    return laid.charts, laid.reasons()


def lay(
    adjacency: Adjacency,
    vertices: np.ndarray,
    faces: np.ndarray,
    label: np.ndarray,
    part: np.ndarray,
    sets: list[np.ndarray],
    good_stretch: float,
    max_stretch: float,
    by: tuple[float, float] = (np.inf, np.inf),
    *,
    peeling: bool = False,
    projected: bool = False,
) -> Laid:
    """Sets of faces laid flat, cut where they do not lie so; a set of several labels (f,), joined, may stretch less and
    comes apart first.

    part, by: as flatten_all()'s. peeling: take off what lies on other parts of a chart, where that is little.
    projected: by projection alone."""
    laid, queue = Laid(), sets[::-1]
    while queue:
        faces_idx, now = queue.pop(), time.monotonic()
        if now > by[1]:
            laid.cut[_LATE] += len(faces_idx) > 1
            laid.charts += _face_by_face(vertices, faces, faces_idx)
            continue
        if now > by[0]:
            peeling, projected = False, True
        parts = _sets(label[faces_idx])
        points, corners = own_corners(vertices, faces[faces_idx])
        triangles, face_idx = triangulated(corners)
        if projected:
            flat = Flat(onto_plane(points, triangles), "is not flat")
        else:
            flat = flatten(
                points,
                triangles.astype(np.int64),
                good_stretch,
                max_stretch if len(parts) == 1 else joined_stretch(good_stretch),
            )
        uv = flat.uv
        if uv is None and len(parts) > 1:  # joined on the proxy, and do not lie flat together here
            queue.extend(faces_idx[part] for part in parts)
            continue
        if uv is None and len(faces_idx) == 1:
            uv = _alone(points, corners[0])
        if uv is not None:
            laid.charts.append((faces_idx, corners, uv, triangles))
            continue
        laid.cut[flat.reason] += 1
        keep = (
            peel(adjacency, faces_idx, triangles, face_idx, flat.overlapped)
            if peeling and flat.overlapped is not None
            else None
        )
        if keep is not None:
            largest, *others = sorted(connected(adjacency, faces_idx, keep), key=np.count_nonzero, reverse=True)
            laid.charts.append(part_of((faces_idx, corners, flat.overlapped, triangles), largest))
            home = int(laid.charts[-1][0][0])
            laid.off += [(home, faces_idx[part]) for part in others + connected(adjacency, faces_idx, ~keep)]
            continue
        queue.extend(_halves(adjacency, part, faces_idx))
    return laid


def _relieve(
    adjacency: Adjacency,
    vertices: np.ndarray,
    faces: np.ndarray,
    part: np.ndarray,
    laid: Laid,
    further: Callable[[list[np.ndarray]], Laid],
    good_stretch: float,
) -> None:
    """The charts that make all of them together stretch too much cut, in place, those that weigh most first; further:
    lays the parts.

    The square of the whole's stretch is the mean of the charts' squares by area: each is laid at the scale of the
    surface."""
    most = _MOST_RELIEVED[0] + int(_MOST_RELIEVED[1] * len(laid.charts))
    allowed = ((1 + _WHOLE * (good_stretch - 1)) ** 2 - 1) * float(adjacency.area.sum())

    def excess(chart: tuple) -> float:
        faces_idx, corners, uv, triangles = chart
        points = np.zeros((len(uv), 3))
        used = corners >= 0
        points[corners[used]] = vertices[faces[faces_idx][used]]
        value = stretch(points, triangles.astype(np.int64), uv) ** 2 - 1
        return float(adjacency.area[faces_idx].sum()) * value if np.isfinite(value) else 0.0

    values = [excess(chart) for chart in laid.charts]
    total, gone = sum(values), set()
    queue = [(-value, i) for i, value in enumerate(values) if value > 0 and len(laid.charts[i][0]) > 1]
    heapq.heapify(queue)
    while total > allowed and len(gone) < most and queue:
        # At once all those that have to be cut even if the parts of the worse ones do not stretch at all.
        worst, rest = [], total
        while rest > allowed and len(gone) + len(worst) < most and queue:
            worst.append(heapq.heappop(queue))
            rest += worst[-1][0]
        gone.update(i for _, i in worst)
        halves = further([half for _, i in worst for half in _halves(adjacency, part, laid.charts[i][0])])
        values = [excess(chart) for chart in halves.charts]
        total = rest + sum(values)
        for i, value in enumerate(values):
            if value > 0 and len(halves.charts[i][0]) > 1:
                heapq.heappush(queue, (-value, len(laid.charts) + i))
        laid.add(halves)
        laid.cut["stretches more than most"] += len(worst)
    laid.charts = [chart for i, chart in enumerate(laid.charts) if i not in gone]


def _halves(adjacency: Adjacency, part: np.ndarray, faces_idx: np.ndarray) -> list[np.ndarray]:
    """Two or more connected sets of a chart's faces, cut between its parts, part (f,), where it has several: they begin
    and end at creases."""
    half, area = bisect(adjacency, faces_idx), adjacency.area[faces_idx]
    if half.all() or not half.any():
        half = np.arange(len(faces_idx)) < len(faces_idx) // 2
    place = np.unique(part[faces_idx], return_inverse=True)[1]
    share = np.bincount(place, area * half) / np.maximum(np.bincount(place, area), 1e-300)
    # Some on each side, unless their shares are equal.
    whole = (share > np.clip(0.5, share.min(), np.nextafter(share.max(), 0)))[place]
    half = half if whole.all() else whole
    number = adjacency.pieces(faces_idx, half)
    return [faces_idx[number == n] for n in range(number.max() + 1)]


def _sets(label: np.ndarray) -> list[np.ndarray]:
    """The places of each label, in the labels' order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _face_by_face(vertices: np.ndarray, faces: np.ndarray, faces_idx: np.ndarray) -> list[tuple]:
    """A chart of each of some faces (k,), seen along its normal; where it folds so, a square or right triangle of its
    size."""
    own = faces[faces_idx]
    corner = vertices[np.where(own < 0, own[:, :1], own)]
    x = corner[:, 1] - corner[:, 0]
    x /= np.maximum(np.linalg.norm(x, axis=1), 1e-300)[:, None]
    y = np.cross(polygon_normals(vertices, own)[0], x)
    uv = np.stack([np.einsum("kcd,kd->kc", corner, x), np.einsum("kcd,kd->kc", corner, y)], -1)
    charts = []
    for face, used, flat, points in zip(faces_idx.tolist(), own >= 0, uv, corner, strict=True):
        corners = np.where(used, np.arange(4), -1)[None]
        flat, triangles = flat[used], triangulated(corners)[0]
        charts.append(
            (
                np.array([face]),
                corners,
                flat if upright(flat, triangles) else _alone(points[used], corners[0]),
                triangles,
            )
        )
    return charts


def _alone(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """One face on its own that will not lie flat (no area, or folded): a square or right triangle of its size."""
    used = corners[corners >= 0]
    size = max(float(np.ptp(points, 0).max()), 1e-6)
    uv = np.zeros((len(points), 2))
    uv[used] = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)[: len(used)] * size
    return uv
