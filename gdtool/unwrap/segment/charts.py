"""Which faces of a quad mesh share a chart: xatlas on a simplified proxy, brought back to whole quads and tidied."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from gdtool.core.child import ChildFailed, call
from gdtool.core.native import imported
from gdtool.geometry.mesh_quality import polygon_normals
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.geometry.topology import edges_of, triangulated

_PROXY_TRIANGLES = 6000
_CREASE_DEGREES = 30.0
_SHORTEST = 0.05  # seconds of a child
_SMALLEST_SHARE = 0.003  # of the area; a smaller chart joins a neighbour if it has one


def run_xatlas(vertices: np.ndarray, triangles: np.ndarray, max_cost: float) -> np.ndarray:
    """(t,) chart of each triangle, by xatlas; runs in a child, because xatlas can hang. Triangles it drops have chart
    -1."""
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
    """Faces (k, 2) that share an edge, with what a seam along that edge costs (k,): its length, a tenth of it on
    creases."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        edges = edges_of(faces)
        edge_idx, self.pairs = edges.face_pairs()
        self.ends = edges.ends[edge_idx]
        normals, self.area = polygon_normals(vertices, faces)
        cosine = (normals[self.pairs[:, 0]] * normals[self.pairs[:, 1]]).sum(1)
        length = np.linalg.norm(vertices[self.ends[:, 0]] - vertices[self.ends[:, 1]], axis=1)
        self.crease = cosine < np.cos(np.radians(_CREASE_DEGREES))
        self.cost = length * np.where(self.crease, 0.1, 1.0) + 1e-12
        self.normals, self.count = normals, len(faces)
        # Where the two faces walk the edge in one direction (a turned face) a chart cannot go on.
        turned = edges.turned[edge_idx]
        order = np.argsort(self.pairs[~turned][:, 0], kind="stable")
        self.pairs, self.cost, self.crease, self.ends = (
            x[~turned][order] for x in (self.pairs, self.cost, self.crease, self.ends)
        )
        self._begin = np.searchsorted(self.pairs[:, 0], np.arange(self.count + 1))

    def within(self, faces_idx: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows (r,) of the pairs whose two faces are both among faces_idx (k,), and their places (r, 2) there."""
        first, number = self._begin[faces_idx], self._begin[faces_idx + 1] - self._begin[faces_idx]
        rows = np.repeat(first - np.cumsum(number) + number, number) + np.arange(number.sum())
        place = np.full(self.count, -1)
        place[faces_idx] = np.arange(len(faces_idx))
        pairs = place[self.pairs[rows]]
        inside = (pairs >= 0).all(1)
        return rows[inside], pairs[inside]

    def pieces(self, faces_idx: np.ndarray, side: np.ndarray | None = None) -> np.ndarray:
        """(k,) number, from 0 on, of the set that each of faces_idx (k,) is connected in, through faces of faces_idx
        alone, and where there are sides (k,), of its own."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        _, pairs = self.within(faces_idx)
        if side is not None:
            pairs = pairs[side[pairs[:, 0]] == side[pairs[:, 1]]]
        return connected_components(
            coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(faces_idx),) * 2), False
        )[1]

    def connected(self, label: np.ndarray) -> np.ndarray:
        """Labels (f,) such that each is one connected set of faces: sets of one label that do not touch get their
        own."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        same = label[self.pairs[:, 0]] == label[self.pairs[:, 1]]
        pairs = self.pairs[same]
        graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (self.count, self.count))
        return connected_components(graph, False)[1].astype(np.int64)

    def votes(self, label: np.ndarray, own: np.ndarray | float) -> np.ndarray:
        """(f,) the label around each face whose edges cost most to cut; own (f,) is added to the label it has."""
        # A face among its own votes for its own label, whatever that costs.
        apart = label[self.pairs[:, 0]] != label[self.pairs[:, 1]]
        border = np.zeros(self.count, bool)
        border[self.pairs[apart].ravel()] = True
        faces_idx = np.flatnonzero(border)
        near = border[self.pairs]
        face = np.concatenate([self.pairs[near[:, 0], 0], self.pairs[near[:, 1], 1], faces_idx])
        vote = np.concatenate([label[self.pairs[near[:, 0], 1]], label[self.pairs[near[:, 1], 0]], label[faces_idx]])
        weight = np.concatenate(
            [self.cost[near[:, 0]], self.cost[near[:, 1]], np.broadcast_to(own, self.count)[faces_idx]]
        )
        width = int(label.max()) + 1
        key, inverse = np.unique(face * width + vote, return_inverse=True)
        total = np.bincount(inverse.ravel(), weight)
        order = np.lexsort((total, key // width))
        out = label.copy()
        out[key[order] // width] = key[order] % width  # of several assignments to one element the last one stays
        return out


def find_charts(
    adjacency: Callable[[], Adjacency], vertices: np.ndarray, faces: np.ndarray, *, until: float, max_cost: float
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray], list[str]]:
    """(f,) chart of each face, all connected, (f,) its part of that, the coarse mesh (vertices, triangles) they were
    found on, and what failed on the way.

    vertices (v, 3) in a unit box, faces (f, 4), adjacency gives theirs; until: when to have given up, on the clock
    time.monotonic. Without xatlas' help the faces go by the box side they look at."""
    from gdtool.geometry.distance import closest_points
    from gdtool.geometry.simplify import simplify

    failed: list[str] = []
    triangles, _ = triangulated(faces)
    proxy_vertices, proxy, _, report = simplify(
        vertices,
        triangles.astype(np.int64),
        _PROXY_TRIANGLES,
        measured=False,
        meanwhile=adjacency,
        seconds=max(until - time.monotonic(), _SHORTEST),
    )
    if report["method"] == "vertex clustering":
        proxy_vertices, proxy = vertices, triangles
    try:
        chart = call(
            run_xatlas,
            proxy_vertices.astype(np.float32),
            proxy.astype(np.int32),
            max_cost,
            seconds=max(until - time.monotonic(), _SHORTEST),
            memory_mb=8000,
        )
        centre = vertices[np.where(faces < 0, faces[:, :1], faces)].mean(1)
        label = chart[closest_points(centre, proxy_vertices, proxy)[1]]
        if (label < 0).all():
            raise ChildFailed("xatlas made no charts")
    except ChildFailed as failure:
        failed.append(f"xatlas: {failure}")
        normals = adjacency().normals
        axis = np.abs(normals).argmax(1)
        label = axis * 2 + (normals[np.arange(len(faces)), axis] < 0)
    label = np.where(label < 0, label.max() + 1, label)
    return *tidy(adjacency(), label), (proxy_vertices, proxy.astype(np.int64)), failed


