"""Find the feature curves of a surface (creases, boundaries), and trace them along the edges of a quad mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.mesh_quality import corner_jacobians, polygon_normals
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.sharpen import dihedral_degrees
from gdtool.geometry.topology import edges_of

_CORNER_TURN_DEGREES = 50.0  # a curve that turns by more at a point has a corner there
# Height over longest side of a triangle below which its normal is noise: simplifying folds some slivers over.
_MIN_TRIANGLE_HEIGHT = 0.05
_WEAK_CREASE = 0.6  # of the crease angle, that a crease may sink to along its way
_MIN_STRONG_SHARE = 0.3  # of a crease's length is sharper than the crease angle

# Of the shortest feature: arcs shorter than this are cleaned up.
_SHORT_SHARE = 0.5
_LOOP_FACTOR, _FREE_END_FACTOR = 4, 2  # times that, below which closed arcs and arcs with a free end are dropped
_CLEAN_ROUNDS = 12
# Times the short length: a corner with longer segments moves less far, for every such segment leaves the surface along
# its whole length.
_LONG_SEGMENT = 2.0

# Edge lengths: within this radius a curve's vertices are found by the search tree, else by sorting along x.
_TREE_RADIUS_EDGES = 8.0
_CORNER_REACH_EDGES, _WAYPOINT_REACH_EDGES = 1.2, 0.8  # edge lengths from a corner, or a waypoint, to its vertex
_CORRIDOR_EDGES = 1.5  # edge lengths: paths stay this near to their curve
_WAYPOINT_OFFSET_EDGES = 0.5  # edge lengths: a waypoint counts as this far from the curve at most
_DISTANCE_PENALTY = 8  # factor on the squared distance from the curve, in the cost of an edge
_MIN_CURVE_EDGES = 0.75  # edge lengths: shorter curves are not traced
_LONG_CURVE_EDGES = 12  # edge lengths: longer curves get a waypoint in the middle
_NEAREST_CHOICES = 4  # nearest vertices to choose a waypoint from: the nearest may belong to another curve
_STRAIGHT = 0.35  # the sine of a quad's corner below which features may not hold both its sides


@dataclass(frozen=True)
class Features:
    """Curves on a surface, cut into arcs between corners.

    points (p, 3); segments (s, 2) into them; curve (s,) the arc of each segment; corners (c,) the points where curves
    meet, end or turn sharply.
    """

    points: np.ndarray
    segments: np.ndarray
    curve: np.ndarray
    corners: np.ndarray

    def share_in_strips(self, width: float) -> float:
        """Compute the share of the curves' length along strips no wider than `width`, such as the rims of thin plates.

        A curve borders a strip when curves shorter than `width` meet it at both ends.
        """
        if not self:
            return 0.0
        length = np.bincount(
            self.curve, np.linalg.norm(self.points[self.segments[:, 0]] - self.points[self.segments[:, 1]], axis=1)
        )
        on_short = np.zeros(len(self.points), bool)
        on_short[self.segments[(length < width)[self.curve]]] = True
        in_strip = (length >= width) & (np.bincount(self.curve, on_short[self.segments].sum(1)) >= 2)
        return float(length[in_strip].sum() / length.sum())

    def __bool__(self) -> bool:
        return len(self.segments) > 0


NO_FEATURES = Features(np.zeros((0, 3)), np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))


def find_features(mesh: TriMesh, crease_degrees: float, shortest: float) -> Features:
    """Find the creases and open boundaries of triangles.

    A crease is sharper than crease_degrees somewhere, and sharper than 0.6 of that all along. Connected sets whose
    total length is below `shortest` are noise.
    """
    vertices, faces = mesh.vertices, mesh.faces
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = edges_of(faces)
    ends, _, angle = dihedral_degrees(mesh, _MIN_TRIANGLE_HEIGHT, edges)
    boundary = edges.ends[edges.count != 2]
    strong = np.concatenate([angle > crease_degrees, np.ones(len(boundary), bool)])
    segments = np.concatenate([ends, boundary])
    weak = np.concatenate([angle > _WEAK_CREASE * crease_degrees, strong[len(ends) :]])
    segments, strong = segments[weak], strong[weak]
    length = np.linalg.norm(vertices[segments[:, 0]] - vertices[segments[:, 1]], axis=1)
    n = len(vertices)
    if len(segments):
        _, label = connected_components(
            coo_matrix((np.ones(len(segments)), (segments[:, 0], segments[:, 1])), (n, n)), False
        )
        total = np.bincount(label[segments[:, 0]], length, label.max() + 1)
        sharp = np.bincount(label[segments[:, 0]], length * strong, label.max() + 1)
        keep = (total >= shortest) & (sharp >= np.maximum(_MIN_STRONG_SHARE * total, shortest / 2))
        segments = segments[keep[label[segments[:, 0]]]]
    if not len(segments):
        return NO_FEATURES
    used, segments = np.unique(segments, return_inverse=True)
    return _clean_arcs(vertices[used], segments.reshape(-1, 2), _SHORT_SHARE * shortest)


def _split_into_arcs(points: np.ndarray, segments: np.ndarray) -> Features:
    """Cut segments (s, 2) of points (p, 3) into arcs that end at corners.

    A corner is a point of one segment, of three or more, or of two that turn by more than _CORNER_TURN_DEGREES.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    degree = np.bincount(segments.ravel(), minlength=len(points))
    is_corner = (degree != 2) & (degree > 0)
    # A point with two segments is a corner where they turn sharply.
    ordered = np.argsort(segments.ravel(), kind="stable")
    other = segments[:, ::-1].ravel()[ordered]
    first = np.cumsum(degree) - degree
    two = np.flatnonzero(degree == 2)
    a = points[other[first[two]]] - points[two]
    b = points[other[first[two] + 1]] - points[two]
    cosine = -(a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-300)
    is_corner[two[cosine < np.cos(np.radians(_CORNER_TURN_DEGREES))]] = True
    # Segments that share a point which is no corner belong to one arc.
    s = len(segments)
    ends = segments.ravel()
    segment = np.repeat(np.arange(s), 2)
    inner = ~is_corner[ends]
    graph = coo_matrix(
        (np.ones(int(inner.sum())), (segment[inner], s + ends[inner])), (s + len(points), s + len(points))
    )
    _, label = connected_components(graph, False)
    curve = np.unique(label[:s], return_inverse=True)[1].ravel()
    return Features(points, segments, curve, np.flatnonzero(is_corner))


