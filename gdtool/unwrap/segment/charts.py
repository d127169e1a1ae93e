"""Segment a quad mesh into charts.

xatlas runs on a simplified proxy. Its charts are transferred to the quads, and their borders smoothed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gdtool.core.child import ChildFailed, call
from gdtool.core.native import imported
from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.meshes import Mesh, QuadMesh, TriMesh
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.geometry.topology import edges_of

_PROXY_TRIANGLES = 6000  # xatlas' time grows faster than the triangles; this many show where charts end
_CREASE_DEGREES = 30.0  # edges that turn by more are creases ...
_CREASE_COST = 0.1  # ... where a seam costs this share of its length
_MIN_CHILD_SECONDS, _CHILD_MEMORY_MB = 0.05, 8000
_MIN_CHART_SHARE = 0.003  # of the area: a smaller chart merges with a neighbour if it has one
_MIN_CHART_FACES = 8  # so does a chart of fewer faces, or of one in 64 of a small mesh
# Bonus in a face's vote for the label that it has, in typical edge costs: its first label, and one that it took on.
_FIRST_BONUS, _LATER_BONUS = 0.4, 0.1
_MAX_MERGES = 20  # rounds of merging small charts
_CREASE_FACTOR = 5.0  # times longer is the way across a crease, so that halves part there


def run_xatlas(mesh: TriMesh, max_cost: float) -> np.ndarray:
    """Find the chart (t,) of each triangle by xatlas, -1 for triangles that it drops.

    Runs in a child process, because xatlas can hang. max_cost: xatlas' limit on a chart's cost.
    """
    vertices, triangles = mesh.vertices, mesh.faces
    xatlas = imported("xatlas")
    charts = xatlas.ChartOptions()
    charts.max_cost = max_cost
    pack = xatlas.PackOptions()
    pack.resolution = 16  # the atlas is not used
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(triangles, np.uint32))
    atlas.generate(charts, pack)
    out = np.full(len(triangles), -1, np.int64)
    for i in range(atlas.get_mesh_chart_count(0)):
        out[np.asarray(atlas.get_mesh_chart(0, i).faces, np.int64)] = i
    return out


class Adjacency:
    """Pairs of faces that share an edge, and the cost of a seam along that edge.

    pairs (k, 2); cost (k,): the edge's length, a tenth of it on creases; crease (k,) bool; ends (k, 2) the edge's
    vertices. area (f,) and normals (f, 3) of the faces; count: the number of faces.
    """

    def __init__(self, mesh: QuadMesh):
        vertices, faces = mesh.vertices, mesh.faces
        edges = edges_of(faces)
        edge_idx, self.pairs = edges.face_pairs()
        self.ends = edges.ends[edge_idx]
        normals, self.area = polygon_normals(mesh)
        cosine = (normals[self.pairs[:, 0]] * normals[self.pairs[:, 1]]).sum(1)
        length = np.linalg.norm(vertices[self.ends[:, 0]] - vertices[self.ends[:, 1]], axis=1)
        self.crease = cosine < np.cos(np.radians(_CREASE_DEGREES))
        self.cost = length * np.where(self.crease, _CREASE_COST, 1.0) + 1e-12
        self.normals, self.count = normals, len(faces)
        # A chart cannot continue across an edge that its two faces traverse in the same direction (a flipped face).
        rotated_masks = edges.turned[edge_idx]
        order = np.argsort(self.pairs[~rotated_masks][:, 0], kind="stable")
        self.pairs, self.cost, self.crease, self.ends = (
            x[~rotated_masks][order] for x in (self.pairs, self.cost, self.crease, self.ends)
        )
        self._begin = np.searchsorted(self.pairs[:, 0], np.arange(self.count + 1))

    def within(self, faces_idx: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the rows (r,) of pairs whose faces are both among faces_idx (k,), and their indices (r, 2) in it."""
        first, number = self._begin[faces_idx], self._begin[faces_idx + 1] - self._begin[faces_idx]
        rows = np.repeat(first - np.cumsum(number) + number, number) + np.arange(number.sum())
        place = np.full(self.count, -1)
        place[faces_idx] = np.arange(len(faces_idx))
        pairs = place[self.pairs[rows]]
        inside = (pairs >= 0).all(1)
        return rows[inside], pairs[inside]

    def connected_sets(self, faces_idx: np.ndarray, side: np.ndarray | None = None) -> np.ndarray:
        """Find the connected set (k,), numbered from 0 on, that each of faces_idx (k,) belongs to.

        side (k,): faces of different sides are not connected.
        """
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        _, pairs = self.within(faces_idx)
        if side is not None:
            pairs = pairs[side[pairs[:, 0]] == side[pairs[:, 1]]]
        return connected_components(
            coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(faces_idx),) * 2), False
        )[1]

    def connected_labels(self, label: np.ndarray) -> np.ndarray:
        """Split labels (f,) until the faces of each label are connected."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        same = label[self.pairs[:, 0]] == label[self.pairs[:, 1]]
        pairs = self.pairs[same]
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (self.count, self.count))
        return connected_components(graph, False)[1].astype(np.int64)

    def votes(self, label: np.ndarray, bonus: np.ndarray | float) -> np.ndarray:
        """Find for each face the label (f,) around it whose shared edges would cost most to cut.

        bonus (f,): added to the label that the face has.
        """
        # Faces inside a label would vote for it, so only those at a border are counted.
        apart = label[self.pairs[:, 0]] != label[self.pairs[:, 1]]
        border = np.zeros(self.count, bool)
        border[self.pairs[apart].ravel()] = True
        faces_idx = np.flatnonzero(border)
        near = border[self.pairs]
        face = np.concatenate([self.pairs[near[:, 0], 0], self.pairs[near[:, 1], 1], faces_idx])
        vote = np.concatenate([label[self.pairs[near[:, 0], 1]], label[self.pairs[near[:, 1], 0]], label[faces_idx]])
        weight = np.concatenate(
            [self.cost[near[:, 0]], self.cost[near[:, 1]], np.broadcast_to(bonus, self.count)[faces_idx]]
        )
        width = int(label.max()) + 1
        key, inverse = np.unique(face * width + vote, return_inverse=True)
        total = np.bincount(inverse.ravel(), weight)
        order = np.lexsort((total, key // width))
        out = label.copy()
        out[key[order] // width] = key[order] % width  # of several assignments to one element the last one stays
        return out


class Segmentation(NamedTuple):
    """Charts of a mesh.

    label (f,): the connected chart of each face; part (f,): the part of its chart, along whose borders a chart is cut
    if need be; proxy: the coarse mesh that charts were found on; failed: sentences on steps that failed.
    """

    label: np.ndarray
    part: np.ndarray
    proxy: TriMesh
    failed: list[str]


def find_charts(adjacency: Callable[[], Adjacency], mesh: QuadMesh, *, until: float, max_cost: float) -> Segmentation:
    """Segment a mesh into charts, with xatlas or, where that fails, by the side of a box that faces look at.

    mesh: in a unit box. adjacency: a function that returns the Adjacency of its faces. until: when xatlas is given up,
    on the clock time.monotonic. max_cost: xatlas' limit on the cost of a chart.
    """
    from gdtool.geometry.distance import closest_points
    from gdtool.geometry.simplify import SimplifyOptions, simplify

    vertices, faces = mesh.vertices, mesh.faces
    failed: list[str] = []
    triangles = mesh.triangles
    options = SimplifyOptions(
        seconds=max(until - time.monotonic(), _MIN_CHILD_SECONDS), measure_error=False, while_waiting=adjacency
    )
    proxy, _, report = simplify(TriMesh(vertices, triangles.faces.astype(np.int64)), _PROXY_TRIANGLES, options=options)
    if report.method == "vertex clustering":
        proxy = triangles
    try:
        chart = call(
            run_xatlas,
            TriMesh(proxy.vertices.astype(np.float32), proxy.faces.astype(np.int32)),
            max_cost,
            seconds=max(until - time.monotonic(), _MIN_CHILD_SECONDS),
            memory_mb=_CHILD_MEMORY_MB,
        )
        centre = vertices[np.where(faces < 0, faces[:, :1], faces)].mean(1)
        label = chart[closest_points(centre, proxy)[1]]
        if (label < 0).all():
            raise ChildFailed("xatlas made no charts")
    except ChildFailed as failure:
        failed.append(f"xatlas: {failure}")
        normals = adjacency().normals
        axis = np.abs(normals).argmax(1)
        label = axis * 2 + (normals[np.arange(len(faces)), axis] < 0)
    label = np.where(label < 0, label.max() + 1, label)
    proxy = TriMesh(proxy.vertices, proxy.faces.astype(np.int64))
    return Segmentation(*tidy_labels(adjacency(), label), proxy, failed)


def chart_mesh(mesh: Mesh) -> Mesh:
    """Make a mesh of a chart's faces alone; a vertex in which the chart touches itself is doubled.

    mesh: some faces of a mesh in which each vertex has one fan of faces; vertices of other faces are left out.
    """
    vertices, faces = mesh.vertices, mesh.faces
    used, corners = faces >= 0, np.full(faces.shape, -1, np.int64)
    vertex = faces[used]
    first = np.empty(len(vertices), np.int64)
    first[vertex[::-1]] = np.arange(len(vertex))[::-1]  # of several assignments to one element the last one stays
    new = first[vertex] == np.arange(len(vertex))
    corners[used] = (np.cumsum(new) - 1)[first[vertex]]
    points = vertices[vertex[new]]
    # A vertex has one more corner than inner edges for each open fan. Sorted keys repeat for inner edges.
    following = np.roll(corners, -1, 1)
    if faces.shape[1] == 4:
        following[:, 2] = np.where(used[:, 3], following[:, 2], corners[:, 0])
    low, high = np.minimum(corners, following)[used], np.maximum(corners, following)[used]
    key = np.sort(low * len(points) + high)
    low, high = np.divmod(key[1:][key[1:] == key[:-1]], len(points))
    fans = (
        np.bincount(corners[used], minlength=len(points))
        - np.bincount(low, minlength=len(points))
        - np.bincount(high, minlength=len(points))
    )
    several = fans.max(initial=0) > 1 or (key[2:] == key[:-2]).any()
    chart = replace(mesh, vertices=points, faces=corners)
    return one_vertex_per_fan(chart) if several else chart


def tidy_labels(adjacency: Adjacency, label: np.ndarray, rounds: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Smooth the seams between labels, prefer creases, and merge islands too small for a chart.

    Returns the labels (f,), and the parts (f,) that charts are made of: the labels after each small island had merged
    once.
    """
    first = label
    typical = np.median(adjacency.cost) if len(adjacency.cost) else 0.0
    parity = (np.arange(adjacency.count) * 2654435761 >> 7) % 2
    for turn in range(rounds):
        # Half of the faces at a time: neighbours that change at once would swap for ever.
        voted = adjacency.votes(label, np.where(first == label, _FIRST_BONUS, _LATER_BONUS) * typical)
        changing = (voted != label) & (parity == turn % 2)
        if not (voted != label).any():
            break
        label = np.where(changing, voted, label)
    label = adjacency.connected_labels(label)
    part, smallest = label, _MIN_CHART_SHARE * adjacency.area.sum()
    for turn in range(_MAX_MERGES):
        area = np.bincount(label, adjacency.area)
        faces = np.bincount(label)
        small = (area < smallest) | (faces < min(_MIN_CHART_FACES, adjacency.count // 64))
        # A small set goes whole to the neighbour with which it shares the most costly seam.
        a, b = label[adjacency.pairs].T
        apart = a != b
        pair = np.concatenate([np.stack([a, b], -1)[apart], np.stack([b, a], -1)[apart]])
        weight = np.concatenate([adjacency.cost[apart]] * 2)
        from_small = small[pair[:, 0]]
        if not from_small.any():
            break
        key, inverse = np.unique(pair[from_small][:, 0] * len(area) + pair[from_small][:, 1], return_inverse=True)
        total = np.bincount(inverse.ravel(), weight[from_small])
        merged_into = np.arange(len(area))
        for k in np.argsort(total, kind="stable").tolist():
            merged_into[key[k] // len(area)] = key[k] % len(area)
        # Two small neighbours must not swap: only toward the larger, or the lower number.
        target = merged_into
        swap = (target[target] == np.arange(len(area))) & (target > np.arange(len(area)))
        merged_into = np.where(swap, np.arange(len(area)), target)
        label = adjacency.connected_labels(merged_into[label])
        part = label if turn == 0 else part
    return label, part


def split_in_half(adjacency: Adjacency, faces_idx: np.ndarray) -> np.ndarray:
    """Split a chart's faces (k,) into two connected halves, around two faces far from each other; return (k,) bool."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    inside, pairs = adjacency.within(faces_idx)
    size = np.sqrt(adjacency.area[faces_idx])
    length = (size[pairs[:, 0]] + size[pairs[:, 1]]) / 2 * np.where(
        adjacency.crease[inside], _CREASE_FACTOR, 1.0
    ) + 1e-12
    a, b = pairs.T
    graph = coo_matrix(
        (np.concatenate([length, length]), (np.concatenate([a, b]), np.concatenate([b, a]))), (len(faces_idx),) * 2
    ).tocsr()

    def far_from(start: int) -> tuple[int, np.ndarray]:
        distance = dijkstra(graph, indices=start)
        return int(np.where(np.isfinite(distance), distance, -1).argmax()), distance

    first, _ = far_from(0)
    second, from_first = far_from(first)
    _, from_second = far_from(second)
    return from_second < from_first
