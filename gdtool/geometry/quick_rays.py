"""First hits as Embree gives them, in single precision: a fifth of the time of rays.RayCaster's refined ones."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.rays import RayCaster


class QuickCaster(RayCaster):
    """A RayCaster for many short rays, from threads of the caller's."""

    def quick_hits(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """First hits of rays (n, 3) from either side: face_idx (n,) int32, -1 = miss; distance (n,) float32 along unit
        directions (n, 3); barycentric (n, 3) float32, component by component in memory. Places are good to 1e-7 of the
        mesh's extent."""
        if not len(self.faces) or not len(origins):
            return (
                np.full(len(origins), -1, np.int32),
                np.full(len(origins), np.inf, np.float32),
                np.zeros((3, len(origins)), np.float32).T,
            )
        found = self._scene.run(
            self.localised(origins), np.ascontiguousarray(directions, np.float32), query="INTERSECT", output=True
        )
        u, v = found["u"], found["v"]
        return found["primID"], found["tfar"] * np.float32(1 / self.scale), np.stack([1 - u - v, u, v]).T

    def quick_occluded(self, origins: np.ndarray, directions: np.ndarray, max_distance: float = np.inf) -> np.ndarray:
        """(n,) bool: whether anything lies within max_distance along rays from origins (n, 3) in unit directions (n,
        3)."""
        if not len(self.faces) or not len(origins):
            return np.zeros(len(origins), bool)
        limits = (
            None if np.isinf(max_distance) else np.full(len(origins), min(max_distance * self.scale, 1e30), np.float32)
        )
        return (
            self._scene.run(
                self.localised(origins), np.ascontiguousarray(directions, np.float32), query="OCCLUDED", dists=limits
            )
            >= 0
        )

    def localised(self, origins: np.ndarray) -> np.ndarray:
        """origins (n, 3) in Embree's frame, float32."""
        return np.ascontiguousarray(
            (origins - self.center.astype(origins.dtype)) * origins.dtype.type(self.scale), np.float32
        )
