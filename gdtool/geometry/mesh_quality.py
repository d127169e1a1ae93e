"""Figures of a mesh of quads: how regular, how square, how near its source."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.repair import components, edges_of


def polygon_normals(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals (f, 3) and areas (f,) of faces (f, 4), -1 as fourth corner of triangles (Newell's vector area)."""
    corners = np.where(faces < 0, faces[:, :1], faces)
    p = vertices[corners]
    vector = np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1]) / 2
    triangle = faces[:, 3] < 0
    vector[triangle] = np.cross(p[triangle, 1] - p[triangle, 0], p[triangle, 2] - p[triangle, 0]) / 2
    area = np.linalg.norm(vector, axis=1)
    return vector / np.maximum(area, 1e-300)[:, None], area


def corner_jacobians(vertices: np.ndarray, quads: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(q, 4) scaled Jacobian at each corner: sine of its angle seen along the face normal, 1 square, <= 0 folded."""
    p = vertices[quads]
    after, before = np.roll(p, -1, 1) - p, np.roll(p, 1, 1) - p
    length = np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1)
    return (np.cross(after, before) * normals[:, None]).sum(-1) / np.maximum(length, 1e-300)


def scaled_jacobian(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """(q,) smallest scaled Jacobian of each quad's corners."""
    if not len(quads):
        return np.zeros(0)
    return corner_jacobians(vertices, quads, polygon_normals(vertices, quads)[0]).min(1)


def valences(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Edges at each vertex (v,), and whether it lies on no boundary (v,)."""
    edges = edges_of(faces)
    valence = np.bincount(edges.ends.ravel(), minlength=count)
    inner = valence > 0
    inner[edges.ends[edges.count != 2].ravel()] = False
    return valence, inner


def topology_figures(vertices: np.ndarray, faces: np.ndarray) -> dict[str, float | int | bool]:
    """Quads, triangles, pieces, watertight, boundary edges, irregular share (inner vertices of other than four edges)."""
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
    """Scaled Jacobian (mean, least, share that is folded) and mean deviation of corners from 90 degrees, of the quads."""
    quads = faces[faces[:, 3] >= 0]
    if not len(quads):
        return {}
    corners = corner_jacobians(vertices, quads, polygon_normals(vertices, quads)[0])
    least = corners.min(1)
    p = vertices[quads]
    after, before = np.roll(p, -1, 1) - p, np.roll(p, 1, 1) - p
    length = np.linalg.norm(after, axis=-1) * np.linalg.norm(before, axis=-1)
    angle = np.degrees(np.arccos(np.clip((after * before).sum(-1) / np.maximum(length, 1e-300), -1, 1)))
    return {"jacobian_mean": float(least.mean()), "jacobian_min": float(least.min()), "folded_share": float((least <= 0).mean()),
            "angle_deviation_deg": float(np.abs(angle - 90).mean())}


def distance_figures(vertices: np.ndarray, triangles: np.ndarray, source_vertices: np.ndarray, source_faces: np.ndarray,
                     count: int, seed: int = 0) -> dict[str, float]:
    """Sampled distances between two surfaces in their unit: mean of both directions, largest of both, mean normal angle."""
    from gdtool.geometry.distance import closest_points, sample_surface
    from gdtool.geometry.normals import face_normals

    rng = np.random.default_rng(seed)
    mine, source = (vertices, triangles), (source_vertices, source_faces)
    distances, angles = [], []
    for one, other in ((mine, source), (source, mine)):
        points, face_idx, _ = sample_surface(*one, count, rng)
        distance, other_idx, _ = closest_points(points, *other)
        distances.append(distance)
        cosine = (face_normals(*one)[0][face_idx] * face_normals(*other)[0][other_idx]).sum(1)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return {"distance_mean": float((distances[0].mean() + distances[1].mean()) / 2), "hausdorff": float(max(d.max() for d in distances)),
            "normal_deg": float(np.concatenate(angles).mean())}