def _clean_arcs(points: np.ndarray, segments: np.ndarray, short: float) -> Features:
    """Split segments into arcs, and remove the arcs that are too short for quads to follow.

    Slivers along a crease make spurs, bubbles and doubled corners. Short arcs that end freely or return to their corner
    are dropped. A short arc between two corners is contracted into one of them. No corner travels farther than `short`
    by this, because the arcs attached to it would leave the surface; an arc that needs more becomes a gap. Where long
    segments are attached to both corners, as on the short edges of a thin plate, the arc stays.
    """
    travelled = np.zeros(len(points))  # how far the points contracted into each corner came
    for _ in range(_CLEAN_ROUNDS):
        features = _split_into_arcs(points, segments)
        count = int(features.curve.max()) + 1
        segment_length = np.linalg.norm(points[segments[:, 0]] - points[segments[:, 1]], axis=1)
        arc_length = np.bincount(features.curve, segment_length, count)
        longest_attached = np.full(len(points), _LONG_SEGMENT * short)
        np.maximum.at(longest_attached, segments, segment_length[:, None])
        reach = _LONG_SEGMENT * short**2 / longest_attached  # how far each corner may move
        degree = np.bincount(segments.ravel(), minlength=len(points))
        is_corner = np.zeros(len(points), bool)
        is_corner[features.corners] = True
        at_corner = is_corner[segments]
        # The corners of each arc: none for a closed one, one when it returns to its corner, else two.
        arc = np.repeat(features.curve, 2)[at_corner.ravel()]
        corner = segments.ravel()[at_corner.ravel()]
        low, high = np.full(count, len(points)), np.full(count, -1)
        np.minimum.at(low, arc, corner)
        np.maximum.at(high, arc, corner)
        valid_low = np.clip(low, 0, len(points) - 1)
        is_loop = (high < 0) | (low == high)
        is_free = ~is_loop & ((degree[valid_low] == 1) | (degree[high] == 1))
        drop = (is_loop & (arc_length < _LOOP_FACTOR * short)) | (is_free & (arc_length < _FREE_END_FACTOR * short))
        contract = np.flatnonzero(~is_loop & ~is_free & (arc_length < np.maximum(reach[valid_low], reach[high])))
        if not drop.any() and not len(contract):
            break
        merged_into = np.arange(len(points))
        for i in contract[np.argsort(arc_length[contract], kind="stable")].tolist():
            a, b = low[i], high[i]
            while merged_into[a] != a:
                a = merged_into[a]
            while merged_into[b] != b:
                b = merged_into[b]
            keep, lose = (a, b) if (-reach[a], degree[a]) >= (-reach[b], degree[b]) else (b, a)
            distance = travelled[lose] + np.linalg.norm(points[keep] - points[lose])
            if a != b and distance <= reach[lose]:
                merged_into[lose] = keep
                travelled[keep], reach[keep] = max(travelled[keep], distance), min(reach[keep], reach[lose])
            drop[i] = True
        while (merged_into[merged_into] != merged_into).any():
            merged_into = merged_into[merged_into]
        segments = merged_into[segments[~drop[features.curve]]]
        segments = np.unique(np.sort(segments[segments[:, 0] != segments[:, 1]], 1), axis=0)
        if not len(segments):
            return NO_FEATURES
    used, segments = np.unique(segments, return_inverse=True)
    return _split_into_arcs(points[used], segments.reshape(-1, 2))


