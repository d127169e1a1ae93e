"""Shapes with known normals and materials, and texture coordinates for them."""

from __future__ import annotations

import numpy as np


def torus(around: int, across: int, major: float = 0.35, minor: float = 0.14):
    """Make a torus about +Y: vertices (v, 3), quads (f, 4), outward unit normals (v, 3).

    Quads are counter-clockwise seen from outside.
    """
    a, b = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.arange(across) * 2 * np.pi / across, indexing="ij")
    normals = np.stack([np.cos(b) * np.sin(a), np.sin(b), np.cos(b) * np.cos(a)], -1).reshape(-1, 3)
    centre = major * np.stack([np.sin(a), 0 * a, np.cos(a)], -1).reshape(-1, 3)
    idx = np.arange(around * across).reshape(around, across)
    quads = np.stack([idx, np.roll(idx, -1, 0), np.roll(np.roll(idx, -1, 0), -1, 1), np.roll(idx, -1, 1)], -1).reshape(
        -1, 4
    )
    return centre + minor * normals, quads, normals


def sphere(rings: int, radius: float = 0.5):
    """Make a sphere, an octahedron subdivided `rings` times: vertices (v, 3), triangles (f, 3)."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(rings):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
        unique, place = np.unique(edges, axis=0, return_inverse=True)
        a, b, c = place.reshape(3, -1) + len(vertices)
        middle = vertices[unique].sum(1)
        vertices = np.concatenate([vertices, middle / np.linalg.norm(middle, axis=1, keepdims=True)])
        x, y, z = faces.T
        faces = np.concatenate([np.stack(t, 1) for t in ((x, a, c), (a, y, b), (c, b, z), (a, b, c))])
    return vertices * radius, faces


def triangles_of(quads: np.ndarray) -> np.ndarray:
    """Cut each quad (f, 4) along corners 0 and 2: (2 f, 3)."""
    return np.stack([quads[:, :3], quads[:, [0, 2, 3]]], 1).reshape(-1, 3)


def unwrapped(vertices: np.ndarray, faces: np.ndarray, size: int = 512, padding: int = 4):
    """Unwrap triangles with xatlas: uv (c, 2), (0, 0) at the image's top left, and face_uvs (t, 3)."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = size, padding
    atlas.generate(xatlas.ChartOptions(), options)
    _, corners, uv = atlas[0]
    uv = np.asarray(uv, np.float64) * (1, -1) + (0, 1)
    return uv, np.asarray(corners, np.int64)


def albedo_of(points: np.ndarray) -> np.ndarray:
    """Compute a smooth, colourful function (n, 3) of position, linear, in [0.05, 0.95]."""
    x, y, z = points.T
    return np.stack(
        [0.5 + 0.4 * np.sin(9 * x + 2 * y), 0.5 + 0.4 * np.sin(8 * z - 3 * x), 0.45 + 0.35 * np.cos(11 * y + 4 * z)], -1
    )


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Compute the peak signal-to-noise ratio in decibels, for a peak of 1."""
    return float(-10 * np.log10(np.mean((np.asarray(a, float) - b) ** 2) + 1e-20))
