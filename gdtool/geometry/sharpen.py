"""Measure dihedral angles, and restore the creases that marching cubes cuts off.

Marching cubes replaces a crease by a bevel about a cell wide. The flat or gently curved sides next to it still show
where the crease was: vertices of the bevel move to where the planes of the sides meet. This is the least-squares point
of Kobbelt et al. 2001 (Feature sensitive surface extraction), with its rank limited to the number of sides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import CHUNK, face_normals, normals_of, vertex_normals
from gdtool.geometry.topology import Edges, compact, edges_of, renumbered
from gdtool.geometry.vectors import cross, dot

_NEIGHBOURS = 24  # faces whose planes a bevel vertex is moved to
_RINGS = 5  # rings of faces around a bevel among which these are sought
_MAX_SIDE_EDGES = 4.0  # edge lengths from a bevel vertex within which these are sought
_MAX_MOVE_EDGES = 1.75  # edge lengths: a vertex that would move farther does not belong to a bevel
_MAX_RESIDUAL_EDGES = 0.12  # rms edge lengths from the sides' planes: sides that fit worse are curved
_JOIN_EDGES = 0.6  # edge lengths: both rims of a restored bevel end up nearer to each other than this
_LENGTH_STEPS = 64  # steps in which the lengths of edges between rims are compared
_MAX_SLIVER_CHAIN = 2  # slivers in a row across which the next proper face is sought
_MAX_BEVEL_SHARE = 0.25  # of the vertices: with more in bevels the surface is rough, not a mechanical part


def dihedral_degrees(
    mesh: TriMesh, thinnest: float = 0.0, edges: Edges | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure the angle between the normals of the two faces at each edge.

    Returns the edges (k, 2) with two faces, those faces (k, 2), and the angle (k,) in degrees, 0 beside faces without
    area. thinnest: a ratio of height to longest side. A triangle below it is a sliver without a reliable normal, and
    takes the normal of the face across its longest side. edges: the edges of the mesh, where they are known.
    """
    vertices = mesh.vertices
    edges = edges or edges_of(mesh.faces)
    edge_idx, pairs = edges.face_pairs()
    ends = edges.ends[edge_idx]
    normals, area = face_normals(mesh)
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
    """Return for each face (f,) the face whose normal it takes: itself, or for a sliver the face across its longest
    edge.

    Where that face is a sliver too, the search goes on across its longest edge. length (k,): of the edges between pairs
    (k, 2) of faces; area (f,) of the faces. thinnest: the ratio of height to longest side below which a face is a
    sliver.
    """
    longest = np.zeros(len(area))
    for face in pairs.T:
        np.maximum.at(longest, face, length)
    sliver = 2 * area < thinnest * longest**2
    across = np.arange(len(area))
    for face, neighbour in (pairs.T, pairs.T[::-1]):
        at_longest = sliver[face] & (length == longest[face])
        across[face[at_longest]] = neighbour[at_longest]
    for _ in range(_MAX_SLIVER_CHAIN):
        across = np.where(sliver[across], across[across], across)
    return across


class RestoredCreases(NamedTuple):
    """Hold a mesh with restored creases.

    moved: how many vertices moved; largest_move: how far at most, in the mesh's unit; bevel_share: the share of
    vertices in bevels.
    """

    mesh: TriMesh
    moved: int
    largest_move: float
    bevel_share: float


