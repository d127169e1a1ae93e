"""Feature curves of a surface (creases and boundaries) and the paths of edges on a quad mesh that follow them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.sharpen import dihedral_degrees
from gdtool.geometry.topology import edges_of

_CORNER_TURN_DEGREES = 50.0
_THINNEST = 0.05  # height over longest side of a triangle that has no direction of its own: simplifying folds some over
# Around a curve that reaches no farther, vertices are found by their tree, around others along an axis.
_SHORT_EDGES = 8.0
_CHOICES = 4  # vertices that a curve may be drawn from where it has no corner of its own: the nearest may be another's
# Times what is short: a corner from which longer segments go is drawn less far, for each would leave the surface all
# along.
_HANGING = 2.0
_STRAIGHT = 0.35  # the sine of a quad's corner below which features may not hold both its sides


@dataclass(frozen=True)
class Features:
    """Curves on a surface: points (p, 3), segments (s, 2) into them, curve (s,) numbering arcs between corners.

    corners (c,) are points where curves meet, end or turn sharply.
    """

    points: np.ndarray
    segments: np.ndarray
    curve: np.ndarray
    corners: np.ndarray

    def in_strips(self, width: float) -> float:
        """Share of the curves' length that edges strips no wider than that, as the rims of thin plates do: curves that
        shorter ones meet at both ends."""
        if not self:
            return 0.0
        length = np.bincount(
            self.curve, np.linalg.norm(self.points[self.segments[:, 0]] - self.points[self.segments[:, 1]], axis=1)
        )
        met = np.zeros(len(self.points), bool)
        met[self.segments[(length < width)[self.curve]]] = True
        edging = (length >= width) & (np.bincount(self.curve, met[self.segments].sum(1)) >= 2)
        return float(length[edging].sum() / length.sum())

    def __bool__(self) -> bool:
        return len(self.segments) > 0


NO_FEATURES = Features(np.zeros((0, 3)), np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))


def find_features(vertices: np.ndarray, faces: np.ndarray, crease_degrees: float, shortest: float) -> Features:
    """Creases and open boundaries. A crease is sharper than crease_degrees somewhere and than 0.6 of that all along;
    connected sets shorter in all than `shortest` are noise."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = edges_of(faces)
    ends, _, angle = dihedral_degrees(vertices, faces, _THINNEST, edges)
    border = edges.ends[edges.count != 2]
    strong = np.concatenate([angle > crease_degrees, np.ones(len(border), bool)])
    segments = np.concatenate([ends, border])
    weak = np.concatenate([angle > 0.6 * crease_degrees, strong[len(ends) :]])
    segments, strong = segments[weak], strong[weak]
    length = np.linalg.norm(vertices[segments[:, 0]] - vertices[segments[:, 1]], axis=1)
    n = len(vertices)
    if len(segments):
        _, label = connected_components(
            coo_matrix((np.ones(len(segments)), (segments[:, 0], segments[:, 1])), (n, n)), False
        )
        total = np.bincount(label[segments[:, 0]], length, label.max() + 1)
        sharp = np.bincount(label[segments[:, 0]], length * strong, label.max() + 1)
        keep = (total >= shortest) & (sharp >= np.maximum(0.3 * total, shortest / 2))
        segments = segments[keep[label[segments[:, 0]]]]
    if not len(segments):
        return NO_FEATURES
    used, segments = np.unique(segments, return_inverse=True)
    return _tidy(vertices[used], segments.reshape(-1, 2), 0.5 * shortest)


