"""Face and vertex normals."""

from __future__ import annotations

import numpy as np


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (f, 3) and areas (f,) of triangles; zero-area faces have normal 0."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(length, 1e-300)[:, None], length / 2


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(v, 3) unit normals, faces weighted by their angle at the vertex (Thürmer & Wüthrich 1998)."""
    normals, _ = face_normals(vertices, faces)
    out = np.zeros((len(vertices), 3))
    corners = vertices[faces]
    for i in range(3):
        u = corners[:, (i + 1) % 3] - corners[:, i]
        w = corners[:, (i + 2) % 3] - corners[:, i]
        cosine = (u * w).sum(1) / np.maximum(np.linalg.norm(u, axis=1) * np.linalg.norm(w, axis=1), 1e-300)
        angle = np.arccos(np.clip(cosine, -1, 1))
        for axis in range(3):
            out[:, axis] += np.bincount(faces[:, i], normals[:, axis] * angle, len(vertices))
    return out / np.maximum(np.linalg.norm(out, axis=1), 1e-300)[:, None]
