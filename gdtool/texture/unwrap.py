"""Texture coordinates for a mesh of quads: charts, laid flat, packed; and the figures that tell how good they are."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from gdtool.core.child import ChildFailed, call, prepare
from gdtool.folders.mesh import triangulated
from gdtool.texture.raster import owner_count
from gdtool.texture.unwrap_charts import Adjacency, bisect, find_charts, own_corners
from gdtool.texture.unwrap_cut import connected, cut_to_pack, part_of
from gdtool.texture.unwrap_flatten import Flat, flatten, singular_values, stretch
from gdtool.texture.unwrap_join import joined, joined_stretch
from gdtool.texture.unwrap_pack import WELL_PACKED, best_packed, pack
from gdtool.texture.unwrap_peel import onto_neighbours, peel

_MORE_CHARTS, _MORE_OF_RINGS, _MOST_CUT = 12, 23, 40  # charts that cutting for packing adds, where it cuts rings, and ends with, at most


@dataclass(frozen=True)
class Request:
    """What is asked for. padding: texels between charts at `size`; seconds: limit of each native run."""

    size: int = 2048
    padding: int = 8
    max_stretch: float = 1.1
    good_stretch: float = 1.002
    max_cost: float = 2.0
    seconds: float = 120.0


@dataclass
class Unwrapped:
    """uv (c, 2) in [0, 1], (0, 0) at the image's top left; face_uvs (f, 4) into it, -1 with a triangle's fourth corner;
    chart (f,); what failed on the way."""

    uv: np.ndarray
    face_uvs: np.ndarray
    chart: np.ndarray
    failed: list[str] = field(default_factory=list)


def unwrap(vertices: np.ndarray, faces: np.ndarray, request: Request) -> Unwrapped:
    """Texture coordinates of quads and triangles faces (f, 4); a quad lies in one chart, its corners flat together.

    vertices (v, 3) finite. Charts are never mirrored and do not overlap; all have one texel density.
    """
    for module in ("gdtool.geometry.simplify", "gdtool.texture.unwrap_charts", "gdtool.texture.unwrap"):
        prepare(module)
    extent = float(np.ptp(vertices[np.unique(faces[faces >= 0])], 0).max())
    unit = (vertices - vertices.mean(0)) / (extent if extent > 0 else 1.0)
    label, proxy, failed = find_charts(unit, faces, seconds=request.seconds, max_cost=request.max_cost)
    try:
        flat, more = call("gdtool.texture.unwrap:flatten_all", unit, faces, label, request.good_stretch, request.max_stretch, proxy,
                          seconds=request.seconds, memory_mb=8000)
    except ChildFailed as failure:
        flat, more = flatten_all(unit, faces, label, request.good_stretch, request.max_stretch)
        failed.append(f"flattening: {failure}; charts by the side they look at")
    failed += more
    flat, ways = _cut_to_pack(Adjacency(unit, faces), flat, request.padding / request.size)
    places, _ = pack([(uv, triangles) for _, _, uv, triangles in flat], request.padding / request.size, ways)
    face_uvs = np.full(faces.shape, -1, np.int64)
    chart = np.zeros(len(faces), np.int64)
    offset = 0
    for i, ((faces_idx, corners, _, _), uv) in enumerate(zip(flat, places, strict=True)):
        face_uvs[faces_idx] = np.where(corners >= 0, corners + offset, -1)
        chart[faces_idx] = i
        offset += len(uv)
    uv = np.concatenate(places)
    return Unwrapped(np.clip(np.stack([uv[:, 0], 1 - uv[:, 1]], -1), 0, 1), face_uvs.astype(np.int32), chart, failed)


def _cut_to_pack(adjacency: Adjacency, flat: list, gap: float) -> tuple[list, list]:
    """The charts, cut further where that fills the square better, rings into arcs where it stays badly filled, and the ways
    to pack them that were found on the way."""
    best, share, seen, ways = flat, 0.0, {len(flat)}, []
    for more, rings in ((_MORE_CHARTS, False), (_MORE_OF_RINGS, True)):
        if share > WELL_PACKED:
            break
        other = cut_to_pack(adjacency, flat, min(len(flat) + more, _MOST_CUT), rings)
        if len(other) not in seen:
            seen.add(len(other))
            chosen, share, ways = best_packed([[(uv, triangles) for _, _, uv, triangles in one] for one in (best, other)], gap)
            best = (best, other)[chosen]
    return best, ways


def flatten_all(vertices: np.ndarray, faces: np.ndarray, label: np.ndarray, good_stretch: float, max_stretch: float,
                proxy: tuple[np.ndarray, np.ndarray] | None = None) -> tuple[list, list[str]]:
    """Each chart flat, small ones joined, those that overlap themselves peeled, cut further where it has to be.

    List of (faces_idx, corners (k, 4), uv (c, 2) v up, triangles), corners into uv, and what was cut. proxy, vertices and
    triangles: a coarse mesh of the surface, on which joining is tried. Without one nothing is joined and charts are laid flat by
    projection alone, cut until that works.
    """
    from gdtool.texture.unwrap_flatten import _plane

    adjacency = Adjacency(vertices, faces)
    charts: list[tuple] = []
    cut: Counter[str] = Counter()

    def lay(queue: list[np.ndarray], peeling: bool) -> list[np.ndarray]:
        """Sets of faces laid flat, the last first; what was taken off those that overlapped themselves."""
        off: list[np.ndarray] = []
        while queue:
            faces_idx = queue.pop()
            parts = _sets(label[faces_idx])
            points, corners = own_corners(vertices, faces[faces_idx])
            triangles, face_idx = triangulated(corners)
            if proxy is None:
                flat = Flat(_plane(points, triangles), "is not flat")
            else:
                flat = flatten(points, triangles.astype(np.int64), good_stretch, max_stretch if len(parts) == 1 else joined_stretch(good_stretch))
            uv = flat.uv
            if uv is None and len(parts) > 1:  # joined on the proxy, and do not lie flat together here
                queue.extend(faces_idx[part] for part in parts)
                continue
            if uv is None and len(faces_idx) == 1:
                uv = _alone(points, corners[0])
            if uv is not None:
                charts.append((faces_idx, corners, uv, triangles))
                continue
            cut[flat.reason] += 1
            keep = peel(adjacency, faces_idx, triangles, face_idx, flat) if peeling and flat.on_others is not None else None
            if keep is not None:
                largest, *others = sorted(connected(adjacency, faces_idx, keep), key=np.count_nonzero, reverse=True)
                charts.append(part_of((faces_idx, corners, flat.overlapped, triangles), largest))
                off += [faces_idx[part] for part in others + connected(adjacency, faces_idx, ~keep)]
                continue
            half = bisect(adjacency, faces_idx)
            if half.all() or not half.any():
                half = np.arange(len(faces_idx)) < len(faces_idx) // 2
            queue.extend(faces_idx[part] for side in (half, ~half) for part in connected(adjacency, faces_idx, side))
        return off

    off = lay(_sets(label if proxy is None else joined(vertices, faces, label, *proxy, good_stretch))[::-1], peeling=True)
    lay(onto_neighbours(adjacency, vertices, faces, charts, off, good_stretch), peeling=False)
    return charts, [f"{count} charts were cut: a chart {reason}" for reason, count in cut.items()]


def _sets(label: np.ndarray) -> list[np.ndarray]:
    """The places of each label, in the labels' order."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _alone(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """One face on its own that will not lie flat (no area, or folded): a square or right triangle of its size."""
    used = corners[corners >= 0]
    size = max(float(np.ptp(points, 0).max()), 1e-6)
    uv = np.zeros((len(points), 2))
    uv[used] = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)[:len(used)] * size
    return uv


