"""Sharp edges: found where the surface turns, and restored where marching cubes has cut them off.

Marching cubes replaces a crease by a bevel half a cell wide. The flat or gently curved parts on both sides still know
where it was: vertices of the bevel move to where the planes of the sides meet, the least-squares point of Kobbelt et
al. 2001 (Feature sensitive surface extraction), its rank cut to the number of sides.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from gdtool.geometry.normals import face_normals, vertex_normals
from gdtool.geometry.repair import edges_of

_NEIGHBOURS = 24
_RINGS = 5  # of faces around a bevel, among which the sides are
_FARTHEST_EDGES = 4.0  # sides are looked for within this many edge lengths
_LARGEST_MOVE_EDGES = 1.75
_LARGEST_RESIDUAL_EDGES = 0.12
_JOIN_EDGES = 0.6  # rims of one bevel end up nearer to each other than this
_SLIVERS_IN_A_ROW = 2
_LARGEST_SHARE = 0.25  # more bevel vertices than this: a rough surface, not a mechanical part


def dihedral_degrees(vertices: np.ndarray, faces: np.ndarray, thinnest: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges (k, 2) with two faces, those faces (k, 2), and the angle (k,) between their normals in degrees; 0 beside zero-area faces.

    thinnest: a triangle whose height is a smaller share of its longest side has no direction of its own: it counts with
    the face across that side.
    """
    edges = edges_of(faces)
    edge_idx, pairs = edges.face_pairs()
    ends = edges.ends[edge_idx]
    normals, area = face_normals(vertices, faces)
    if thinnest:
        across = _across_slivers(np.linalg.norm(vertices[ends[:, 0]] - vertices[ends[:, 1]], axis=1), pairs, area, thinnest)
        normals, area = normals[across], area[across]
    cosine = np.einsum("ki,ki->k", normals[pairs[:, 0]], normals[pairs[:, 1]])
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    angle[(area[pairs] <= 0).any(1)] = 0
    return ends, pairs, angle


def _across_slivers(length: np.ndarray, pairs: np.ndarray, area: np.ndarray, thinnest: float) -> np.ndarray:
    """For faces of areas (f,) with edges of `length` (k,) between pairs (k, 2) of them: the face (f,) across the longest of a
    sliver's edges, and across that one's where it is a sliver too; all others themselves."""
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


