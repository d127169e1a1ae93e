"""Unwrap a mesh of quads: find charts, flatten them, pack them; and measure the result."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from importlib import import_module
from typing import NamedTuple

import numpy as np

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.simplify import CHILD_MODULES, collapse_in_child
from gdtool.geometry.uv_raster import owner_count
from gdtool.unwrap.chart import Chart
from gdtool.unwrap.pack.search import WELL_PACKED, PlacementOrder, choose_cut, pack
from gdtool.unwrap.parameterize.flatten import singular_values, stretch
from gdtool.unwrap.parameterize.schedule import FlattenLimits, flatten_all
from gdtool.unwrap.segment.charts import Adjacency, Segmentation, find_charts, run_xatlas
from gdtool.unwrap.segment.straight_cuts import cut_to_pack

# Cutting for packing is tried with about this many charts more, and ends with at most this many.
_MORE_CHARTS, _MAX_CHARTS_TO_CUT = (5, 9, 13, 18, 23, 27), 43
_MIN_CHILD_SECONDS, _CHILD_MEMORY_MB = 0.05, 8000
_MIN_AREA_SHARE, _MIN_UV_AREA = 1e-12, 1e-14  # of the surface, of the square: triangles of less are degenerate
_UV_SLACK = 1e-6  # by which kept texture coordinates may leave the unit square: rounding
# Shares of what is covered, and of the triangles, up to which a mesh's own texture coordinates are kept.
_MAX_KEPT_OVERLAP, _MAX_KEPT_DEGENERATE = 0.001, 0.01
_MAX_ANISOTROPY = 100  # ratio of singular values that one triangle counts as at most


@dataclass(frozen=True)
class Request:
    """The caller's request.

    size: texels of the texture's side; padding: texels between charts at that size; max_stretch: L2 stretch beyond
    which a chart is cut; good_stretch: L2 stretch at which flattening stops; max_cost: xatlas' limit on a chart's cost;
    seconds: time limit.
    """

    size: int = 2048
    padding: int = 8
    max_stretch: float = 1.1
    good_stretch: float = 1.002
    max_cost: float = 2.0
    seconds: float = 120.0


class _Deadlines(NamedTuple):
    """The time at which each step has to end, on the clock time.monotonic."""

    charts_found: float
    shaped: float  # from here on charts are only projected
    projected: float  # from here on each face becomes a chart
    child_killed: float
    packed: float


_DEADLINE_SHARES = _Deadlines(0.2, 0.6, 0.7, 0.8, 0.9)  # of the time limit


class Skipped(NamedTuple):
    """Work that was not done, the reason, and the seconds it would have taken."""

    what: str
    why: str
    seconds: float


@dataclass
class UnwrapResult:
    """Texture coordinates of a mesh.

    uv (c, 2) in [0, 1], (0, 0) at the image's top left; face_uvs (f, 4) rows of uv, -1 for a triangle's fourth corner;
    chart (f,): the chart of each face; failed: sentences on what was tried and failed.
    """

    uv: np.ndarray
    face_uvs: np.ndarray
    chart: np.ndarray
    failed: list[str] = field(default_factory=list)
    skipped: list[Skipped] = field(default_factory=list)


def unwrap(mesh: QuadMesh, request: Request) -> UnwrapResult:
    """Make texture coordinates for a mesh with finite vertices; a quad lies in one chart.

    Charts are never mirrored and do not overlap; all have one texel density. As the time runs out, simpler methods are
    used: charts by the side of a box that faces look at, flattened by projection; then each face as a chart; packing in
    rows.
    """
    vertices, faces = mesh.vertices, mesh.faces
    started = time.monotonic()
    deadlines = _Deadlines(*(started + share * request.seconds for share in _DEADLINE_SHARES))
    prepare(collapse_in_child, CHILD_MODULES)
    extent = float(np.ptp(vertices[np.unique(faces[faces >= 0])], 0).max())
    unit = QuadMesh((vertices - vertices.mean(0)) / (extent if extent > 0 else 1.0), faces)

    @cache
    def adjacency() -> Adjacency:  # first asked for while a child simplifies the mesh
        prepare(run_xatlas)
        prepare(flatten_all, (*CHILD_MODULES, "igl"))
        return Adjacency(unit)

    segmentation = find_charts(adjacency, unit, until=deadlines.charts_found, max_cost=request.max_cost)
    charts, failed = _flatten_in_child(unit, segmentation, request, deadlines)
    failed = segmentation.failed + failed
    gap = request.padding / request.size
    orders: list[PlacementOrder] = []
    skipped: list[Skipped] = []
    if time.monotonic() < deadlines.packed:
        charts, orders, skipped = _cut_for_packing(adjacency(), charts, gap, deadlines.packed)
    placed, _ = pack([(chart.uv, chart.triangles) for chart in charts], gap, orders, deadlines.packed)
    face_uvs = np.full(faces.shape, -1, np.int64)
    chart_of_face = np.zeros(len(faces), np.int64)
    offset = 0
    for i, (chart, uv) in enumerate(zip(charts, placed, strict=True)):
        face_uvs[chart.faces_idx] = np.where(chart.corners >= 0, chart.corners + offset, -1)
        chart_of_face[chart.faces_idx] = i
        offset += len(uv)
    uv = np.concatenate(placed)
    top_down = np.clip(np.stack([uv[:, 0], 1 - uv[:, 1]], -1), 0, 1)
    return UnwrapResult(top_down, face_uvs.astype(np.int32), chart_of_face, failed, skipped)


def _flatten_in_child(
    mesh: QuadMesh, segmentation: Segmentation, request: Request, deadlines: _Deadlines
) -> tuple[list[Chart], list[str]]:
    """Flatten the charts in a child process; where that fails, flatten them here by projection alone."""
    limits = FlattenLimits(request.good_stretch, request.max_stretch, deadlines.shaped, deadlines.projected)
    try:
        child = begin(
            flatten_all,
            mesh,
            segmentation.label,
            limits,
            segmentation.proxy,
            segmentation.part,
            seconds=max(deadlines.child_killed - time.monotonic(), _MIN_CHILD_SECONDS),
            memory_mb=_CHILD_MEMORY_MB,
        )
        import_module("scipy.spatial")  # which packing needs, while the child works
        return child.result()
    except ChildFailed as failure:
        until = time.monotonic() + deadlines.projected - deadlines.shaped
        charts, reasons = flatten_all(mesh, segmentation.label, replace(limits, single_after=until))
        return charts, [f"flattening: {failure}; charts are made by the side of a box that faces look at", *reasons]


def _cut_for_packing(
    adjacency: Adjacency, charts: list[Chart], gap: float, until: float
) -> tuple[list[Chart], list[PlacementOrder], list[Skipped]]:
    """Cut the charts further where that fills the square better.

    gap: between charts, in uv. Returns the charts, the orders found in which to pack them, and what was skipped.
    """
    counts = [len(charts) + more for more in _MORE_CHARTS if len(charts) + more <= _MAX_CHARTS_TO_CUT]
    tried, start = [charts], time.monotonic()

    def variants() -> Iterator[list[tuple[np.ndarray, np.ndarray]]]:
        yield [(chart.uv, chart.triangles) for chart in charts]
        for cut_charts in counts and cut_to_pack(adjacency, charts, counts):
            if time.monotonic() > until:
                return
            tried.append(cut_charts)
            yield [(chart.uv, chart.triangles) for chart in cut_charts]

    best = choose_cut(variants(), gap)
    skipped, took = [], time.monotonic() - start
    if best.skipped:
        skipped.append(
            Skipped(
                f"packing {best.skipped} sets of charts that are cut further",
                "the sets before them filled too little of the square",
                best.skipped * took / (len(tried) - best.skipped),
            )
        )
    if best.share > WELL_PACKED and len(tried) <= len(counts):
        skipped.append(Skipped("cutting further for packing", f"the charts fill {best.share:.0%} of the square", took))
    return tried[best.number], best.orders, skipped


def figures(mesh: QuadMesh, size: int = 1024) -> dict[str, float | int]:
    """Measure a mesh's texture coordinates: charts, coverage, overlap, stretch, distortion, mirroring and seams.

    size: texels of the raster for coverage and overlap. Stretch is L2; mirrored and overlap are shares of area; seam
    length is in diagonals of the bounding box, each seam counted once.
    """
    (uv, face_uvs), (triangles, face_idx) = mesh.texture_coordinates(), mesh.triangulation
    corners = corner_triangles(face_uvs, face_idx)
    # A mesh with one vertex for each texture corner, so that the two sides of a seam are measured apart.
    points = np.zeros((len(uv), 3))
    points[corners.ravel()] = mesh.vertices[triangles.ravel()]
    upward = np.stack([uv[:, 0], 1 - uv[:, 1]], -1)
    values, area = singular_values(TriMesh(points, corners), upward)
    a, b, c = (upward[corners[:, i]] for i in range(3))
    flat = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    use = (area > _MIN_AREA_SHARE * area.sum()) & (np.abs(flat) > _MIN_UV_AREA)
    weight = area[use] / area[use].sum()
    ratio = np.abs(flat[use]) / np.abs(flat[use]).sum() / weight
    count = owner_count(uv, corners, size)
    label, seam = uv_islands(mesh)
    return {
        "charts": int(label.max()) + 1,
        "coverage": float((count > 0).mean()),
        "overlap": float((count > 1).sum() / max((count > 0).sum(), 1)),
        "stretch": stretch(TriMesh(points, corners), upward),
        "area_distortion": float((weight * np.maximum(ratio, 1 / ratio)).sum()),
        "angle_distortion": float(
            (weight * np.minimum(values[use, 0] / np.maximum(values[use, 1], 1e-12), _MAX_ANISOTROPY)).sum()
        ),
        "mirrored": float(area[flat < 0].sum() / area.sum()),
        "degenerate": float(1 - use.mean()),
        "seam_length": seam / float(np.linalg.norm(np.ptp(mesh.vertices, 0))),
    }


def corner_triangles(face_uvs: np.ndarray, face_idx: np.ndarray) -> np.ndarray:
    """Cut texture corners (f, 4) into those (t, 3) of the triangles that triangulated() makes of the faces.

    face_idx (t,): the face of each triangle.
    """
    second = np.zeros(len(face_idx), bool)
    second[1:] = face_idx[1:] == face_idx[:-1]
    return np.take_along_axis(face_uvs[face_idx], np.where(second[:, None], [0, 2, 3], [0, 1, 2]), 1).astype(np.int64)


def uv_islands(mesh: QuadMesh) -> tuple[np.ndarray, float]:
    """Find the chart (f,) of each face, and the length of all seams.

    Faces are in one chart where their shared edge has the same texture corners on both sides.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    from gdtool.geometry.topology import edges_of

    vertices, edges = mesh.vertices, edges_of(mesh.faces)
    order = edges.order
    edge_idx, pairs = edges.face_pairs()
    first = (np.cumsum(edges.count) - edges.count)[edge_idx]
    ends_uv = edges_of(mesh.texture_coordinates()[1]).half_ends  # in the same order of corners
    first_uv, second_uv = ends_uv[order[first]], ends_uv[order[first + 1]]
    backward = edges.half_ends[order[first]][:, 0] != edges.half_ends[order[first + 1]][:, 0]
    second_uv = np.where(backward[:, None], second_uv[:, ::-1], second_uv)
    joined = (first_uv == second_uv).all(1)
    count = len(mesh.faces)
    graph = coo_matrix((np.ones(int(joined.sum())), (pairs[joined, 0], pairs[joined, 1])), (count, count))
    ends = edges.ends[edge_idx[~joined]]
    return connected_components(graph, False)[1], float(
        np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1).sum()
    )


