"""Texture coordinates for a mesh of quads: charts, laid flat, packed; and the figures that tell how good they are."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module

import numpy as np

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.geometry.simplify import CHILD_MODULES, reduced
from gdtool.geometry.topology import triangulated
from gdtool.geometry.uv_raster import owner_count
from gdtool.unwrap.pack.search import WELL_PACKED, best_packed, pack
from gdtool.unwrap.parameterize.flatten import singular_values, stretch
from gdtool.unwrap.parameterize.schedule import flatten_all
from gdtool.unwrap.segment.charts import Adjacency, find_charts, run_xatlas
from gdtool.unwrap.segment.straight_cuts import cut_to_pack

# Charts that cutting for packing adds, about, and ends with, at most.
_MORE_CHARTS, _MOST_CUT = (5, 9, 13, 18, 23, 27), 43
# Shares of the time by which charts are found, shaped, projected, a child that has not ended is given up, and charts
# are packed.
_SHARES = 0.2, 0.6, 0.7, 0.8, 0.9
_SHORTEST = 0.05  # seconds of a child


@dataclass(frozen=True)
class Request:
    """What is asked for. padding: texels between charts at `size`; seconds: time limit of the whole."""

    size: int = 2048
    padding: int = 8
    max_stretch: float = 1.1
    good_stretch: float = 1.002
    max_cost: float = 2.0
    seconds: float = 120.0


@dataclass
class Unwrapped:
    """uv (c, 2) in [0, 1], (0, 0) at the image's top left; face_uvs (f, 4) into it, -1 with a triangle's fourth corner;
    chart (f,); what was tried and failed on the way; what was skipped, why, and the seconds that it would have
    taken."""

    uv: np.ndarray
    face_uvs: np.ndarray
    chart: np.ndarray
    failed: list[str] = field(default_factory=list)
    skipped: list[tuple[str, str, float]] = field(default_factory=list)


def unwrap(vertices: np.ndarray, faces: np.ndarray, request: Request) -> Unwrapped:
    """Texture coordinates of quads and triangles faces (f, 4); a quad lies in one chart, its corners flat together.

    vertices (v, 3) finite. Charts are never mirrored and do not overlap; all have one texel density. As the time runs
    out the rest goes in simpler ways: charts by the side of a box that they look at, laid flat by projection, at last
    face by face, in rows."""
    begun = time.monotonic()
    found_by, shaped_by, projected_by, hung_by, packed_by = (begun + share * request.seconds for share in _SHARES)
    prepare(reduced, CHILD_MODULES)
    extent = float(np.ptp(vertices[np.unique(faces[faces >= 0])], 0).max())
    unit = (vertices - vertices.mean(0)) / (extent if extent > 0 else 1.0)

    @cache
    def adjacency() -> Adjacency:  # asked for first while a child simplifies the mesh
        prepare(run_xatlas)
        prepare(flatten_all, (*CHILD_MODULES, "igl"))
        return Adjacency(unit, faces)

    label, part, proxy, failed = find_charts(adjacency, unit, faces, until=found_by, max_cost=request.max_cost)
    try:
        child = begin(
            flatten_all,
            unit,
            faces,
            label,
            request.good_stretch,
            request.max_stretch,
            proxy,
            (shaped_by, projected_by),
            part,
            seconds=max(hung_by - time.monotonic(), _SHORTEST),
            memory_mb=8000,
        )
        import_module("scipy.spatial")  # packing would wait for it
        flat, more = child.result()
    except ChildFailed as failure:
        late = time.monotonic() + projected_by - shaped_by
        flat, more = flatten_all(unit, faces, label, request.good_stretch, request.max_stretch, by=(shaped_by, late))
        failed.append(f"flattening: {failure}; charts by the side they look at")
    failed += more
    ways, skipped = [], []
    if time.monotonic() < packed_by:
        flat, ways, skipped = _cut_to_pack(adjacency(), flat, request.padding / request.size, packed_by)
    places, _ = pack([(uv, triangles) for _, _, uv, triangles in flat], request.padding / request.size, ways, packed_by)
    face_uvs = np.full(faces.shape, -1, np.int64)
    chart = np.zeros(len(faces), np.int64)
    offset = 0
    for i, ((faces_idx, corners, _, _), uv) in enumerate(zip(flat, places, strict=True)):
        face_uvs[faces_idx] = np.where(corners >= 0, corners + offset, -1)
        chart[faces_idx] = i
        offset += len(uv)
    uv = np.concatenate(places)
    return Unwrapped(
        np.clip(np.stack([uv[:, 0], 1 - uv[:, 1]], -1), 0, 1), face_uvs.astype(np.int32), chart, failed, skipped
    )


def _cut_to_pack(
    adjacency: Adjacency, flat: list, gap: float, until: float
) -> tuple[list, list, list[tuple[str, str, float]]]:
    """The charts, cut further where that fills the square better; orders to pack them in that were found on the way;
    what was skipped."""
    counts = [len(flat) + more for more in _MORE_CHARTS if len(flat) + more <= _MOST_CUT]
    tried, start = [flat], time.monotonic()

    def variants() -> Iterator[list]:
        yield [(uv, triangles) for _, _, uv, triangles in flat]
        for charts in counts and cut_to_pack(adjacency, flat, counts):
            if time.monotonic() > until:
                return
            tried.append(charts)
            yield [(uv, triangles) for _, _, uv, triangles in charts]

    chosen, share, ways, leapt = best_packed(variants(), gap)
    skipped, took = [], time.monotonic() - start
    if leapt:
        skipped.append(
            (
                f"packing {leapt} ways to cut",
                "the charts before filled too little of the square",
                leapt * took / (len(tried) - leapt),
            )
        )
    if share > WELL_PACKED and len(tried) <= len(counts):
        skipped.append(("cutting further for packing", f"the charts fill {share:.0%} of the square", took))
    return tried[chosen], ways, skipped


def figures(
    vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, face_uvs: np.ndarray, size: int = 1024
) -> dict[str, float | int]:
    """Charts, coverage and overlap of the unit square, L2 stretch, angle and area distortion, mirrored share, seam
    length.

    Mirrored and overlap are shares of area; seam length is in diagonals of the bounding box, each seam counted once.
    """
    triangles, face_idx = triangulated(faces)
    corners = corner_triangles(face_uvs, face_idx)
    # One mesh whose vertices are the texture corners, so that singular values see both sides of a seam apart.
    points = np.zeros((len(uv), 3))
    points[corners.ravel()] = vertices[triangles.ravel()]
    upward = np.stack([uv[:, 0], 1 - uv[:, 1]], -1)
    values, area = singular_values(points, corners, upward)
    a, b, c = (upward[corners[:, i]] for i in range(3))
    flat = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    use = (area > 1e-12 * area.sum()) & (np.abs(flat) > 1e-14)
    weight = area[use] / area[use].sum()
    ratio = np.abs(flat[use]) / np.abs(flat[use]).sum() / weight
    count = owner_count(uv, corners, size)
    label, seam = islands(vertices, faces, face_uvs)
    return {
        "charts": int(label.max()) + 1,
        "coverage": float((count > 0).mean()),
        "overlap": float((count > 1).sum() / max((count > 0).sum(), 1)),
        "stretch": stretch(points, corners, upward),
        "area_distortion": float((weight * np.maximum(ratio, 1 / ratio)).sum()),
        "angle_distortion": float((weight * np.minimum(values[use, 0] / np.maximum(values[use, 1], 1e-12), 100)).sum()),
        "mirrored": float(area[flat < 0].sum() / area.sum()),
        "degenerate": float(1 - use.mean()),
        "seam_length": seam / float(np.linalg.norm(np.ptp(vertices, 0))),
    }


def corner_triangles(face_uvs: np.ndarray, face_idx: np.ndarray) -> np.ndarray:
    """Texture corners (t, 3) of the triangles that triangulated() cuts the faces into."""
    second = np.zeros(len(face_idx), bool)
    second[1:] = face_idx[1:] == face_idx[:-1]
    return np.take_along_axis(face_uvs[face_idx], np.where(second[:, None], [0, 2, 3], [0, 1, 2]), 1).astype(np.int64)


def islands(vertices: np.ndarray, faces: np.ndarray, face_uvs: np.ndarray) -> tuple[np.ndarray, float]:
    """The chart (f,) of each face, joined wherever an edge has the same texture corners on both sides, and the length
    of the edges that have not."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    from gdtool.geometry.topology import edges_of

    edges = edges_of(faces)
    order = edges.order
    edge_idx, pairs = edges.face_pairs()
    first = (np.cumsum(edges.count) - edges.count)[edge_idx]
    ends_uv = edges_of(face_uvs).half_ends  # in the same order of corners
    one, two = ends_uv[order[first]], ends_uv[order[first + 1]]
    backward = edges.half_ends[order[first]][:, 0] != edges.half_ends[order[first + 1]][:, 0]
    two = np.where(backward[:, None], two[:, ::-1], two)
    joined = (one == two).all(1)
    graph = coo_matrix((np.ones(int(joined.sum())), (pairs[joined, 0], pairs[joined, 1])), (len(faces), len(faces)))
    ends = edges.ends[edge_idx[~joined]]
    return connected_components(graph, False)[1], float(
        np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1).sum()
    )
