"""Ray queries against a triangle mesh with Embree; hits are refined in double precision."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from gdtool.core.native import imported, require_address_space
from gdtool.core.threads import cores
from gdtool.geometry.vectors import cross, dot

# Rays handed to Embree at a time: few enough that a chunk stays in the cache, enough that threads are busy.
CHUNK = 1 << 16
# Corners above which a mesh is not tested for being convex: a second of work.
MAX_CONVEX = 200_000
# Address space that Embree reserves while it builds a tree, and crashes without: 200 MB whatever the mesh is, and for
# each face twice what was measured for 20 to 500 thousand of them on two cores.
_TREE_BYTES, _FACE_BYTES = 200_000_000, 400
_MOST_BY_PAIRS = 20_000_000  # faces times corners; of more the hull is quicker


@dataclass(frozen=True)
class Hits:
    """First hits of n rays. face_idx (n,) int32, -1 = miss; distance (n,) along the given direction, inf at a miss;
    barycentric (n, 3) weights of the face's corners, zero at a miss,
    component by component in memory."""

    face_idx: np.ndarray
    distance: np.ndarray
    barycentric: np.ndarray

    @property
    def found(self) -> np.ndarray:
        """(n,) bool."""
        return self.face_idx >= 0


def intersect_planes(
    origins: np.ndarray, directions: np.ndarray, triangles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) and barycentric weights (n, 3) where rays meet the planes of their triangles (n, 3, 3).

    Möller & Trumbore 1997 in double precision; weights are clamped to the triangle, since Embree's watertight edges
    may give a face whose exact weights are a rounding below zero. A ray inside its plane gives the nearest corner's.
    """
    a, b, c = triangles.transpose(1, 2, 0)
    return _meet(origins, directions, np.concatenate([a, b - a, c - a]))


