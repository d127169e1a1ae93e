"""Flatten all charts of a mesh: merge small ones, remove overlaps, cut those that do not lie flat or stretch much."""

from __future__ import annotations

import heapq
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.geometry.topology import triangulated
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.parameterize.flatten import FlattenResult, flatten, is_unfolded, project_to_plane, stretch
from gdtool.unwrap.segment.charts import Adjacency, chart_mesh, split_in_half
from gdtool.unwrap.segment.merge import merge_small_charts, merged_stretch_limit
from gdtool.unwrap.segment.overlaps import OverlapPiece, give_to_neighbours, remove_overlaps
from gdtool.unwrap.segment.straight_cuts import connected_masks, sub_chart

# Excess over 1 of the stretch of all charts together, in units of a single chart's good excess: beyond it the charts
# that stretch most are cut.
_MAX_TOTAL_EXCESS = 1.4
_MAX_CUT, _MAX_CUT_SHARE = 16, 0.5  # charts cut for that reason: a fixed number, and a share of all charts
_LATE = "was left when the time was over"


@dataclass(frozen=True)
class FlattenLimits:
    """Limits of stretch, and the times from which simpler methods are used.

    good_stretch: L2 stretch at which flattening stops; max_stretch: beyond which a chart is cut. project_after: time
    (time.monotonic) from which the remaining charts are only projected to a plane; single_after: time from which each
    remaining face becomes a chart.
    """

    good_stretch: float
    max_stretch: float
    project_after: float = np.inf
    single_after: float = np.inf


@dataclass
class ParameterizedCharts:
    """Flat charts, the pieces removed from them, and the number of charts that were cut, by reason."""

    charts: list[Chart] = field(default_factory=list)
    removed: list[OverlapPiece] = field(default_factory=list)
    cut: Counter = field(default_factory=Counter)

    def add(self, other: ParameterizedCharts) -> None:
        """Append the charts, pieces and counts of `other`."""
        self.charts += other.charts
        self.removed += other.removed
        self.cut += other.cut

    def reasons(self) -> list[str]:
        """Write one sentence for each reason to cut charts."""
        return [f"{count} charts were cut: a chart {reason}" for reason, count in self.cut.items()]


@dataclass(frozen=True)
class LabelledMesh:
    """The mesh whose charts are flattened.

    mesh: a mesh in which each vertex has one fan of faces. label (f,): the chart of each face before merging. part
    (f,): the part of its chart; where a chart is cut, faces of one part stay together if possible.
    """

    adjacency: Adjacency
    mesh: QuadMesh
    label: np.ndarray
    part: np.ndarray


def flatten_all(
    mesh: QuadMesh,
    label: np.ndarray,
    limits: FlattenLimits,
    proxy: TriMesh | None = None,
    part: np.ndarray | None = None,
) -> tuple[list[Chart], list[str]]:
    """Flatten each chart of a mesh, label (f,) of its faces; return the charts and a sentence for each reason to cut.

    proxy: a coarse mesh of the surface, on which merging is tried. Without one nothing is merged, and charts are only
    projected to a plane and cut until all are flat. part (f,): see LabelledMesh.
    """
    adjacency = Adjacency(mesh)
    labelled = LabelledMesh(adjacency, one_vertex_per_fan(mesh), label, label if part is None else part)
    if proxy is None:
        flat = parameterize(labelled, _faces_by_label(label), limits, project_only=True)
        return flat.charts, flat.reasons()
    merged = label
    if time.monotonic() < limits.project_after:
        merged = merge_small_charts(labelled.mesh, label, proxy, limits.good_stretch)
    flat = parameterize(labelled, _faces_by_label(merged), limits, removes_overlaps=True)
    if time.monotonic() < limits.project_after:
        flat.removed = give_to_neighbours(adjacency, labelled.mesh, flat.charts, flat.removed, limits.good_stretch)
    flat.add(parameterize(labelled, [piece.faces_idx for piece in flat.removed], limits))
    if time.monotonic() < limits.project_after:
        _cut_most_stretched(labelled, flat, limits)
    return flat.charts, flat.reasons()