def restore_creases(
    mesh: TriMesh,
    crease_degrees: float = 30.0,
    accept: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> RestoredCreases:
    """Move the vertices of bevels to the creases that the bevels cut off.

    The mesh has to be so fine that a bevel is one cell wide, as marching cubes makes it. Creases that are sharp
    already, smooth parts and rough surfaces stay as they are. The rims of a bevel are joined where that keeps the mesh
    manifold. crease_degrees: the least angle of a crease. accept: called with vertex indices (n,) and positions (n, 3),
    returns (n,) bool: which of the vertices may move there; None lets all move.
    """
    vertices = mesh.vertices
    moves = _crease_moves(mesh, crease_degrees, accept)
    largest = float(np.linalg.norm(moves.position - vertices[moves.vertex_idx], axis=1).max(initial=0))
    if len(moves.vertex_idx):
        out, moved = vertices.copy(), np.zeros(len(vertices), bool)
        out[moves.vertex_idx], moved[moves.vertex_idx] = moves.position, True
        mesh = collapse_bevels(TriMesh(out, mesh.faces), moved, _JOIN_EDGES * moves.edge)
    return RestoredCreases(mesh, len(moves.vertex_idx), largest, moves.bevel_share)


class _CreaseMoves(NamedTuple):
    """Hold which vertices (n,) move and where (n, 3), the median edge length, and the share of vertices in bevels."""

    vertex_idx: np.ndarray
    position: np.ndarray
    edge: float
    bevel_share: float


def _crease_moves(
    mesh: TriMesh,
    crease_degrees: float,
    accept: Callable[[np.ndarray, np.ndarray], np.ndarray] | None,
) -> _CreaseMoves:
    """Find which vertices restore_creases() moves, and where to. The arguments are those of restore_creases()."""
    from scipy.spatial import cKDTree

    vertices, faces = mesh.vertices, mesh.faces
    maybe, used = _may_be_bent(mesh, crease_degrees / 2)
    # Only a face with both ends of a bent edge among its corners can have one: these are few in a fine mesh.
    candidates = np.flatnonzero(marked_corner_counts(faces, maybe) > 1)
    ends, pairs, angle = dihedral_degrees(TriMesh(vertices, faces.take(candidates, 0)))
    bent = angle > crease_degrees / 2
    bevel = np.zeros(len(vertices), bool)
    bevel[ends[bent]] = True
    at = np.flatnonzero(bevel)
    bevel_share = len(at) / max(used, 1)
    if not len(at) or bevel_share > _MAX_BEVEL_SHARE:
        return _CreaseMoves(at[:0], vertices[:0], 0.0, bevel_share)
    marked, around = bevel.copy(), np.flatnonzero(marked_corner_counts(faces, bevel))
    near_bevel = around
    for _ in range(1, _RINGS):
        marked[faces.take(near_bevel, 0)] = True
        near_bevel = np.flatnonzero(marked_corner_counts(faces, marked))
    side = np.zeros(len(faces), bool)
    side[near_bevel] = True
    side[candidates[pairs[bent]]] = False  # these faces are the bevel
    side = faces.take(np.flatnonzero(side), 0)
    normals, area = face_normals(TriMesh(vertices, side))
    side, normals = side[area > 0], normals[area > 0]
    if len(side) < _NEIGHBOURS:
        return _CreaseMoves(at[:0], vertices[:0], 0.0, bevel_share)
    sampled = vertices[faces[:: max(len(faces) // 20000, 1)]]
    # In a mesh from a grid all edges are about as long as a cell.
    edge = np.median(np.linalg.norm(sampled - np.roll(sampled, 1, 1), axis=-1))
    centroid = sum(vertices.take(corner, 0) for corner in side.T) / 3
    distance, near = cKDTree(centroid).query(vertices[at], k=_NEIGHBOURS, workers=2)
    around_idx, around_faces = renumbered(faces.take(around, 0), len(vertices))
    bevel_normals = vertex_normals(TriMesh(vertices[around_idx], around_faces))[bevel[around_idx]]
    # From here on arrays are (3, k, p): a row for each coordinate, k neighbours of p vertices.
    n, c = (np.ascontiguousarray(rows.T).take(np.ascontiguousarray(near.T), 1) for rows in (normals, centroid))
    valid = (_MAX_SIDE_EDGES * edge > distance.T) & (dot(n, bevel_normals.T) > 0.1)
    cluster, sides, spread = _group_into_sides(n, valid, crease_degrees * 0.8)
    point, residual = _meeting_point(vertices[at], n, c, cluster, sides)
    move = np.linalg.norm(point - vertices[at], axis=1)
    good = (
        (sides >= 2)
        & (spread > crease_degrees * 0.8)
        & (move < _MAX_MOVE_EDGES * edge)
        & (residual < _MAX_RESIDUAL_EDGES * edge)
    )
    if accept is not None and good.any():
        good[good] = accept(at[good], point[good])
    return _CreaseMoves(at[good], point[good], edge, bevel_share)


def marked_corner_counts(faces: np.ndarray, marked: np.ndarray) -> np.ndarray:
    """Return how many corners of each of faces (f, 3) are marked (v,) bool; (f,) int8."""
    out = np.empty(len(faces), np.int8)
    for i in range(0, len(faces), CHUNK):
        a, b, c = marked.view(np.int8).take(faces[i : i + CHUNK]).T
        out[i : i + CHUNK] = a + b + c
    return out


def _may_be_bent(mesh: TriMesh, degrees: float) -> tuple[np.ndarray, int]:
    """Return (v,) bool: a superset of the vertices where the normals of two faces differ by more than `degrees`.

    Also returns how many vertices have faces.

    A vertex is left out where the mean of its d unit normals is too long. If two of the normals are a chord c apart,
    the mean is no longer than sqrt(1 - c^2 / (2 d)). The reason: 1 minus the squared length of the mean is the
    variance, which is half the mean squared distance of all pairs of normals. The squared distances of every further
    normal to those two sum to c^2 / 2 or more, so the variance is at least c^2 / (2 d).
    """
    vertices, faces = mesh.vertices, mesh.faces
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


def _group_into_sides(
    normals: np.ndarray, valid: np.ndarray, degrees: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Group k normals (3, k, p) at each of p points into up to three sides that differ by more than `degrees`.

    valid (k, p): which normals count. Returns the side (k, p) of each normal, -1 where it does not count; the number
    of sides (p,); and the largest angle (p,) between two normals, in degrees.
    """
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
    """Find the point nearest to each of points (p, 3) where the planes of the k faces around it meet.

    normals and centroids (3, k, p) of the faces. cluster (k, p): the side that each face belongs to, and sides (p,):
    the number of sides, both as from _group_into_sides(). Two sides meet in a line, three in a point. Returns the
    meeting points (p, 3) and the rms distance (p,) from them to the planes.
    """
    weight = np.zeros(cluster.shape)
    for i in range(3):  # each side counts the same, however many of its faces are near
        in_side = cluster == i
        weight += in_side / np.maximum(in_side.sum(0), 1)
    offset = dot(normals, centroids - points.T[:, None])
    weighted = weight * normals
    matrix = np.stack([(row * normals).sum(1) for row in weighted]).transpose(2, 0, 1)
    value, vector = np.linalg.eigh(matrix)
    # The rank is the number of sides, unless three planes share a line.
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


def collapse_bevels(mesh: TriMesh, moved: np.ndarray, longest: float) -> TriMesh:
    """Collapse edges shorter than `longest` between moved vertices: the two rims of a bevel that became one crease.

    moved (v,) bool. Shorter edges go first; an edge collapses only where the mesh stays manifold (link condition, Dey
    et al. 1999) and no face with an area turns over. The result has no unused vertices.
    """
    vertices, faces = mesh.vertices, mesh.faces
    touches = marked_corner_counts(faces, moved)
    rims = faces[np.flatnonzero(touches > 1)].astype(np.int64)
    half = np.concatenate([rims[:, [i, (i + 1) % 3]] for i in range(3)])
    half = np.sort(half[moved[half].all(1)], 1)
    half = np.stack(np.divmod(np.unique(half[:, 0] * len(vertices) + half[:, 1]), len(vertices)), -1)
    length = np.linalg.norm(vertices[half[:, 0]] - vertices[half[:, 1]], axis=1)
    half, length = half[length < longest], length[length < longest]
    # Edges of about one length come in random order: in order along a crease, each would wait for the next.
    half = half[np.lexsort((np.random.default_rng(0).permutation(len(half)), length // (longest / _LENGTH_STEPS)))]
    # Only the faces around the ends of these edges are looked at.
    ends = np.zeros(len(vertices), bool)
    ends[half.ravel()] = True
    near = np.flatnonzero(touches)
    near = near[ends[faces[near]].any(1)]
    local_idx, local = renumbered(faces[near], len(vertices))
    collapser = _Rims(TriMesh(vertices[local_idx], local), longest)
    collapser.collapse(np.searchsorted(local_idx, half))
    keep = np.ones(len(faces), bool)
    keep[near[~collapser.stays]] = False
    kept_faces = np.flatnonzero(keep)
    out = faces.take(kept_faces, 0)
    out[np.searchsorted(kept_faces, near[collapser.stays])] = local_idx[collapser.became[local[collapser.stays]]]
    return compact(TriMesh(vertices, out))


class _Rims:
    """Collapse short edges among the faces around bevels.

    stays (f,) bool: which faces are left; became (v,): the vertex that each vertex was merged into, or itself.
    """

    def __init__(self, mesh: TriMesh, longest: float):
        self._position, self._corners = np.ascontiguousarray(mesh.vertices.T), np.ascontiguousarray(mesh.faces.T)
        self._area, self._longest = _vector_area(self._position, self._corners), longest
        self._tiny = (1e-3 * longest) ** 4  # squared area below which a face has none
        self.stays, self.became = np.ones(len(mesh.faces), bool), np.arange(len(mesh.vertices))

    def collapse(self, edges: np.ndarray) -> None:
        """Collapse edges (e, 2) in their order, skipping each that can no longer be collapsed.

        Edges that share no face around them with an earlier one are collapsed together; the result is the same.
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
            self._collapse_independent(a[now], b[now], near, corners)
            near = near[self.stays[near]]
            a, b, turn = self.became[a[~now]], self.became[b[~now]], turn[~now]
        while (self.became[self.became] != self.became).any():
            self.became = self.became[self.became]

    def _collapse_independent(self, a: np.ndarray, b: np.ndarray, near: np.ndarray, corners: np.ndarray) -> None:
        """Collapse edges from vertices a (n,) to b (n,), except where that would break the mesh; their faces must not
        overlap.

        near (m,): all faces around the edges, with corners (3, m).
        """
        along = self._position[:, a] - self._position[:, b]
        short = (a != b) & (dot(along, along) <= self._longest**2)
        a, b = a[short], b[short]
        if not len(a):
            return
        edge_of = np.full((2, len(self.became)), -1)
        edge_of[0, a] = edge_of[1, b] = np.arange(len(a))
        with_a, with_b = edge_of[0][corners].max(0), edge_of[1][corners].max(0)
        shared = (with_a >= 0) & (with_a == with_b)
        about = [np.unique((edge * edge_of.shape[1] + corners)[:, edge >= 0]) for edge in (with_a, with_b)]
        common = np.intersect1d(*about, assume_unique=True) // edge_of.shape[1]
        can = (np.bincount(with_a[shared], minlength=len(a)) == 2) & (np.bincount(common, minlength=len(a)) == 4)
        done = np.zeros(len(a), bool)
        for edge, start, end in ((with_a, a, b), (with_b, b, a)):
            moves = np.flatnonzero((edge >= 0) & ~shared & (can & ~done)[edge])
            edge, face = edge[moves], near[moves]
            after = np.where(corners[:, moves] == start[edge], end[edge], corners[:, moves])
            area, was = _vector_area(self._position, after), self._area[:, face]
            good = can & ~done
            good[edge[(was[3] > self._tiny) & (dot(was, area) <= 0.1 * np.sqrt(was[3] * area[3]))]] = False
            collapses = good[edge]
            self._corners[:, face[collapses]], self._area[:, face[collapses]] = after[:, collapses], area[:, collapses]
            self.became[start[good]] = end[good]
            done |= good
        self.stays[near[shared][done[with_a[shared]]]] = False


def _vector_area(position: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return twice the area of triangles as a vector, and its square, (4, n); position (3, v), corners (3, n)."""
    p, q, r = (position[:, corner] for corner in corners)
    area = cross(q - p, r - p)
    return np.concatenate([area, dot(area, area)[None]])
