"""Ray queries by Embree (embreex)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Hits:
    """First hits: face_idx (n,) int32, -1 where a ray misses; distance (n,), inf there; barycentric (n, 3)."""

    face_idx: np.ndarray
    distance: np.ndarray
    barycentric: np.ndarray


class RayCaster:
    """Embree's scene of one triangle mesh: vertices (v, 3), faces (f, 3)."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.vertices = np.ascontiguousarray(vertices, np.float64)
        self.faces = np.ascontiguousarray(faces, np.int32)
        self._scene = rtcore_scene.EmbreeScene()
        self._mesh = TriangleMesh(self._scene, np.ascontiguousarray(vertices, np.float32), self.faces)

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """First hit of each ray; distance and barycentric are recomputed in double precision from the face."""
        origins, directions = np.asarray(origins, np.float64), np.asarray(directions, np.float64)
        face_idx = self._scene.run(origins.astype(np.float32), directions.astype(np.float32)).astype(np.int32)
        distance = np.full(len(face_idx), np.inf)
        barycentric = np.zeros((len(face_idx), 3))
        hit = np.flatnonzero(face_idx >= 0)
        if len(hit):
            a, b, c = (self.vertices[self.faces[face_idx[hit], i]] for i in range(3))
            edge1, edge2, o, d = b - a, c - a, origins[hit], directions[hit]
            # Möller & Trumbore 1997
            p = np.cross(d, edge2)
            determinant = (edge1 * p).sum(1)
            determinant = np.where(np.abs(determinant) < 1e-300, 1e-300, determinant)
            s = o - a
            q = np.cross(s, edge1)
            u = np.clip((s * p).sum(1) / determinant, 0, 1)
            v = np.clip((d * q).sum(1) / determinant, 0, 1 - u)
            distance[hit] = (edge2 * q).sum(1) / determinant
            barycentric[hit] = np.stack([1 - u - v, u, v], -1)
        return Hits(face_idx, distance, barycentric)

    def occluded(self, origins: np.ndarray, directions: np.ndarray, max_distance: float | np.ndarray = np.inf) -> np.ndarray:
        """(n,) bool: whether anything lies within max_distance along each ray."""
        o, d = np.ascontiguousarray(origins, np.float32), np.ascontiguousarray(directions, np.float32)
        if np.isscalar(max_distance) and not np.isfinite(max_distance):
            return self._scene.run(o, d, query="OCCLUDED").astype(np.int32) != -1
        return self._scene.run(o, d, query="DISTANCE") < max_distance