def parameterize(
    labelled: LabelledMesh,
    sets: list[np.ndarray],
    limits: FlattenLimits,
    *,
    removes_overlaps: bool = False,
    project_only: bool = False,
) -> ParameterizedCharts:
    """Flatten sets of faces, and cut those that do not lie flat.

    A set merged of several labels may stretch less than a set of one label. Where it stretches more, it is first split
    by label again. removes_overlaps: where little of a chart lies on other parts of it, only that is removed.
    project_only: flatten by projection to a plane alone.
    """
    flat, queue = ParameterizedCharts(), sets[::-1]
    while queue:
        faces_idx, now = queue.pop(), time.monotonic()
        if now > limits.single_after:
            flat.cut[_LATE] += len(faces_idx) > 1
            flat.charts += _one_chart_per_face(labelled.mesh, faces_idx)
            continue
        if now > limits.project_after:
            removes_overlaps, project_only = False, True
        labels = _faces_by_label(labelled.label[faces_idx])
        chart = chart_mesh(QuadMesh(labelled.mesh.vertices, labelled.mesh.faces[faces_idx]))
        corners, (triangles, face_idx) = chart.faces, chart.triangulation
        result = _flatten_set(chart.triangles, limits, is_merged=len(labels) > 1, project_only=project_only)
        uv = result.uv
        if uv is None and len(labels) > 1:  # flat together on the proxy, but not here
            queue.extend(faces_idx[part] for part in labels)
            continue
        if uv is None and len(faces_idx) == 1:
            uv = _square_or_triangle(chart.vertices, corners[0])
        if uv is not None:
            flat.charts.append(Chart(faces_idx, corners, uv, triangles))
            continue
        flat.cut[result.reason] += 1
        keep = None
        if removes_overlaps and result.overlapped is not None:
            keep = remove_overlaps(labelled.adjacency, faces_idx, triangles, face_idx, result.overlapped)
        if keep is None:
            queue.extend(_split_set(labelled.adjacency, labelled.part, faces_idx))
            continue
        connected = connected_masks(labelled.adjacency, faces_idx, keep)
        largest, *others = sorted(connected, key=np.count_nonzero, reverse=True)
        flat.charts.append(sub_chart(Chart(faces_idx, corners, result.overlapped, triangles), largest))
        home = int(flat.charts[-1].faces_idx[0])
        others += connected_masks(labelled.adjacency, faces_idx, ~keep)
        flat.removed += [OverlapPiece(home, faces_idx[mask]) for mask in others]
    return flat


def _flatten_set(mesh: TriMesh, limits: FlattenLimits, is_merged: bool, project_only: bool) -> FlattenResult:
    """Flatten one set of triangles: by projection alone, or within the stretch that a single or merged set may have."""
    if project_only:
        return FlattenResult(project_to_plane(mesh), "is not flat")
    max_stretch = merged_stretch_limit(limits.good_stretch) if is_merged else limits.max_stretch
    return flatten(TriMesh(mesh.vertices, mesh.faces.astype(np.int64)), limits.good_stretch, max_stretch)


def _stretch_excess(labelled: LabelledMesh, chart: Chart) -> float:
    """Compute a chart's area times the excess of its squared stretch over 1."""
    points = np.zeros((len(chart.uv), 3))
    used = chart.corners >= 0
    mesh = labelled.mesh
    points[chart.corners[used]] = mesh.vertices[mesh.faces[chart.faces_idx][used]]
    value = stretch(TriMesh(points, chart.triangles.astype(np.int64)), chart.uv) ** 2 - 1
    return float(labelled.adjacency.area[chart.faces_idx].sum()) * value if np.isfinite(value) else 0.0