def invalid_reason(mesh: QuadMesh) -> str | None:
    """Return why the texture coordinates of a mesh cannot be kept, None where they can."""
    uv, _ = mesh.texture_coordinates()
    if not np.isfinite(uv).all():
        return "some are not finite"
    if uv.min() < -_UV_SLACK or uv.max() > 1 + _UV_SLACK:
        return "some lie outside the unit square"
    measured = figures(mesh)
    if measured["overlap"] > _MAX_KEPT_OVERLAP:
        return f"they overlap on {100 * measured['overlap']:.1f} % of what they cover"
    if measured["degenerate"] > _MAX_KEPT_DEGENERATE:
        return f"{100 * measured['degenerate']:.1f} % of the faces have no area there"
    return None


def texels_per_unit(mesh: QuadMesh, size: int) -> float:
    """Compute the texel density: texels, of a texture of `size`, per unit of the surface."""
    uv, face_uvs = mesh.texture_coordinates()
    flat = np.concatenate([uv, np.zeros((len(uv), 1))], 1)
    area = polygon_normals(mesh)[1].sum()
    return float(size * (polygon_normals(QuadMesh(flat, face_uvs))[1].sum() / area) ** 0.5)


def padding_for_mips(size: int, smallest_mip: int) -> int:
    """Compute the texels between charts at `size` that leave one texel at the mip level of size `smallest_mip`."""
    return max(-(-size // min(smallest_mip, size)), 1)