def _arcs(points: np.ndarray, segments: np.ndarray) -> Features:
    """Segments numbered by the arc between corners that they belong to."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    degree = np.bincount(segments.ravel(), minlength=len(points))
    is_corner = (degree != 2) & (degree > 0)
    # At a point of degree two: the angle between its two segments.
    ordered = np.argsort(segments.ravel(), kind="stable")
    other = segments[:, ::-1].ravel()[ordered]
    first = np.cumsum(degree) - degree
    two = np.flatnonzero(degree == 2)
    a = points[other[first[two]]] - points[two]
    b = points[other[first[two] + 1]] - points[two]
    cosine = -(a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-300)
    is_corner[two[cosine < np.cos(np.radians(_CORNER_TURN_DEGREES))]] = True
    # Segments that share a point that is no corner are of one curve.
    s = len(segments)
    ends_of = segments.ravel()
    owner = np.repeat(np.arange(s), 2)
    inner = ~is_corner[ends_of]
    graph = coo_matrix(
        (np.ones(int(inner.sum())), (owner[inner], s + ends_of[inner])), (s + len(points), s + len(points))
    )
    _, label = connected_components(graph, False)
    curve = np.unique(label[:s], return_inverse=True)[1].ravel()
    return Features(points, segments, curve, np.flatnonzero(is_corner))


def _tidy(points: np.ndarray, segments: np.ndarray, short: float) -> Features:
    """Arcs between corners, after those that are too short to follow are gone.

    Slivers along a crease make spurs, bubbles and doubled corners: arcs that end freely or return to their corner are
    dropped when short, short arcs between two corners drawn together into one corner. No corner comes farther than
    `short` that way, for what hangs on it would leave the surface: an arc that asks for more is a gap from then on.
    Where long segments hang on both corners, as on the short edges of a thin plate, the arc stays."""
    came = np.zeros(len(points))  # how far what was drawn into a corner came
    for _ in range(12):
        features = _arcs(points, segments)
        count = int(features.curve.max()) + 1
        piece = np.linalg.norm(points[segments[:, 0]] - points[segments[:, 1]], axis=1)
        length, hanging = np.bincount(features.curve, piece, count), np.full(len(points), _HANGING * short)
        np.maximum.at(hanging, segments, piece[:, None])
        reach = _HANGING * short**2 / hanging  # that each corner may be drawn
        degree = np.bincount(segments.ravel(), minlength=len(points))
        is_corner = np.zeros(len(points), bool)
        is_corner[features.corners] = True
        at = is_corner[segments]
        # The corners of each arc: none for a closed one, one when it returns to it, else two.
        arc = np.repeat(features.curve, 2)[at.ravel()]
        corner = segments.ravel()[at.ravel()]
        low, high = np.full(count, len(points)), np.full(count, -1)
        np.minimum.at(low, arc, corner)
        np.maximum.at(high, arc, corner)
        loop = (high < 0) | (low == high)
        free = ~loop & ((degree[np.clip(low, 0, len(points) - 1)] == 1) | (degree[high] == 1))
        drop = (loop & (length < 4 * short)) | (free & (length < 2 * short))
        draw = np.flatnonzero(
            ~loop & ~free & (length < np.maximum(reach[np.clip(low, 0, len(points) - 1)], reach[high]))
        )
        if not drop.any() and not len(draw):
            break
        onto_corner = np.arange(len(points))
        for i in draw[np.argsort(length[draw], kind="stable")].tolist():
            a, b = low[i], high[i]
            while onto_corner[a] != a:
                a = onto_corner[a]
            while onto_corner[b] != b:
                b = onto_corner[b]
            keep, lose = (a, b) if (-reach[a], degree[a]) >= (-reach[b], degree[b]) else (b, a)
            farthest = came[lose] + np.linalg.norm(points[keep] - points[lose])
            if a != b and farthest <= reach[lose]:
                onto_corner[lose], came[keep], reach[keep] = (
                    keep,
                    max(came[keep], farthest),
                    min(reach[keep], reach[lose]),
                )
            drop[i] = True
        while (onto_corner[onto_corner] != onto_corner).any():
            onto_corner = onto_corner[onto_corner]
        segments = onto_corner[segments[~drop[features.curve]]]
        segments = np.unique(np.sort(segments[segments[:, 0] != segments[:, 1]], 1), axis=0)
        if not len(segments):
            return NO_FEATURES
    used, segments = np.unique(segments, return_inverse=True)
    return _arcs(points[used], segments.reshape(-1, 2))


def closest_on_segments(
    queries: np.ndarray, points: np.ndarray, segments: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For queries (n, 3): distance (n,), segment (n,) and the closest point (n, 3) on segments (s, 2) of points (p,
    3)."""
    igl = imported("igl")
    squared, segment, point = igl.point_mesh_squared_distance(
        np.ascontiguousarray(queries, np.float64),
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(segments, np.int64),
    )[:3]
    return np.sqrt(np.maximum(squared, 0)), np.asarray(segment), np.asarray(point)