def _cut_most_stretched(labelled: LabelledMesh, flat: ParameterizedCharts, limits: FlattenLimits) -> None:
    """Cut the charts that stretch most until all charts together stretch little enough; changes `flat`.

    The squared stretch of the whole is the mean of the charts' squared stretches by area, because each chart is at the
    scale of the surface.
    """
    max_cut = _MAX_CUT + int(_MAX_CUT_SHARE * len(flat.charts))
    allowed = ((1 + _MAX_TOTAL_EXCESS * (limits.good_stretch - 1)) ** 2 - 1) * float(labelled.adjacency.area.sum())
    values = [_stretch_excess(labelled, chart) for chart in flat.charts]
    total = sum(values)
    gone: set[int] = set()
    queue = [(-value, i) for i, value in enumerate(values) if value > 0 and len(flat.charts[i].faces_idx) > 1]
    heapq.heapify(queue)
    while total > allowed and len(gone) < max_cut and queue:
        # Cut at once all charts that have to be cut even if the parts of the worse ones do not stretch at all.
        worst: list[tuple[float, int]] = []
        rest = total
        while rest > allowed and len(gone) + len(worst) < max_cut and queue:
            worst.append(heapq.heappop(queue))
            rest += worst[-1][0]
        gone.update(i for _, i in worst)
        sets = [
            half for _, i in worst for half in _split_set(labelled.adjacency, labelled.part, flat.charts[i].faces_idx)
        ]
        halves = parameterize(labelled, sets, limits)
        values = [_stretch_excess(labelled, chart) for chart in halves.charts]
        total = rest + sum(values)
        for i, value in enumerate(values):
            if value > 0 and len(halves.charts[i].faces_idx) > 1:
                heapq.heappush(queue, (-value, len(flat.charts) + i))
        flat.add(halves)
        flat.cut["stretches more than most"] += len(worst)
    flat.charts = [chart for i, chart in enumerate(flat.charts) if i not in gone]


def _split_set(adjacency: Adjacency, part: np.ndarray, faces_idx: np.ndarray) -> list[np.ndarray]:
    """Split a chart's faces into two or more connected sets, along the borders of its parts where it has several.

    part (f,): the part of its chart that each face is in (Segmentation.part). Seams between parts begin and end at
    creases.
    """
    half, area = split_in_half(adjacency, faces_idx), adjacency.area[faces_idx]
    if half.all() or not half.any():
        half = np.arange(len(faces_idx)) < len(faces_idx) // 2
    place = np.unique(part[faces_idx], return_inverse=True)[1]
    share = np.bincount(place, area * half) / np.maximum(np.bincount(place, area), 1e-300)
    # Whole parts go to the side that has most of them; the clip leaves some on each side unless all shares are equal.
    whole = (share > np.clip(0.5, share.min(), np.nextafter(share.max(), 0)))[place]
    half = half if whole.all() else whole
    number = adjacency.connected_sets(faces_idx, half)
    return [faces_idx[number == n] for n in range(number.max() + 1)]


def _faces_by_label(label: np.ndarray) -> list[np.ndarray]:
    """List the indices of the faces of each label, in the order of the labels."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _one_chart_per_face(mesh: QuadMesh, faces_idx: np.ndarray) -> list[Chart]:
    """Make each of some faces (k,) a chart, projected along its normal.

    A face that folds this way becomes a square or right triangle of its size.
    """
    vertices, faces = mesh.vertices, mesh.faces
    own_faces = faces[faces_idx]
    corner = vertices[np.where(own_faces < 0, own_faces[:, :1], own_faces)]
    x = corner[:, 1] - corner[:, 0]
    x /= np.maximum(np.linalg.norm(x, axis=1), 1e-300)[:, None]
    y = np.cross(polygon_normals(QuadMesh(vertices, own_faces))[0], x)
    uv = np.stack([np.einsum("kcd,kd->kc", corner, x), np.einsum("kcd,kd->kc", corner, y)], -1)
    charts = []
    for face, used, flat, points in zip(faces_idx.tolist(), own_faces >= 0, uv, corner, strict=True):
        corners = np.where(used, np.arange(4), -1)[None]
        flat, triangles = flat[used], triangulated(corners)[0]
        if not is_unfolded(flat, triangles):
            flat = _square_or_triangle(points[used], corners[0])
        charts.append(Chart(np.array([face]), corners, flat, triangles))
    return charts


def _square_or_triangle(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Make a square or right triangle (c, 2) of the size of a face that has no area or folds."""
    used = corners[corners >= 0]
    size = max(float(np.ptp(points, 0).max()), 1e-6)
    uv = np.zeros((len(points), 2))
    uv[used] = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)[: len(used)] * size
    return uv
