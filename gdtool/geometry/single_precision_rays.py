"""Cast rays with Embree in single precision, which takes a fifth of the time of rays.RayCaster's refined hits."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.rays import RayCaster


class SinglePrecisionCaster(RayCaster):
    """Cast many short rays at one mesh, without refining the hits.

    It starts no threads itself, so that a caller may use several.
    """

    def first_hit_single(
        self, origins: np.ndarray, directions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the nearest hit of each ray, from either side of a face.

        origins (n, 3), directions (n, 3) unit. Returns face_idx (n,) int32, -1 for a miss; distance (n,) float32; and
        barycentric (n, 3) float32, component by component in memory. Positions are good to 1e-7 of the mesh's extent.
        """
        if not len(self.faces) or not len(origins):
            return (
                np.full(len(origins), -1, np.int32),
                np.full(len(origins), np.inf, np.float32),
                np.zeros((3, len(origins)), np.float32).T,
            )
        hits = self._scene.run(
            self.to_embree_frame(origins), np.ascontiguousarray(directions, np.float32), query="INTERSECT", output=True
        )
        u, v = hits["u"], hits["v"]
        return hits["primID"], hits["tfar"] * np.float32(1 / self.scale), np.stack([1 - u - v, u, v]).T

    def occluded_single(self, origins: np.ndarray, directions: np.ndarray, max_distance: float = np.inf) -> np.ndarray:
        """Return (n,) bool: whether anything lies on each ray before max_distance; origins (n, 3), directions (n, 3)
        unit.
        """
        if not len(self.faces) or not len(origins):
            return np.zeros(len(origins), bool)
        limits = (
            None if np.isinf(max_distance) else np.full(len(origins), min(max_distance * self.scale, 1e30), np.float32)
        )
        return (
            self._scene.run(
                self.to_embree_frame(origins),
                np.ascontiguousarray(directions, np.float32),
                query="OCCLUDED",
                dists=limits,
            )
            >= 0
        )

    def to_embree_frame(self, origins: np.ndarray) -> np.ndarray:
        """Move points (n, 3) into the unit box that Embree's mesh was moved into; float32."""
        return np.ascontiguousarray(
            (origins - self.center.astype(origins.dtype)) * origins.dtype.type(self.scale), np.float32
        )
