"""Distances to triangle meshes, inside and outside, and points on surfaces (libigl)."""

from __future__ import annotations

import numpy as np


def closest_points(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For points (n, 3): distance (n,) to the surface, face_idx (n,) int32 and the closest point (n, 3).

    Vertices that no face uses are no surface. Zero-area faces count as the segment or point that they are. Raises
    ValueError for a mesh without faces.
    """
    import igl

    if not len(faces):
        raise ValueError("a mesh without faces has no closest point")
    if not len(points):
        return np.zeros(0), np.zeros(0, np.int32), np.zeros((0, 3))
    squared, face_idx, closest = igl.point_mesh_squared_distance(*_doubles(points, vertices), np.ascontiguousarray(faces, np.int64))[:3]
    return np.sqrt(np.maximum(squared, 0)), np.asarray(face_idx, np.int32), np.asarray(closest)


def winding_number(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) generalised winding number: 1 inside a closed, outward-facing mesh, 0 outside (Barill et al. 2018).

    An approximation for far points: good to about 1e-2, so compare it with 0.5, not with 0 or 1.
    """
    import igl

    if not len(faces) or not len(points):
        return np.zeros(len(points))
    points, vertices = _doubles(points, vertices)
    return np.asarray(igl.fast_winding_number(vertices, np.ascontiguousarray(faces, np.int64), points))


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int,
                   rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """count area-weighted uniform samples: points (n, 3), face_idx (n,) int32, barycentric (n, 3).

    Zero-area faces get none. Raises ValueError when the whole mesh has no area.
    """
    from gdtool.geometry.normals import face_normals

    below = np.cumsum(face_normals(vertices, faces)[1])
    if not len(below) or not below[-1] > 0:
        raise ValueError("a mesh without area cannot be sampled")
    # side="right": a face is drawn when below[i-1] <= r < below[i], never one of zero area.
    face_idx = np.searchsorted(below, rng.random(count) * below[-1], side="right")
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    barycentric = np.stack([1 - u - v, u, v], -1)
    return np.einsum("nc,ncd->nd", barycentric, vertices[faces[face_idx]]), face_idx.astype(np.int32), barycentric


def barycentric_of(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n, 3) barycentric coordinates of points (n, 3) in the planes of triangles (n, 3, 3); zero-area ones give (1, 0, 0)."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    e0, e1, e2 = b - a, c - a, points - a
    normal = np.cross(e0, e1)
    squared = (normal * normal).sum(1)
    good = squared > 0
    # Cross products instead of the Gram determinant, which cancels on slivers.
    over = np.where(good, 1 / np.where(good, squared, 1), 0)
    v = (np.cross(e2, e1) * normal).sum(1) * over
    w = (np.cross(e0, e2) * normal).sum(1) * over
    return np.stack([1 - v - w, v, w], -1)


def _doubles(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    return tuple(np.ascontiguousarray(array, np.float64) for array in arrays)
