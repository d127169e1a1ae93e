"""Cast rays at a triangle mesh with Embree, and refine hits in double precision."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from gdtool.core.native import imported, require_address_space
from gdtool.core.threads import cores
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.vectors import cross, dot

# Rays passed to Embree at a time: few enough that a chunk stays in the cache, enough that threads are busy.
CHUNK = 1 << 16
# Vertices above which a mesh is not tested for convexity, which would take more than a second.
MAX_CONVEX = 200_000
# Address space in bytes that Embree reserves while it builds a tree, and crashes without: for any mesh, and for each
# face. The latter is twice what was measured with 20 to 500 thousand faces on two cores.
_TREE_BYTES, _FACE_BYTES = 200_000_000, 400
_MAX_PAIRS = 20_000_000  # faces times vertices, above which comparing with the convex hull is quicker


@dataclass(frozen=True)
class Hits:
    """Hold the nearest hits of n rays.

    face_idx (n,) int32, -1 for a miss; distance (n,) in units of the direction's length, inf for a miss; barycentric
    (n, 3) weights of the face's corners, 0 for a miss, component by component in memory.
    """

    face_idx: np.ndarray
    distance: np.ndarray
    barycentric: np.ndarray

    @property
    def is_hit(self) -> np.ndarray:
        """(n,) bool: which rays hit."""
        return self.face_idx >= 0


def intersect_planes(origins: np.ndarray, directions: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distance (n,) and barycentric weights (n, 3) where rays meet the planes of triangles, corners (n, 3, 3).

    Möller & Trumbore 1997 in double precision. Weights are clamped to the triangle, because Embree's watertight edges
    may return a face whose exact weights are a rounding error below zero. A ray inside its plane gets the nearest
    corner.
    """
    a, b, c = corners.transpose(1, 2, 0)
    return _intersect(origins, directions, np.concatenate([a, b - a, c - a]))


def _intersect(origins: np.ndarray, directions: np.ndarray, packed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distance (n,) and barycentric weights (n, 3) where rays meet the planes of triangles, as
    intersect_planes().

    packed (9, n): a corner and two edge vectors of each triangle, each component contiguous.
    """
    o, d, a, e1, e2 = origins.T, directions.T, packed[:3], packed[3:6], packed[6:]
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
    """Cast rays at one mesh with Embree, and refine the hits in double precision.

    The mesh is moved into a unit box before it is rounded to Embree's single precision, so that neither a far origin
    nor an odd unit costs accuracy; all arguments and results are in the caller's frame. Raises MemoryError where a
    limit on the address space leaves too little.
    """

    def __init__(self, mesh: TriMesh, threads: int | None = None):
        face_count = len(mesh.faces)
        require_address_space(_TREE_BYTES + _FACE_BYTES * face_count, f"rays at {face_count} faces")
        TriangleMesh = imported("embreex.mesh_construction").TriangleMesh
        EmbreeScene = imported("embreex.rtcore_scene").EmbreeScene
        self.vertices = np.asarray(mesh.vertices, np.float64)
        self.faces = np.asarray(mesh.faces, np.int32)
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
        """Run one kind of query ("INTERSECT" or "OCCLUDED") on all rays; return (n,) int32 as Embree does."""
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
            distance, barycentric = _intersect(origins, directions, np.take(self._edges, face_idx, axis=1))
        elif len(hit):
            packed = np.take(self._edges, face_idx[hit], axis=1)
            distance[hit], barycentric[hit] = _intersect(
                origins.T.take(hit, axis=1).T, directions.T.take(hit, axis=1).T, packed
            )
        return Hits(face_idx, distance, barycentric)

    def occluded(
        self, origins: np.ndarray, directions: np.ndarray, max_distance: float | np.ndarray = np.inf
    ) -> np.ndarray:
        """Return (n,) bool: whether anything lies on each ray before max_distance.

        origins, directions (n, 3). max_distance: one number or (n,), in units of the direction's length.
        """
        limits = None
        if np.ndim(max_distance) or np.isfinite(max_distance):
            limits = np.minimum(
                np.broadcast_to(np.asarray(max_distance, np.float64), (len(origins),)), 1e30 / self.scale
            )
        return self._run(origins, directions, "OCCLUDED", limits) >= 0


def is_convex(mesh: TriMesh, tolerance: float = 1e-6) -> bool:
    """Tell whether all faces lie on the convex hull of their corners, so that none hides another from outside.

    Each face's plane must have all vertices on one side, within `tolerance` of the longest side. A few faces are tested
    first, because nearly every mesh that is not convex fails there. A mesh of many faces is compared with the hull
    (Qhull): no centre of a face may lie deeper in it than the tolerance. Meshes of more than MAX_CONVEX vertices are
    not tested, and count as not convex.
    """
    from gdtool.geometry.normals import face_normals

    used = np.unique(mesh.faces)
    if not len(used) or len(used) > MAX_CONVEX:
        return False
    points = mesh.vertices[used]
    extent = float((points.max(0) - points.min(0)).max())
    normals, areas = face_normals(mesh)
    with_area = np.flatnonzero(areas > 1e-12 * extent**2)
    sampled = with_area[:: max(1, len(with_area) // 64)]
    if not _on_one_side(mesh, normals, sampled, points, tolerance * extent):
        return False
    if len(with_area) * len(points) > _MAX_PAIRS:
        depth = _depth_in_hull(TriMesh(mesh.vertices, mesh.faces[with_area]), points)
        if depth is not None:
            return depth <= tolerance * extent
    return _on_one_side(mesh, normals, with_area, points, tolerance * extent)


def _on_one_side(mesh: TriMesh, normals: np.ndarray, face_idx: np.ndarray, points: np.ndarray, slack: float) -> bool:
    """Tell whether the plane of each chosen face has all points (n, 3) on one side, within a distance of `slack`.

    normals (f, 3) of all faces; face_idx (k,): the faces to test.
    """
    for start in range(0, len(face_idx), 512):
        part = face_idx[start : start + 512]
        offset = np.einsum("ij,ij->i", normals[part], mesh.vertices[mesh.faces[part, 0]])
        height = normals[part] @ points.T - offset[:, None]
        if (np.minimum(height.max(1), -height.min(1)) > slack).any():
            return False
    return True


def _depth_in_hull(mesh: TriMesh, points: np.ndarray) -> float | None:
    """Return how deep the deepest face centre lies in the convex hull of points (n, 3); None where they are coplanar.

    A face whose centre is on the hull lies on it as a whole: no part of the face can be beyond the plane that touches
    the hull there.
    """
    from scipy.spatial import ConvexHull, QhullError

    from gdtool.geometry.distance import closest_points

    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    vertices, faces = mesh.vertices, mesh.faces
    centre = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3
    return float(closest_points(centre, TriMesh(points, hull.simplices.astype(np.int64)))[0].max())