def restore_creases(vertices: np.ndarray, faces: np.ndarray, crease_degrees: float = 30.0,
                    accept: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None) -> tuple[np.ndarray, np.ndarray, dict[str, float | int]]:
    """Bevels drawn out to the creases they cut off: vertices, faces and a report (moved, largest_move, bevel_share).

    vertices (v, 3), faces (f, 3) fine enough for a bevel to be one cell wide. Creases that are sharp already, smooth
    parts and rough surfaces stay as they are. The rims of a bevel are joined where that keeps the mesh manifold.
    accept: which of the vertices of indices (n,) may move to positions (n, 3), as bool (n,); all without it.
    """
    report: dict[str, float | int] = {"moved": 0, "largest_move": 0.0, "bevel_share": 0.0}
    normals, area = face_normals(vertices, faces)
    bevel, rough = np.zeros(len(vertices), bool), np.zeros(len(faces), bool)
    # Only faces with both ends of a bent edge among their corners can have one: few of a fine mesh.
    columns = np.ascontiguousarray(faces.T)
    maybe = _maybe_bent(normals, columns, len(vertices), crease_degrees / 2).astype(np.int8)
    few = np.flatnonzero(maybe[columns[0]] + maybe[columns[1]] + maybe[columns[2]] > 1)
    ends, pairs, angle = dihedral_degrees(vertices, faces[few])
    bent = angle > crease_degrees / 2
    bevel[ends[bent].ravel()] = True
    rough[few[pairs[bent].ravel()]] = True
    used = np.zeros(len(vertices), bool)
    used[columns] = True
    report["bevel_share"] = float(bevel.sum() / used.sum())
    near_bevel, marked = np.zeros(len(faces), bool), bevel.copy()
    for _ in range(_RINGS):
        near_bevel = marked[columns[0]] | marked[columns[1]] | marked[columns[2]]
        marked[faces[near_bevel].ravel()] = True
    side = np.flatnonzero(near_bevel & ~rough & (area > 0))
    if not bevel.any() or report["bevel_share"] > _LARGEST_SHARE or len(side) < _NEIGHBOURS:
        return vertices, faces, report
    sampled = vertices[faces[::max(len(faces) // 20000, 1)]]
    edge = np.median(np.linalg.norm(sampled - np.roll(sampled, 1, 1), axis=-1))  # of a grid's mesh all edges are about a cell
    at = np.flatnonzero(bevel)
    centroid = vertices[faces[side]].mean(1)
    distance, near = cKDTree(centroid).query(vertices[at], k=_NEIGHBOURS, workers=2)
    own = vertex_normals(vertices, faces[near_bevel])[at]
    n, c = normals[side][near], centroid[near]
    valid = (distance < _FARTHEST_EDGES * edge) & ((n * own[:, None]).sum(-1) > 0.1)
    cluster, sides, spread = _sides(n, valid, crease_degrees * 0.8)
    point, residual = _meeting_point(vertices[at], n, c, cluster, sides)
    move = np.linalg.norm(point - vertices[at], axis=1)
    good = (sides >= 2) & (spread > crease_degrees * 0.8) & (move < _LARGEST_MOVE_EDGES * edge) & (residual < _LARGEST_RESIDUAL_EDGES * edge)
    if accept is not None and good.any():
        good[good] = accept(at[good], point[good])
    out = vertices.copy()
    out[at[good]] = point[good]
    if not good.any():
        return vertices, faces, report
    report["moved"], report["largest_move"] = int(good.sum()), float(move[good].max())
    moved = np.zeros(len(vertices), bool)
    moved[at[good]] = True
    return *collapse_bevels(out, faces, moved, _JOIN_EDGES * edge), report


def _maybe_bent(normals: np.ndarray, columns: np.ndarray, count: int, degrees: float) -> np.ndarray:
    """(v,) bool: vertices that may have two faces whose normals differ by more than `degrees`; none that has is left out.

    columns (3, f) are the faces' corners. Of d unit normals two of which are a chord c apart the mean is no longer than
    sqrt(1 - c^2 / (2 d)): the variance is the mean squared distance of the pairs, and each other normal is at least c / 2
    from one of the two.
    """
    # Row v of this matrix adds up the faces of vertex v: a product is several times faster than a bincount per coordinate.
    f = columns.shape[1]
    adds = csr_array((np.ones(3 * f), columns.T.ravel(), np.arange(0, 3 * f + 1, 3)), (f, count)).T
    total = adds @ np.column_stack([normals, (normals != 0).any(1)])
    number = total[:, 3]
    chord = 2 * np.sin(np.radians(degrees) / 2)
    return number**2 - (total[:, :3] ** 2).sum(1) > 0.99 * chord**2 / 2 * number - 1e-9


def _sides(normals: np.ndarray, valid: np.ndarray, degrees: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Group k normals (p, k, 3) at each point into up to three sides.

    Returns the side (p, k) of each, -1 where not valid; the number of sides (p,); the largest angle (p,) between two.
    """
    p, k = valid.shape
    row = np.arange(p)
    cosine_limit = np.cos(np.radians(degrees))

    def masked(cosine: np.ndarray) -> np.ndarray:
        return np.where(valid, cosine, 2.0)

    mean = (normals * valid[..., None]).sum(1)
    first = masked((normals * mean[:, None]).sum(-1)).argmin(1)
    to_first = masked((normals * normals[row, first][:, None]).sum(-1))
    second = to_first.argmin(1)
    spread = np.degrees(np.arccos(np.clip(to_first[row, second], -1, 1)))
    to_second = masked((normals * normals[row, second][:, None]).sum(-1))
    nearest = np.where(valid, np.maximum(to_first, to_second), 2.0)
    third = nearest.argmin(1)
    has_second = to_first[row, second] < cosine_limit
    has_third = has_second & (nearest[row, third] < cosine_limit)
    to_third = np.where(has_third[:, None], (normals * normals[row, third][:, None]).sum(-1), -2.0)
    to_second = np.where(has_second[:, None], to_second, -2.0)
    cluster = np.stack([to_first, to_second, to_third], -1).argmax(-1)
    cluster = np.where(valid, cluster, -1)
    enough = valid.any(1)
    return cluster, np.where(enough, 1 + has_second + has_third, 0), np.where(enough, spread, 0.0)


def _meeting_point(points: np.ndarray, normals: np.ndarray, centroids: np.ndarray, cluster: np.ndarray,
                   sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point nearest to points (p, 3) where the sides' planes meet, and the rms distance (p,) to those planes."""
    weight = np.zeros(cluster.shape)
    for i in range(3):  # each side counts the same, however many of its faces are near
        mine = cluster == i
        weight += mine / np.maximum(mine.sum(1, keepdims=True), 1)
    offset = (normals * (centroids - points[:, None])).sum(-1)
    matrix = np.einsum("pk,pki,pkj->pij", weight, normals, normals)
    value, vector = np.linalg.eigh(matrix)
    # Rank = number of sides, unless three planes share a line.
    rank_ok = np.stack([(sides == 3) & (value[:, 0] > 0.03 * value[:, 2]), (sides >= 2) & (value[:, 1] > 0.02 * value[:, 2]), sides >= 1], -1)
    inverse = np.where(rank_ok, 1 / np.where(rank_ok, value, 1), 0)
    right = np.einsum("pk,pki,pk->pi", weight, normals, offset)
    move = np.einsum("pij,pj,pkj,pk->pi", vector, inverse, vector, right)
    residual = np.sqrt((weight * (offset - (normals * move[:, None]).sum(-1)) ** 2).sum(1) / np.maximum(weight.sum(1), 1e-12))
    return points + move, residual


def collapse_bevels(vertices: np.ndarray, faces: np.ndarray, moved: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges shorter than `longest` between moved vertices: both rims of a bevel that became one crease.

    vertices (v, 3), faces (f, 3), moved (v,) bool. An edge collapses only where the mesh stays manifold (link condition,
    Dey et al. 1999) and no face with an area turns over. Returns compact vertices and faces.
    """
    from gdtool.geometry.repair import compact

    columns = np.ascontiguousarray(faces.T)
    corners = moved.astype(np.int8)
    rims = faces[corners[columns[0]] + corners[columns[1]] + corners[columns[2]] > 1]
    half = np.concatenate([rims[:, [i, (i + 1) % 3]] for i in range(3)])
    half = np.unique(np.sort(half[moved[half].all(1)], 1), axis=0)
    length = np.linalg.norm(vertices[half[:, 0]] - vertices[half[:, 1]], axis=1)
    order = np.argsort(length, kind="stable")
    half = half[order[length[order] < longest]]
    # Only the faces around the ends of these edges are looked at.
    ends = np.zeros(len(vertices), bool)
    ends[half.ravel()] = True
    near = np.flatnonzero(ends[columns[0]] | ends[columns[1]] | ends[columns[2]])
    local = dict(zip(near.tolist(), faces[near].tolist(), strict=True))
    ring: dict[int, set[int]] = {v: set() for v in np.flatnonzero(ends).tolist()}  # the faces around each end
    for i, face in local.items():
        for v in face:
            if v in ring:
                ring[v].add(i)
    places = np.unique(faces[near])
    position = dict(zip(places.tolist(), vertices[places].tolist(), strict=True))
    became: dict[int, int] = {}

    def last(v: int) -> int:
        while v in became:
            v = became[v]
        return v

    tiny = (1e-3 * longest) ** 2
    gone: set[int] = set()
    for a, b in half.tolist():
        a, b = last(a), last(b)
        if a == b:
            continue
        if _squared(position[a], position[b]) > longest * longest:
            continue
        shared = ring[a] & ring[b]
        if len(shared) != 2:
            continue
        around_a = set().union(*map(local.__getitem__, ring[a]))
        around_b = set().union(*map(local.__getitem__, ring[b]))
        if len(around_a & around_b) != 4:
            continue
        if _turns(a, b, shared, ring, local, position, tiny):
            if _turns(b, a, shared, ring, local, position, tiny):
                continue
            a, b = b, a
        for i in shared:
            for v in local[i]:
                if v in ring:
                    ring[v].discard(i)
            gone.add(i)
        for i in ring[a]:
            local[i] = [b if v == a else v for v in local[i]]
            ring[b].add(i)
        ring[a] = set()
        became[a] = b
    out = faces.copy()
    keep = np.ones(len(faces), bool)
    out[near] = np.array(list(local.values()), faces.dtype).reshape(-1, 3)
    keep[list(gone)] = False
    return compact(vertices, out[keep])


def _squared(a: list[float], b: list[float]) -> float:
    return (a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2


def _vector_area(p: list[float], q: list[float], r: list[float]) -> tuple[float, float, float]:
    ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _turns(a: int, b: int, shared: set[int], ring: dict, local: dict, position: dict, tiny: float) -> bool:
    """Whether moving vertex a to b turns a face over that has an area."""
    onto = position[b]
    for i in ring[a] - shared:
        one, two, three = local[i]
        one_at, two_at, three_at = position[one], position[two], position[three]
        x, y, z = _vector_area(one_at, two_at, three_at)
        before = x * x + y * y + z * z
        if before <= tiny * tiny:
            continue
        p, q, r = _vector_area(onto if one == a else one_at, onto if two == a else two_at, onto if three == a else three_at)
        after = p * p + q * q + r * r
        if x * p + y * q + z * r <= 0.1 * (before * after) ** 0.5:
            return True
    return False
