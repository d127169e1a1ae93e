"""Sharp edges: found where the surface turns, and restored where marching cubes has cut them off.

Marching cubes replaces a crease by a bevel half a cell wide. The flat or gently curved parts on both sides still know
where it was: vertices of the bevel move to where the planes of the sides meet, the least-squares point of Kobbelt et
al. 2001 (Feature sensitive surface extraction), its rank cut to the number of sides.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gdtool.geometry.normals import CHUNK, face_normals, normals_of, vertex_normals
from gdtool.geometry.topology import Edges, compact, edges_of, renumbered
from gdtool.geometry.vectors import cross, dot

_NEIGHBOURS = 24
_RINGS = 5  # of faces around a bevel, among which the sides are
_FARTHEST_EDGES = 4.0  # sides are looked for within this many edge lengths
_LARGEST_MOVE_EDGES = 1.75
_LARGEST_RESIDUAL_EDGES = 0.12
_JOIN_EDGES = 0.6  # rims of one bevel end up nearer to each other than this
_LENGTHS = 64  # steps in which the lengths of edges between rims are told apart
_SLIVERS_IN_A_ROW = 2
_LARGEST_SHARE = 0.25  # more bevel vertices than this: a rough surface, not a mechanical part


def dihedral_degrees(
    vertices: np.ndarray, faces: np.ndarray, thinnest: float = 0.0, edges: Edges | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (k, 2) with two faces, those faces (k, 2), and the angle (k,) between their normals in degrees; 0 beside
    zero-area faces.

    thinnest: a triangle whose height is a smaller share of its longest side has no direction of its own: it counts with
    the face across that side. edges: those of the faces, where they are known.
    """
    edges = edges or edges_of(faces)
    edge_idx, pairs = edges.face_pairs()
    ends = edges.ends[edge_idx]
    normals, area = face_normals(vertices, faces)
    if thinnest:
        across = _across_slivers(
            np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1), pairs, area, thinnest
        )
        normals, area = normals[across], area[across]
    cosine = np.einsum("ki,ki->k", normals[pairs[:, 0]], normals[pairs[:, 1]])
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    angle[(area[pairs] <= 0).any(1)] = 0
    return ends, pairs, angle


def _across_slivers(length: np.ndarray, pairs: np.ndarray, area: np.ndarray, thinnest: float) -> np.ndarray:
    """For faces of areas (f,) with edges of `length` (k,) between pairs (k, 2) of them: the face (f,) across the
    longest of a sliver's edges, and across that one's where it is a sliver too; all others themselves."""
    longest = np.zeros(len(area))
    for one in pairs.T:
        np.maximum.at(longest, one, length)
    sliver = 2 * area < thinnest * longest**2
    across = np.arange(len(area))
    for one, other in (pairs.T, pairs.T[::-1]):
        theirs = sliver[one] & (length == longest[one])
        across[one[theirs]] = other[theirs]
    for _ in range(_SLIVERS_IN_A_ROW):
        across = np.where(sliver[across], across[across], across)
    return across


def restore_creases(
    vertices: np.ndarray,
    faces: np.ndarray,
    crease_degrees: float = 30.0,
    accept: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, dict[str, float | int]]:
    """Bevels drawn out to the creases they cut off: vertices, faces and a report (moved, largest_move, bevel_share).

    vertices (v, 3), faces (f, 3) fine enough for a bevel to be one cell wide. Creases that are sharp already, smooth
    parts and rough surfaces stay as they are. The rims of a bevel are joined where that keeps the mesh manifold.
    accept: which of the vertices of indices (n,) may move to positions (n, 3), as bool (n,); all without it.
    """
    at, point, edge, bevel_share = _drawn_out(vertices, faces, crease_degrees, accept)
    largest = np.linalg.norm(point - vertices[at], axis=1).max(initial=0)
    report = {"moved": len(at), "largest_move": float(largest), "bevel_share": bevel_share}
    if not len(at):
        return vertices, faces, report
    out, moved = vertices.copy(), np.zeros(len(vertices), bool)
    out[at], moved[at] = point, True
    return *collapse_bevels(out, faces, moved, _JOIN_EDGES * edge), report