def _meet(origins: np.ndarray, directions: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """intersect_planes for triangles (9, n): a corner and two edges. Component by component, so that every sum runs
    over numbers that lie side by side."""
    o, d, a, e1, e2 = origins.T, directions.T, triangles[:3], triangles[3:6], triangles[6:]
    p = cross(d, e2)
    determinant = dot(e1, p)
    flat = determinant == 0
    inverse = 1.0 / (np.where(flat, 1.0, determinant) if flat.any() else determinant)
    s = [o[i] - a[i] for i in range(3)]
    u = dot(s, p)
    u *= inverse
    q = cross(s, e1)
    v = dot(d, q)
    v *= inverse
    distance = dot(e2, q)
    distance *= inverse
    if flat.any():
        distance[flat] = (-dot(s, d) / dot(d, d))[flat]
        u[flat] = v[flat] = 0.0
    weights = np.stack([1.0 - u - v, u, v])
    np.clip(weights, 0.0, 1.0, out=weights)
    weights /= weights[0] + weights[1] + weights[2]
    return distance, weights.T


class RayCaster:
    """An Embree scene over one mesh.

    vertices (v, 3), faces (f, 3). The mesh is moved into a unit box before it is rounded to Embree's single precision,
    so that neither a far origin nor an odd unit costs accuracy; all arguments and results are in the caller's frame.
    Raises MemoryError where a limit on the address space leaves too little.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, threads: int | None = None):
        require_address_space(_TREE_BYTES + _FACE_BYTES * len(faces), f"rays at {len(faces)} faces")
        TriangleMesh = imported("embreex.mesh_construction").TriangleMesh
        EmbreeScene = imported("embreex.rtcore_scene").EmbreeScene
        self.vertices = np.asarray(vertices, np.float64)
        self.faces = np.asarray(faces, np.int32)
        self.threads = threads or cores()
        used = self.vertices[np.unique(self.faces)] if len(self.faces) else np.zeros((1, 3))
        low, high = used.min(0), used.max(0)
        self.center = (low + high) / 2
        extent = float((high - low).max())
        self.scale = 1.0 / extent if extent > 0 else 1.0
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        self._edges = np.concatenate([a.T, (b - a).T, (c - a).T])
        self._scene = EmbreeScene(robust=True)
        if len(self.faces):
            local = ((self.vertices - self.center) * self.scale).astype(np.float32)
            self._mesh = TriangleMesh(self._scene, local, np.ascontiguousarray(self.faces))
            # The first query builds Embree's tree, which must not happen on two threads at once.
            self._scene.run(np.full((1, 3), 9, np.float32), np.full((1, 3), 1, np.float32), query="OCCLUDED")

    def _run(self, origins: np.ndarray, directions: np.ndarray, query: str, limits: np.ndarray | None) -> np.ndarray:
        origins, directions = np.asarray(origins), np.asarray(directions)
        if origins.dtype.kind != "f":
            origins = origins.astype(np.float64)
        out = np.full(len(origins), -1, np.int32)
        if not len(self.faces) or not len(origins):
            return out

        def chunk(start: int) -> None:
            part = slice(start, start + CHUNK)
            local = np.empty((len(origins[part]), 3), np.float32)
            for i in range(3):
                np.multiply(
                    origins[part, i] - origins.dtype.type(self.center[i]),
                    origins.dtype.type(self.scale),
                    out=local[:, i],
                    casting="same_kind",
                )
            along = np.ascontiguousarray(directions[part], np.float32)
            limit = None if limits is None else np.ascontiguousarray(limits[part] * self.scale, np.float32)
            out[part] = self._scene.run(local, along, query=query, dists=limit)

        starts = range(0, len(origins), CHUNK)
        if len(starts) > 2 and self.threads > 1:
            with ThreadPoolExecutor(self.threads) as pool:
                list(pool.map(chunk, starts))
        else:
            for start in starts:
                chunk(start)
        return out

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """Return the nearest hit of each ray, from either side of a face. origins, directions (n, 3)."""
        origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        face_idx = self._run(origins, directions, "INTERSECT", None)
        distance, barycentric = np.full(len(face_idx), np.inf), np.zeros((3, len(face_idx))).T
        hit = np.flatnonzero(face_idx >= 0)
        if len(hit) == len(face_idx):
            distance, barycentric = _meet(origins, directions, np.take(self._edges, face_idx, axis=1))
        elif len(hit):
            found = np.take(self._edges, face_idx[hit], axis=1)
            distance[hit], barycentric[hit] = _meet(
                origins.T.take(hit, axis=1).T, directions.T.take(hit, axis=1).T, found
            )
        return Hits(face_idx, distance, barycentric)

    def occluded(
        self, origins: np.ndarray, directions: np.ndarray, max_distance: float | np.ndarray = np.inf
    ) -> np.ndarray:
        """(n,) bool: whether anything lies on each ray before max_distance (in units of the direction's length)."""
        limits = None
        if np.ndim(max_distance) or np.isfinite(max_distance):
            limits = np.minimum(
                np.broadcast_to(np.asarray(max_distance, np.float64), (len(origins),)), 1e30 / self.scale
            )
        return self._run(origins, directions, "OCCLUDED", limits) >= 0


def is_convex(vertices: np.ndarray, faces: np.ndarray, tolerance: float = 1e-6) -> bool:
    """Whether all faces lie on the hull of their corners, so that none hides another from outside.

    Each face's plane must have everything on one side (to tolerance, of the longest side). A scatter of faces is
    tested first: nearly every mesh that is not convex fails there. Those of many faces are held
    against the hull (Qhull): no middle of a face may lie deeper in it than the tolerance.
    """
    from gdtool.geometry.normals import face_normals

    used = np.unique(faces)
    if not len(used) or len(used) > MAX_CONVEX:
        return False
    points = vertices[used]
    extent = float((points.max(0) - points.min(0)).max())
    normals, areas = face_normals(vertices, faces)
    solid = np.flatnonzero(areas > 1e-12 * extent**2)
    few = solid[:: max(1, len(solid) // 64)]
    if not _all_before(vertices, faces, normals, few, points, tolerance * extent):
        return False
    if len(solid) * len(points) > _MOST_BY_PAIRS and (away := _off_hull(vertices, faces[solid], points)) is not None:
        return away <= tolerance * extent
    return _all_before(vertices, faces, normals, solid, points, tolerance * extent)


def _all_before(
    vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray, chosen: np.ndarray, points: np.ndarray, height: float
) -> bool:
    """Whether the planes of the chosen faces have all points on one side, but for that height."""
    for start in range(0, len(chosen), 512):
        part = chosen[start : start + 512]
        over = normals[part] @ points.T - np.einsum("ij,ij->i", normals[part], vertices[faces[part, 0]])[:, None]
        if (np.minimum(over.max(1), -over.min(1)) > height).any():
            return False
    return True


def _off_hull(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> float | None:
    """How far the middle of a face is within the hull of points (n, 3) at most; None where they lie in a plane.

    What has its middle on the hull lies on it: the plane that touches the hull there has none of the face before it.
    """
    from scipy.spatial import ConvexHull, QhullError

    from gdtool.geometry.distance import closest_points

    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    middle = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3
    return float(closest_points(middle, points, hull.simplices.astype(np.int64))[0].max())