def figures(vertices: np.ndarray, faces: np.ndarray, uv: np.ndarray, face_uvs: np.ndarray, size: int = 1024) -> dict[str, float | int]:
    """Charts, coverage and overlap of the unit square, L2 stretch, angle and area distortion, mirrored share, seam length.

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
        "charts": int(label.max()) + 1, "coverage": float((count > 0).mean()), "overlap": float((count > 1).sum() / max((count > 0).sum(), 1)),
        "stretch": stretch(points, corners, upward), "area_distortion": float((weight * np.maximum(ratio, 1 / ratio)).sum()),
        "angle_distortion": float((weight * np.minimum(values[use, 0] / np.maximum(values[use, 1], 1e-12), 100)).sum()),
        "mirrored": float(area[flat < 0].sum() / area.sum()), "degenerate": float(1 - use.mean()),
        "seam_length": seam / float(np.linalg.norm(np.ptp(vertices, 0))),
    }


def corner_triangles(face_uvs: np.ndarray, face_idx: np.ndarray) -> np.ndarray:
    """Texture corners (t, 3) of the triangles that triangulated() cuts the faces into."""
    second = np.zeros(len(face_idx), bool)
    second[1:] = face_idx[1:] == face_idx[:-1]
    return np.take_along_axis(face_uvs[face_idx], np.where(second[:, None], [0, 2, 3], [0, 1, 2]), 1).astype(np.int64)


def islands(vertices: np.ndarray, faces: np.ndarray, face_uvs: np.ndarray) -> tuple[np.ndarray, float]:
    """The chart (f,) of each face, joined wherever an edge has the same texture corners on both sides, and the length of
    the edges that have not."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    from gdtool.geometry.repair import edges_of

    edges = edges_of(faces)
    order = edges.order
    edge_idx, pairs = edges.face_pairs()
    first = (np.cumsum(edges.count) - edges.count)[edge_idx]
    ends_uv = edges_of(face_uvs).half_ends  # in the same order of corners
    one, two = ends_uv[order[first]], ends_uv[order[first + 1]]
    backward = (edges.half_ends[order[first]][:, 0] != edges.half_ends[order[first + 1]][:, 0])
    two = np.where(backward[:, None], two[:, ::-1], two)
    joined = (one == two).all(1)
    graph = coo_matrix((np.ones(int(joined.sum())), (pairs[joined, 0], pairs[joined, 1])), (len(faces), len(faces)))
    ends = edges.ends[edge_idx[~joined]]
    return connected_components(graph, False)[1], float(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1).sum())