@dataclass(frozen=True)
class Constraints:
    """What vertices of a quad mesh are held to: curve (v,) a feature curve or -1, fixed (v,) bool (corners),
    path (k, 2) the mesh's edges that follow curves, path_curve (k,)."""

    curve: np.ndarray
    fixed: np.ndarray
    path: np.ndarray
    path_curve: np.ndarray

    @classmethod
    def none(cls, count: int) -> Constraints:
        return cls(np.full(count, -1), np.zeros(count, bool), np.zeros((0, 2), np.int64), np.zeros(0, np.int64))


def trace(vertices: np.ndarray, faces: np.ndarray, features: Features, edge: float) -> tuple[np.ndarray, Constraints]:
    """Vertices (v, 3) with paths of edges drawn onto the features, and what they are held to from then on.

    faces (f, 4); edge is the mean edge length. For each curve the shortest path of edges that stays near it is taken;
    paths may not cross one another nor touch a face with three corners in a row.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    count = len(vertices)
    if not features:
        return vertices, Constraints.none(count)
    ends = edges_of(faces).ends
    out = vertices.copy()
    curve_of, fixed = np.full(count, -1), np.zeros(count, bool)
    tree = cKDTree(vertices)
    at_corner: dict[int, int] = {}
    distance, nearest = tree.query(features.points[features.corners])
    for i in np.argsort(distance, kind="stable"):
        corner, vertex = int(features.corners[i]), int(nearest[i])
        if distance[i] < 1.2 * edge and not fixed[vertex]:
            at_corner[corner] = vertex
            fixed[vertex] = True
            out[vertex] = features.points[corner]
    paths, path_curves = [], []
    order = np.argsort(features.curve, kind="stable")
    bounds = np.searchsorted(features.curve[order], np.arange(features.curve.max() + 2))
    taken = fixed.copy()
    # Curves are many and short: of each, only what is near is looked at.
    by_x = np.argsort(vertices[:, 0], kind="stable")
    sorted_x = vertices[by_x, 0]
    begin = np.searchsorted(ends[:, 0], np.arange(count + 1))
    allowed, number, live = np.full(count, np.inf), np.full(count, -1), np.zeros(0, np.int64)
    for curve in range(len(bounds) - 1):
        segments = features.segments[order[bounds[curve] : bounds[curve + 1]]]
        stations = _stations(segments, features, at_corner, tree, taken, edge)
        if len(stations) < 2:
            continue
        local_points = features.points[segments]
        low, high = local_points.min((0, 1)) - 1.5 * edge, local_points.max((0, 1)) + 1.5 * edge
        if (radius := np.linalg.norm(high - low) / 2) < _SHORT_EDGES * edge:
            around = np.array(tree.query_ball_point((low + high) / 2, radius, return_sorted=True), np.int64)
        else:
            around = np.sort(by_x[np.searchsorted(sorted_x, low[0]) : np.searchsorted(sorted_x, high[0], "right")])
        place = vertices[around]
        near = around[((place >= low) & (place <= high)).all(1)]
        far, _, _ = closest_on_segments(vertices[near], features.points, segments)
        near, far = near[far < 1.5 * edge], far[far < 1.5 * edge]
        allowed[live], number[live] = np.inf, -1  # of the curve before
        allowed[near] = far
        allowed[near[taken[near]]] = np.inf
        for station in stations:
            allowed[station] = min(allowed[station] if np.isfinite(allowed[station]) else 0.0, 0.5 * edge)
        live = np.union1d(near, stations)
        low_ends = live[np.isfinite(allowed[live])]
        many = begin[low_ends + 1] - begin[low_ends]
        usable = ends[np.repeat(begin[low_ends] - np.cumsum(many) + many, many) + np.arange(many.sum())]
        usable = usable[np.isfinite(allowed[usable[:, 1]])]
        if not len(usable):
            continue
        here = np.unique(usable)
        number[here] = np.arange(len(here))
        mean = allowed[usable].mean(1) / edge
        cost = np.linalg.norm(vertices[usable[:, 0]] - vertices[usable[:, 1]], axis=1) * (1 + 8 * mean**2)
        # Edges come in the order of their ends, as the rows of a sparse matrix do.
        graph = csr_array(
            (cost, number[usable[:, 1]], np.searchsorted(number[usable[:, 0]], np.arange(len(here) + 1))),
            (len(here), len(here)),
        )
        found: list[int] = []
        for a, b in zip(stations[:-1], stations[1:], strict=True):
            if number[a] < 0 or number[b] < 0:
                continue
            length, before = dijkstra(graph, directed=False, indices=number[a], return_predecessors=True)
            if not np.isfinite(length[number[b]]):
                continue
            walk = [int(number[b])]
            while walk[-1] != number[a]:
                walk.append(int(before[walk[-1]]))
            path = here[walk]
            paths.append(np.stack([path[:-1], path[1:]], -1))
            path_curves.append(np.full(len(path) - 1, curve))
            found.extend(path.tolist())
        inner = np.array([v for v in found if not fixed[v]], np.int64)
        taken[found] = True
        curve_of[inner] = curve
        if len(inner):
            out[inner] = closest_on_segments(vertices[inner], features.points, segments)[2]
    if not paths:
        return out, Constraints(curve_of, fixed, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
    return out, Constraints(curve_of, fixed, np.concatenate(paths), np.concatenate(path_curves))


def _stations(
    segments: np.ndarray, features: Features, at_corner: dict[int, int], tree, taken: np.ndarray, edge: float
) -> list[int]:
    """Vertices the path along one curve has to visit in order: its corners; of a closed curve a few of its own, and the
    first again."""
    ordered = _ordered(segments)
    points = features.points[ordered]
    walked = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if walked[-1] < 0.75 * edge:
        return []
    closed = ordered[0] == ordered[-1]

    def vertex_at(share: float, reach: float) -> int | None:
        place = np.array([np.interp(share * walked[-1], walked, points[:, i]) for i in range(3)])
        near = tree.query(place, np.arange(1, min(_CHOICES, tree.n) + 1), distance_upper_bound=reach * edge)[1]
        return next((int(vertex) for vertex in near if vertex < tree.n and not taken[vertex]), None)

    if closed and ordered[0] not in at_corner:
        found = [vertex_at(share, 0.8) for share in (0, 1 / 4, 1 / 2, 3 / 4)]
        found = [v for i, v in enumerate(found) if v is not None and v not in found[:i]]
        return [*found, found[0]] if len(found) >= 3 else []
    a, b = at_corner.get(int(ordered[0])), at_corner.get(int(ordered[-1]))
    if a is None:
        a = vertex_at(0.0, 1.2)
    if b is None:
        b = vertex_at(1.0, 1.2)
    # A closed curve needs two places between, or the way back would be the way out.
    shares = (1 / 3, 2 / 3) if a == b else (0.5,) if walked[-1] > 12 * edge else ()
    middle = [v for v in (vertex_at(share, 0.8) for share in shares) if v is not None and v not in (a, b)]
    if a == b and len(set(middle)) < 2:
        return []
    return [v for v in (a, *middle, b) if v is not None]


def _ordered(segments: np.ndarray) -> list[int]:
    """The points of one curve in order along it; first equals last when it is closed."""
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


def untied(vertices: np.ndarray, faces: np.ndarray, constraints: Constraints) -> Constraints:
    """Without what holds three corners of a quad in a row: the middle one is let off its curve, the path is open there.

    A quad with a straight angle has no area beside it to give; a crease cut short by half a quad is the smaller fault.
    """
    from gdtool.geometry.mesh_quality import corner_jacobians, polygon_normals

    curve, fixed, path = constraints.curve.copy(), constraints.fixed.copy(), np.sort(constraints.path, 1)
    width = len(vertices) + 1
    alive = np.ones(len(path), bool)
    used = faces[:, 3] >= 0
    corner = faces[used]
    after, before = np.roll(corner, -1, 1), np.roll(corner, 1, 1)
    straight = corner_jacobians(vertices, corner, polygon_normals(vertices, corner)[0]) < _STRAIGHT

    def on_path(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.isin(np.minimum(a, b) * width + np.maximum(a, b), (path[:, 0] * width + path[:, 1])[alive])

    between = on_path(corner, after) & on_path(before, corner)
    # At a corner of the features the angle is the surface's; only one that is straight or folded has to go.
    release = np.unique(corner[between & (straight | ~fixed[corner])])
    curve[release], fixed[release] = -1, False
    alive &= ~np.isin(path, release).any(1)
    return Constraints(curve, fixed, constraints.path[alive], constraints.path_curve[alive])