def closest_on_segments(
    queries: np.ndarray, points: np.ndarray, segments: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the closest points on segments (s, 2) of points (p, 3) to query points (n, 3).

    Returns the distance (n,), the segment (n,) and the closest point (n, 3).
    """
    igl = imported("igl")
    squared, segment, point = igl.point_mesh_squared_distance(
        np.ascontiguousarray(queries, np.float64),
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(segments, np.int64),
    )[:3]
    return np.sqrt(np.maximum(squared, 0)), np.asarray(segment), np.asarray(point)


@dataclass(frozen=True)
class Constraints:
    """The feature curves and fixed positions that hold vertices of a quad mesh.

    curve (v,): the feature curve a vertex slides along, or -1. fixed (v,) bool: vertices that do not move (corners,
    tips). path (k, 2): edges of the mesh that follow curves; path_curve (k,): the curve of each.
    """

    curve: np.ndarray
    fixed: np.ndarray
    path: np.ndarray
    path_curve: np.ndarray

    @classmethod
    def none(cls, count: int) -> Constraints:
        """Make constraints that leave `count` vertices free."""
        return cls(np.full(count, -1), np.zeros(count, bool), np.zeros((0, 2), np.int64), np.zeros(0, np.int64))


def trace_features(mesh: QuadMesh, features: Features, edge: float) -> tuple[np.ndarray, Constraints]:
    """Snap paths of quad edges to the feature curves.

    edge: the mean edge length. Each curve gets the shortest path of edges that stays near it. Paths do not cross one
    another. Returns vertices (v, 3), in which those on paths lie on the curves, and the constraints that hold them
    there.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if not features:
        return vertices, Constraints.none(len(vertices))
    tracer = _FeatureTracer(vertices, faces, features, edge)
    tracer.snap_corners()
    order = np.argsort(features.curve, kind="stable")
    bounds = np.searchsorted(features.curve[order], np.arange(features.curve.max() + 2))
    for curve in range(len(bounds) - 1):
        tracer.trace_curve(curve, features.segments[order[bounds[curve] : bounds[curve + 1]]])
    return tracer.result()


class _FeatureTracer:
    """A tracer of feature curves along a quad mesh's edges, with the paths found so far."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, features: Features, edge: float):
        from scipy.spatial import cKDTree

        count = len(vertices)
        self._vertices, self._features, self._edge = vertices, features, edge
        self._ends = edges_of(faces).ends
        self._first_edge = np.searchsorted(self._ends[:, 0], np.arange(count + 1))  # of each vertex
        self._tree = cKDTree(vertices)
        self._by_x = np.argsort(vertices[:, 0], kind="stable")
        self._sorted_x = vertices[self._by_x, 0]
        self._snapped = vertices.copy()
        self._curve, self._fixed = np.full(count, -1), np.zeros(count, bool)
        self._corner_vertex: dict[int, int] = {}  # of a corner of the features
        self._paths: list[np.ndarray] = []
        self._path_curves: list[np.ndarray] = []
        # Scratch arrays over all vertices, of which one curve touches few: distance from the curve where a path may go
        # (infinite elsewhere), place in the curve's graph, and the vertices touched.
        self._distance, self._node = np.full(count, np.inf), np.full(count, -1)
        self._touched = np.zeros(0, np.int64)

    def snap_corners(self) -> None:
        """Move the nearest vertex to each corner of the features, nearest pairs first, and fix it there."""
        corners = self._features.corners
        distance, nearest = self._tree.query(self._features.points[corners])
        for i in np.argsort(distance, kind="stable"):
            corner, vertex = int(corners[i]), int(nearest[i])
            if distance[i] < _CORNER_REACH_EDGES * self._edge and not self._fixed[vertex]:
                self._corner_vertex[corner] = vertex
                self._fixed[vertex] = True
                self._snapped[vertex] = self._features.points[corner]
        self._taken = self._fixed.copy()

    def trace_curve(self, curve: int, segments: np.ndarray) -> None:
        """Find the path of edges along one curve, segments (s, 2), and move its vertices onto the curve."""
        from scipy.sparse.csgraph import dijkstra

        waypoints = self._waypoints(segments)
        if len(waypoints) < 2:
            return
        self._mark_corridor(segments, waypoints)
        graph, nodes = self._corridor_graph()
        if graph is None:
            return
        visited: list[int] = []
        for a, b in zip(waypoints[:-1], waypoints[1:], strict=True):
            if self._node[a] < 0 or self._node[b] < 0:
                continue
            length, before = dijkstra(graph, directed=False, indices=self._node[a], return_predecessors=True)
            if not np.isfinite(length[self._node[b]]):
                continue
            walk = [int(self._node[b])]
            while walk[-1] != self._node[a]:
                walk.append(int(before[walk[-1]]))
            path = nodes[walk]
            self._paths.append(np.stack([path[:-1], path[1:]], -1))
            self._path_curves.append(np.full(len(path) - 1, curve))
            visited.extend(path.tolist())
        inner = np.array([v for v in visited if not self._fixed[v]], np.int64)
        self._taken[visited] = True
        self._curve[inner] = curve
        if len(inner):
            self._snapped[inner] = closest_on_segments(self._vertices[inner], self._features.points, segments)[2]

    def result(self) -> tuple[np.ndarray, Constraints]:
        """Return the vertices with all paths snapped, and the constraints."""
        if not self._paths:
            path, path_curve = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
        else:
            path, path_curve = np.concatenate(self._paths), np.concatenate(self._path_curves)
        return self._snapped, Constraints(self._curve, self._fixed, path, path_curve)

    def _mark_corridor(self, segments: np.ndarray, waypoints: list[int]) -> None:
        """Set the distances of the free vertices near a curve: the corridor in which its path may run.

        There are many curves, so the other vertices are not looked at.
        """
        vertices, edge = self._vertices, self._edge
        points = self._features.points[segments]
        low, high = points.min((0, 1)) - _CORRIDOR_EDGES * edge, points.max((0, 1)) + _CORRIDOR_EDGES * edge
        if (radius := np.linalg.norm(high - low) / 2) < _TREE_RADIUS_EDGES * edge:
            around = np.array(self._tree.query_ball_point((low + high) / 2, radius, return_sorted=True), np.int64)
        else:
            first = np.searchsorted(self._sorted_x, low[0])
            around = np.sort(self._by_x[first : np.searchsorted(self._sorted_x, high[0], "right")])
        positions = vertices[around]
        near = around[((positions >= low) & (positions <= high)).all(1)]
        distance, _, _ = closest_on_segments(vertices[near], self._features.points, segments)
        near, distance = near[distance < _CORRIDOR_EDGES * edge], distance[distance < _CORRIDOR_EDGES * edge]
        self._distance[self._touched], self._node[self._touched] = np.inf, -1  # of the curve before
        self._distance[near] = distance
        self._distance[near[self._taken[near]]] = np.inf
        for waypoint in waypoints:
            known = self._distance[waypoint] if np.isfinite(self._distance[waypoint]) else 0.0
            self._distance[waypoint] = min(known, _WAYPOINT_OFFSET_EDGES * edge)
        self._touched = np.union1d(near, waypoints)

    def _corridor_graph(self):
        """Make a sparse matrix of the costs of the corridor's edges; None without edges.

        Also returns the vertex of each of its nodes.
        """
        from scipy.sparse import csr_array

        low_ends = self._touched[np.isfinite(self._distance[self._touched])]
        count = self._first_edge[low_ends + 1] - self._first_edge[low_ends]
        usable = self._ends[
            np.repeat(self._first_edge[low_ends] - np.cumsum(count) + count, count) + np.arange(count.sum())
        ]
        usable = usable[np.isfinite(self._distance[usable[:, 1]])]
        if not len(usable):
            return None, None
        nodes = np.unique(usable)
        self._node[nodes] = np.arange(len(nodes))
        mean = self._distance[usable].mean(1) / self._edge
        cost = np.linalg.norm(self._vertices[usable[:, 0]] - self._vertices[usable[:, 1]], axis=1) * (
            1 + _DISTANCE_PENALTY * mean**2
        )
        # Edges come in the order of their ends, as the rows of a sparse matrix do.
        rows = np.searchsorted(self._node[usable[:, 0]], np.arange(len(nodes) + 1))
        return csr_array((cost, self._node[usable[:, 1]], rows), (len(nodes), len(nodes))), nodes

    def _waypoints(self, segments: np.ndarray) -> list[int]:
        """Return the vertices that the path along one curve visits in order.

        They are the vertices of its corners, and on a long curve one in the middle. A closed curve without a corner
        gets up to four, and the first again at the end.
        """
        ordered = _order_points(segments)
        points = self._features.points[ordered]
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        if along[-1] < _MIN_CURVE_EDGES * self._edge:
            return []
        tree = self._tree

        def free_vertex_at(share: float, reach: float) -> int | None:
            position = np.array([np.interp(share * along[-1], along, points[:, i]) for i in range(3)])
            choices = np.arange(1, min(_NEAREST_CHOICES, tree.n) + 1)
            near = tree.query(position, choices, distance_upper_bound=reach * self._edge)[1]
            return next((int(vertex) for vertex in near if vertex < tree.n and not self._taken[vertex]), None)

        is_closed = ordered[0] == ordered[-1]
        if is_closed and ordered[0] not in self._corner_vertex:
            vertices = [free_vertex_at(share, _WAYPOINT_REACH_EDGES) for share in (0, 1 / 4, 1 / 2, 3 / 4)]
            vertices = [v for i, v in enumerate(vertices) if v is not None and v not in vertices[:i]]
            return [*vertices, vertices[0]] if len(vertices) >= 3 else []
        a, b = self._corner_vertex.get(int(ordered[0])), self._corner_vertex.get(int(ordered[-1]))
        if a is None:
            a = free_vertex_at(0.0, _CORNER_REACH_EDGES)
        if b is None:
            b = free_vertex_at(1.0, _CORNER_REACH_EDGES)
        # A closed curve needs two vertices between, or the path would return the way it came.
        shares = (1 / 3, 2 / 3) if a == b else (0.5,) if along[-1] > _LONG_CURVE_EDGES * self._edge else ()
        candidates = (free_vertex_at(share, _WAYPOINT_REACH_EDGES) for share in shares)
        middle = [v for v in candidates if v is not None and v not in (a, b)]
        if a == b and len(set(middle)) < 2:
            return []
        return [v for v in (a, *middle, b) if v is not None]


def _order_points(segments: np.ndarray) -> list[int]:
    """Order the points of one curve along it; the last point equals the first where the curve is closed."""
    links: dict[int, list[int]] = {}
    for a, b in segments.tolist():
        links.setdefault(a, []).append(b)
        links.setdefault(b, []).append(a)
    start = next((p for p, others in links.items() if len(others) == 1), next(iter(links)))
    walk, previous, current = [start], None, start
    while True:
        onward = [p for p in links[current] if p != previous]
        if not onward:
            return walk
        previous, current = current, onward[0]
        walk.append(current)
        if current == start or len(walk) > len(segments) + 1:
            return walk


def release_straight_corners(mesh: QuadMesh, constraints: Constraints) -> Constraints:
    """Release the middle of three corners of a quad that follow a feature in a straight line.

    A quad with a straight angle is degenerate. The path is open at the released corner: a crease cut short by half a
    quad is the smaller fault.
    """
    vertices, faces = mesh.vertices, mesh.faces
    curve, fixed, path = constraints.curve.copy(), constraints.fixed.copy(), np.sort(constraints.path, 1)
    width = len(vertices) + 1
    remaining = np.ones(len(path), bool)
    corner = faces[faces[:, 3] >= 0]
    after, before = np.roll(corner, -1, 1), np.roll(corner, 1, 1)
    straight = corner_jacobians(QuadMesh(vertices, corner), polygon_normals(QuadMesh(vertices, corner))[0]) < _STRAIGHT

    def on_path(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.isin(np.minimum(a, b) * width + np.maximum(a, b), (path[:, 0] * width + path[:, 1])[remaining])

    between = on_path(corner, after) & on_path(before, corner)
    # At a corner of the features the angle is the surface's own: it is released only where it is straight or folded.
    release = np.unique(corner[between & (straight | ~fixed[corner])])
    curve[release], fixed[release] = -1, False
    remaining &= ~np.isin(path, release).any(1)
    return Constraints(curve, fixed, constraints.path[remaining], constraints.path_curve[remaining])