def _drawn_out(
    vertices: np.ndarray,
    faces: np.ndarray,
    crease_degrees: float,
    accept: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Which vertices (n,) of restore_creases move, where to (n, 3), about how long edges are, and the share of bevel
    vertices."""
    from scipy.spatial import cKDTree

    maybe, used = _maybe_bent(vertices, faces, crease_degrees / 2)
    # Only faces with both ends of a bent edge among their corners can have one: few of a fine mesh.
    few = np.flatnonzero(corners_in(faces, maybe) > 1)
    ends, pairs, angle = dihedral_degrees(vertices, faces.take(few, 0))
    bent = angle > crease_degrees / 2
    bevel = np.zeros(len(vertices), bool)
    bevel[ends[bent]] = True
    at = np.flatnonzero(bevel)
    bevel_share = len(at) / max(used, 1)
    if not len(at) or bevel_share > _LARGEST_SHARE:
        return at[:0], vertices[:0], 0.0, bevel_share
    marked, around = bevel.copy(), np.flatnonzero(corners_in(faces, bevel))
    near_bevel = around
    for _ in range(1, _RINGS):
        marked[faces.take(near_bevel, 0)] = True
        near_bevel = np.flatnonzero(corners_in(faces, marked))
    side = np.zeros(len(faces), bool)
    side[near_bevel] = True
    side[few[pairs[bent]]] = False  # they are the bevel
    side = faces.take(np.flatnonzero(side), 0)
    normals, area = face_normals(vertices, side)
    side, normals = side[area > 0], normals[area > 0]
    if len(side) < _NEIGHBOURS:
        return at[:0], vertices[:0], 0.0, bevel_share
    sampled = vertices[faces[:: max(len(faces) // 20000, 1)]]
    # Of a grid's mesh all edges are about a cell.
    edge = np.median(np.linalg.norm(sampled - np.roll(sampled, 1, 1), axis=-1))
    centroid = sum(vertices.take(corner, 0) for corner in side.T) / 3
    distance, near = cKDTree(centroid).query(vertices[at], k=_NEIGHBOURS, workers=2)
    own_places, own_faces = renumbered(faces.take(around, 0), len(vertices))
    own = vertex_normals(vertices[own_places], own_faces)[bevel[own_places]]
    # A row per coordinate (3, k, p) from here on.
    n, c = (np.ascontiguousarray(rows.T).take(np.ascontiguousarray(near.T), 1) for rows in (normals, centroid))
    valid = (_FARTHEST_EDGES * edge > distance.T) & (dot(n, own.T) > 0.1)
    cluster, sides, spread = _sides(n, valid, crease_degrees * 0.8)
    point, residual = _meeting_point(vertices[at], n, c, cluster, sides)
    move = np.linalg.norm(point - vertices[at], axis=1)
    good = (
        (sides >= 2)
        & (spread > crease_degrees * 0.8)
        & (move < _LARGEST_MOVE_EDGES * edge)
        & (residual < _LARGEST_RESIDUAL_EDGES * edge)
    )
    if accept is not None and good.any():
        good[good] = accept(at[good], point[good])
    return at[good], point[good], edge, bevel_share


def corners_in(faces: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """(f,) int8: how many corners of each of faces (f, 3) are marked (v,) bool."""
    out = np.empty(len(faces), np.int8)
    for i in range(0, len(faces), CHUNK):
        a, b, c = marked.view(np.int8).take(faces[i : i + CHUNK]).T
        out[i : i + CHUNK] = a + b + c
    return out


def _maybe_bent(vertices: np.ndarray, faces: np.ndarray, degrees: float) -> tuple[np.ndarray, int]:
    """(v,) bool: vertices that may have two faces whose normals differ by more than `degrees`, none that has is left
    out; and how many vertices have faces.

    Of d unit normals two of which are a chord c apart the mean is no longer than sqrt(1 - c^2 / (2 d)): the variance is
    the mean squared distance of the pairs, and each other normal is at least c / 2 from one of the two."""
    total, number = np.zeros((3, len(vertices))), np.zeros(len(vertices))
    rows = np.ascontiguousarray(vertices.T)
    for i in range(0, len(faces), CHUNK):
        corners = np.ascontiguousarray(faces[i : i + CHUNK].T, np.intp)
        normals = normals_of(rows, corners)[0]
        for corner in corners:
            np.add.at(number, corner, 1.0)
            for sums, values in zip(total, normals, strict=True):
                np.add.at(sums, corner, values)
    chord = 2 * np.sin(np.radians(degrees) / 2)
    return number**2 - dot(total, total) > 0.99 * chord**2 / 2 * number - 1e-9, int(np.count_nonzero(number))


def _sides(normals: np.ndarray, valid: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Group k normals (3, k, p) at each of p points into up to three sides.

    Returns the side (k, p) of each, -1 where not valid (k, p); the number of sides (p,); the largest angle (p,) between
    two."""
    point = np.arange(valid.shape[1])
    cosine_limit = np.cos(np.radians(degrees))

    def cosine_to(direction: np.ndarray) -> np.ndarray:
        return np.where(valid, dot(normals, direction), 2.0)

    first = cosine_to((normals * valid).sum(1)).argmin(0)
    to_first = cosine_to(normals[:, first, point])
    second = to_first.argmin(0)
    spread = np.degrees(np.arccos(np.clip(to_first[second, point], -1, 1)))
    to_second = cosine_to(normals[:, second, point])
    nearest = np.maximum(to_first, to_second)
    third = nearest.argmin(0)
    has_second = to_first[second, point] < cosine_limit
    has_third = has_second & (nearest[third, point] < cosine_limit)
    to_third = np.where(has_third, dot(normals, normals[:, third, point]), -2.0)
    to_second = np.where(has_second, to_second, -2.0)
    cluster = np.where(to_third > np.maximum(to_first, to_second), 2, to_second > to_first)
    cluster = np.where(valid, cluster, -1)
    enough = valid.any(0)
    return cluster, np.where(enough, 1 + has_second + has_third, 0), np.where(enough, spread, 0.0)


def _meeting_point(
    points: np.ndarray, normals: np.ndarray, centroids: np.ndarray, cluster: np.ndarray, sides: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the point nearest to points (p, 3) where the planes of their k faces' normals and centroids (3, k, p),
    grouped by cluster (k, p) into sides (p,), meet, and the rms distance (p,) to those planes."""
    weight = np.zeros(cluster.shape)
    for i in range(3):  # each side counts the same, however many of its faces are near
        mine = cluster == i
        weight += mine / np.maximum(mine.sum(0), 1)
    offset = dot(normals, centroids - points.T[:, None])
    weighted = weight * normals
    matrix = np.stack([(one * normals).sum(1) for one in weighted]).transpose(2, 0, 1)
    value, vector = np.linalg.eigh(matrix)
    # Rank = number of sides, unless three planes share a line.
    rank_ok = np.stack(
        [
            (sides == 3) & (value[:, 0] > 0.03 * value[:, 2]),
            (sides >= 2) & (value[:, 1] > 0.02 * value[:, 2]),
            sides >= 1,
        ],
        -1,
    )
    inverse = np.where(rank_ok, 1 / np.where(rank_ok, value, 1), 0)
    right = np.einsum("ikp,kp->pi", weighted, offset)
    move = np.einsum("pij,pj,pkj,pk->pi", vector, inverse, vector, right)
    residual = np.sqrt((weight * (offset - dot(normals, move.T)) ** 2).sum(0) / np.maximum(weight.sum(0), 1e-12))
    return points + move, residual


def collapse_bevels(
    vertices: np.ndarray, faces: np.ndarray, moved: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges shorter than `longest` between moved vertices: both rims of a bevel that became one crease.

    vertices (v, 3), faces (f, 3), moved (v,) bool. An edge collapses only where the mesh stays manifold (link
    condition, Dey et al. 1999) and no face with an area turns over; shorter ones first. Returns compact vertices and
    faces."""
    touches = corners_in(faces, moved)
    rims = faces[np.flatnonzero(touches > 1)].astype(np.int64)
    half = np.concatenate([rims[:, [i, (i + 1) % 3]] for i in range(3)])
    half = np.sort(half[moved[half].all(1)], 1)
    half = np.stack(np.divmod(np.unique(half[:, 0] * len(vertices) + half[:, 1]), len(vertices)), -1)
    length = np.linalg.norm(vertices[half[:, 0]] - vertices[half[:, 1]], axis=1)
    half, length = half[length < longest], length[length < longest]
    # By chance among those of about one length: along a crease each would wait for the next.
    half = half[np.lexsort((np.random.default_rng(0).permutation(len(half)), length // (longest / _LENGTHS)))]
    # Only the faces around the ends of these edges are looked at.
    ends = np.zeros(len(vertices), bool)
    ends[half.ravel()] = True
    near = np.flatnonzero(touches)
    near = near[ends[faces[near]].any(1)]
    places, local = renumbered(faces[near], len(vertices))
    rims = _Rims(vertices[places], local, longest)
    rims.collapse(np.searchsorted(places, half))
    keep = np.ones(len(faces), bool)
    keep[near[~rims.stays]] = False
    kept = np.flatnonzero(keep)
    out = faces.take(kept, 0)
    out[np.searchsorted(kept, near[rims.stays])] = places[rims.became[local[rims.stays]]]
    return compact(vertices, out)


class _Rims:
    """Vertices (v, 3) and faces (f, 3) about bevels whose short edges are collapsed; which faces stay (f,) bool, what
    each vertex became (v,)."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, longest: float):
        self._position, self._corners = np.ascontiguousarray(vertices.T), np.ascontiguousarray(faces.T)
        self._area, self._longest = _vector_area(self._position, self._corners), longest
        self._tiny = (1e-3 * longest) ** 4
        self.stays, self.became = np.ones(len(faces), bool), np.arange(len(vertices))

    def collapse(self, edges: np.ndarray) -> None:
        """Collapse edges (e, 2) in their order, each where it still can be.

        Edges that share no face around them with an earlier one are collapsed at once: the result is the same.
        """
        a, b = edges.T
        turn, near = np.arange(len(a)), np.flatnonzero(self.stays)
        while len(turn):
            marked = np.zeros(len(self.became), bool)
            marked[a] = marked[b] = True
            near = near[marked[self._corners[:, near]].any(0)]
            corners = self._corners[:, near]
            first = np.full(len(marked), turn[-1])
            np.minimum.at(first, a, turn)
            np.minimum.at(first, b, turn)
            around, of_face = np.full(len(marked), turn[-1]), first[corners].min(0)
            for corner in corners:
                np.minimum.at(around, corner, of_face)
            now = np.minimum(around[a], around[b]) >= turn
            self._joined(a[now], b[now], near, corners)
            near = near[self.stays[near]]
            a, b, turn = self.became[a[~now]], self.became[b[~now]], turn[~now]
        while (self.became[self.became] != self.became).any():
            self.became = self.became[self.became]

    def _joined(self, a: np.ndarray, b: np.ndarray, near: np.ndarray, corners: np.ndarray) -> None:
        """Edges from a (n,) to b (n,) collapsed where they can be, no two of which have a face around them in common;
        near (m,): all faces around them, with their corners (3, m)."""
        way = self._position[:, a] - self._position[:, b]
        few = (a != b) & (dot(way, way) <= self._longest**2)
        a, b = a[few], b[few]
        if not len(a):
            return
        of = np.full((2, len(self.became)), -1)
        of[0, a] = of[1, b] = np.arange(len(a))
        with_a, with_b = of[0][corners].max(0), of[1][corners].max(0)
        shared = (with_a >= 0) & (with_a == with_b)
        about = [np.unique((edge * of.shape[1] + corners)[:, edge >= 0]) for edge in (with_a, with_b)]
        common = np.intersect1d(*about, assume_unique=True) // of.shape[1]
        can = (np.bincount(with_a[shared], minlength=len(a)) == 2) & (np.bincount(common, minlength=len(a)) == 4)
        done = np.zeros(len(a), bool)
        for edge, one, other in ((with_a, a, b), (with_b, b, a)):
            moves = np.flatnonzero((edge >= 0) & ~shared & (can & ~done)[edge])
            edge, face = edge[moves], near[moves]
            after = np.where(corners[:, moves] == one[edge], other[edge], corners[:, moves])
            area, was = _vector_area(self._position, after), self._area[:, face]
            good = can & ~done
            good[edge[(was[3] > self._tiny) & (dot(was, area) <= 0.1 * np.sqrt(was[3] * area[3]))]] = False
            taken = good[edge]
            self._corners[:, face[taken]], self._area[:, face[taken]] = after[:, taken], area[:, taken]
            self.became[one[good]] = other[good]
            done |= good
        self.stays[near[shared][done[with_a[shared]]]] = False


def _vector_area(position: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Twice the area of triangles as a vector, and its square (4, n); position (3, v), corners (3, n)."""
    p, q, r = (position[:, corner] for corner in corners)
    area = cross(q - p, r - p)
    return np.concatenate([area, dot(area, area)[None]])
