"""Distances to triangle meshes, inside and outside, and points on surfaces (libigl)."""

from __future__ import annotations

import numpy as np


def closest_points(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For points (n, 3): distance (n,) to the surface, face_idx (n,) int32 and the closest point (n, 3)."""
    import igl

    squared, face_idx, closest = igl.point_mesh_squared_distance(np.ascontiguousarray(points, np.float64),
                                                                 np.ascontiguousarray(vertices, np.float64),
                                                                 np.ascontiguousarray(faces, np.int64))[:3]
    return np.sqrt(np.maximum(squared, 0)), np.asarray(face_idx, np.int32), np.asarray(closest)


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) generalised winding number: 1 inside a closed, outward-facing mesh, 0 outside (Barill et al. 2018)."""
    import igl

    return igl.fast_winding_number(np.ascontiguousarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64),
                                   np.ascontiguousarray(points, np.float64))


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int,
                   rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """count area-weighted uniform samples: points (n, 3), face_idx (n,), barycentric (n, 3)."""
    from gdtool.geometry.normals import face_normals

    area = face_normals(vertices, faces)[1]
    face_idx = np.searchsorted(np.cumsum(area) / area.sum(), rng.random(count)).clip(0, len(faces) - 1)
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    barycentric = np.stack([1 - u - v, u, v], -1)
    return (barycentric[:, :, None] * vertices[faces[face_idx]]).sum(1), face_idx.astype(np.int32), barycentric


def barycentric_of(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3) barycentric coordinates of points (n, 3) in the planes of triangles (n, 3, 3); zero-area ones give (1, 0, 0)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    e0, e1, e2 = b - a, c - a, points - a
    d00, d01, d11 = (e0 * e0).sum(1), (e0 * e1).sum(1), (e1 * e1).sum(1)
    d20, d21 = (e2 * e0).sum(1), (e2 * e1).sum(1)
    determinant = d00 * d11 - d01 * d01
    good = determinant > 1e-300
    safe = np.where(good, determinant, 1)
    v = np.where(good, (d11 * d20 - d01 * d21) / safe, 0)
    w = np.where(good, (d00 * d21 - d01 * d20) / safe, 0)
    return np.stack([1 - v - w, v, w], -1)