def own_corners(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A chart's own vertices, those where it touches itself doubled, and its faces (k, 3) or (k, 4) into them.

    In the whole mesh each vertex has one fan of faces: a chart has parts of it that do not touch, or all of it.
    """
    used, corners = faces >= 0, np.full(faces.shape, -1, np.int64)
    vertex = faces[used]
    first = np.empty(len(vertices), np.int64)
    first[vertex[::-1]] = np.arange(len(vertex))[::-1]  # of several assignments to one element the last one stays
    new = first[vertex] == np.arange(len(vertex))
    corners[used] = (np.cumsum(new) - 1)[first[vertex]]
    points = vertices[vertex[new]]
    # An open fan has a corner more than edges between them; sorted, such an edge comes twice.
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
    return one_vertex_per_fan(points, corners) if several else (points, corners)


def tidy(adjacency: Adjacency, label: np.ndarray, rounds: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Labels with short, straight seams that prefer creases, without islands too small to be a chart; and what these
    charts were made of: labels from when each island had joined one neighbour."""
    first = label
    typical = np.median(adjacency.cost) if len(adjacency.cost) else 0.0
    parity = (np.arange(adjacency.count) * 2654435761 >> 7) % 2
    for turn in range(rounds):
        # Half of the faces at a time: neighbours that change at once would swap for ever.
        voted = adjacency.votes(label, np.where(first == label, 0.4, 0.1) * typical)
        changing = (voted != label) & (parity == turn % 2)
        if not (voted != label).any():
            break
        label = np.where(changing, voted, label)
    label = adjacency.connected(label)
    part, smallest = label, _SMALLEST_SHARE * adjacency.area.sum()
    for turn in range(20):
        area = np.bincount(label, adjacency.area)
        faces = np.bincount(label)
        small = (area < smallest) | (faces < min(8, adjacency.count // 64))
        # A small set goes whole to the neighbour with which it shares the most costly seam.
        a, b = label[adjacency.pairs].T
        apart = a != b
        pair = np.concatenate([np.stack([a, b], -1)[apart], np.stack([b, a], -1)[apart]])
        weight = np.concatenate([adjacency.cost[apart]] * 2)
        mine = small[pair[:, 0]]
        if not mine.any():
            break
        key, inverse = np.unique(pair[mine][:, 0] * len(area) + pair[mine][:, 1], return_inverse=True)
        total = np.bincount(inverse.ravel(), weight[mine])
        onto = np.arange(len(area))
        for k in np.argsort(total, kind="stable").tolist():
            onto[key[k] // len(area)] = key[k] % len(area)
        # Two small neighbours must not swap: only toward the larger, or the lower number.
        target = onto
        swap = (target[target] == np.arange(len(area))) & (target > np.arange(len(area)))
        onto = np.where(swap, np.arange(len(area)), target)
        label = adjacency.connected(onto[label])
        part = label if turn == 0 else part
    return label, part


def bisect(adjacency: Adjacency, faces_idx: np.ndarray) -> np.ndarray:
    """(k,) bool: a split of a chart's faces (k,) in two connected halves, between two faces far from each other."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import dijkstra

    inside, pairs = adjacency.within(faces_idx)
    # Across a crease is far: halves part there when they can.
    size = np.sqrt(adjacency.area[faces_idx])
    length = (size[pairs[:, 0]] + size[pairs[:, 1]]) / 2 * np.where(adjacency.crease[inside], 5.0, 1.0) + 1e-12
    a, b = pairs.T
    graph = coo_matrix(
        (np.concatenate([length, length]), (np.concatenate([a, b]), np.concatenate([b, a]))), (len(faces_idx),) * 2
    ).tocsr()

    def far_from(start: int) -> tuple[int, np.ndarray]:
        distance = dijkstra(graph, indices=start)
        return int(np.where(np.isfinite(distance), distance, -1).argmax()), distance

    one, _ = far_from(0)
    two, from_one = far_from(one)
    _, from_two = far_from(two)
    return from_two < from_one
