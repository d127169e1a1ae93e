"""Figures of a mesh of quads: how regular, how square, how near its source."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.topology import components, edges_of
from gdtool.geometry.vectors import cross, dot


def columns_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(3, c, f) coordinates of the corners of faces (f, c): whole rows to compute with, several times faster than (f,
    c, 3)."""
    return np.ascontiguousarray(vertices.T).take(np.ascontiguousarray(faces.T), axis=1)


def polygon_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (f, 3) and areas (f,) of faces (f, 4), -1 as fourth corner of triangles (Newell's vector
    area)."""
    triangle = faces[:, 3] < 0
    # A triangle is a quad whose fourth corner is its first.
    p = columns_of(vertices, np.where(triangle[:, None], faces[:, [0, 1, 2, 0]], faces) if triangle.any() else faces)
    normal, area = _normal_of(p)
    return np.ascontiguousarray(normal.T), area


def _normal_of(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (3, q) and areas (q,) of quads with corners (3, 4, q)."""
    vector = cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    length = np.sqrt(dot(vector, vector))
    return vector / np.maximum(length, 1e-300), length / 2


def corner_jacobians(vertices: np.ndarray, quads: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(q, 4) scaled Jacobian at each corner: sine of its angle seen along the face normal, 1 square, <= 0 folded."""
    return _corner_sines(columns_of(vertices, quads), normals.T)[0].T


def _corner_sines(p: np.ndarray, *normals: np.ndarray) -> list[np.ndarray]:
    """Scaled Jacobians (4, q) of quads with corners (3, 4, q) about each of normals (3, q)."""
    after = np.empty_like(p)
    np.subtract(p[:, 1:], p[:, :-1], out=after[:, :-1])
    np.subtract(p[:, 0], p[:, -1], out=after[:, -1])
    length = np.sqrt(dot(after, after))
    turn = cross(after[:, [3, 0, 1, 2]], after)
    over = np.maximum(length * length[[3, 0, 1, 2]], 1e-300)
    return [dot(turn, n) / over for n in normals]


def worst_jacobian(p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(q,) smallest scaled Jacobian of each quad with corners (3, 4, q), about its own normal and about `normals` (3,
    q): the worse of both."""
    own, other = _corner_sines(p, _normal_of(p)[0], normals)
    return np.minimum(own, other).min(0)


def scaled_jacobian(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """(q,) smallest scaled Jacobian of each quad's corners."""
    if not len(quads):
        return np.zeros(0)
    p = columns_of(vertices, quads)
    return _corner_sines(p, _normal_of(p)[0])[0].min(0)


def valences(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges at each vertex (v,), and whether it lies on no boundary (v,)."""
    edges = edges_of(faces)
    valence = np.bincount(edges.ends.ravel(), minlength=count)
    inner = valence > 0
    inner[edges.ends[edges.count != 2].ravel()] = False
    return valence, inner


def topology_figures(vertices: np.ndarray, faces: np.ndarray) -> dict[str, float | int | bool]:
    """Quads, triangles, pieces, watertight, boundary edges, irregular share (inner vertices of other than four
    edges)."""
    edges = edges_of(faces)
    valence, inner = valences(faces, len(vertices))
    return {
        "pieces": components(faces)[0],
        "watertight": bool((edges.count == 2).all() and not edges.turned.any()),
        "boundary_edges": int((edges.count == 1).sum()),
        "nonmanifold_edges": int((edges.count > 2).sum()),
        "irregular_share": float((valence[inner] != 4).mean()) if inner.any() else 0.0,
    }


def shape_figures(vertices: np.ndarray, faces: np.ndarray) -> dict[str, float]:
    """Scaled Jacobian (mean, least, share that is folded) and mean deviation of corners from 90 degrees, of the
    quads."""
    quads = faces[faces[:, 3] >= 0]
    if not len(quads):
        return {}
    corners = corner_jacobians(vertices, quads, polygon_normals(vertices, quads)[0])
    least = corners.min(1)
    p = vertices[quads]
    after, before = np.roll(p, -1, 1) - p, np.roll(p, 1, 1) - p
    length = np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1)
    angle = np.degrees(np.arccos(np.clip((after * before).sum(-1) / np.maximum(length, 1e-300), -1, 1)))
    return {
        "jacobian_mean": float(least.mean()),
        "jacobian_min": float(least.min()),
        "folded_share": float((least <= 0).mean()),
        "angle_deviation_deg": float(np.abs(angle - 90).mean()),
    }


def distance_figures(
    vertices: np.ndarray,
    triangles: np.ndarray,
    source_vertices: np.ndarray,
    source_faces: np.ndarray,
    count: int,
    seed: int = 0,
    source=None,
) -> dict[str, float]:
    """Sample distances between two surfaces in their unit: mean of both directions, largest of both, mean normal
    angle.

    source: quad_shape.Surface of the source, where its search tree is there already.
    """
    from gdtool.geometry.distance import closest_points, sample_surface
    from gdtool.geometry.normals import face_normals

    rng = np.random.default_rng(seed)
    mine, theirs = (vertices, triangles), (source_vertices, source_faces)
    distances, angles = [], []
    for one, other in ((mine, theirs), (theirs, mine)):
        points, face_idx, _ = sample_surface(*one, count, rng)
        distance, other_idx, _ = (
            source.closest(points) if source is not None and other is theirs else closest_points(points, *other)
        )
        distances.append(distance)
        here, there = (face_normals(v, f[index])[0] for (v, f), index in ((one, face_idx), (other, other_idx)))
        cosine = (here * there).sum(1)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return {
        "distance_mean": float((distances[0].mean() + distances[1].mean()) / 2),
        "hausdorff": float(max(d.max() for d in distances)),
        "normal_deg": float(np.concatenate(angles).mean()),
    }
