"""Measure a quad mesh: how regular it is, how square its faces are, how near it is to its source."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import components, edges_of
from gdtool.geometry.vectors import cross, dot

# What finds closest points: distance (n,), face_idx (n,) and point (n, 3) for points (n, 3).
ClosestPoints = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def gather_corners(vertices: np.ndarray, corner_idx: np.ndarray) -> np.ndarray:
    """Return the coordinates (3, c, f) of the corners corner_idx (f, c) among vertices (v, 3).

    Each coordinate is contiguous in memory. Computing with this layout is several times faster than with (f, c, 3).
    """
    return np.ascontiguousarray(vertices.T).take(np.ascontiguousarray(corner_idx.T), axis=1)


def polygon_normals(mesh: QuadMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (f, 3) and areas (f,) of the faces (Newell's vector area)."""
    faces = mesh.faces
    triangle = faces[:, 3] < 0
    # A triangle is a quad whose fourth corner is its first.
    p = gather_corners(
        mesh.vertices, np.where(triangle[:, None], faces[:, [0, 1, 2, 0]], faces) if triangle.any() else faces
    )
    normal, area = _quad_normals(p)
    return np.ascontiguousarray(normal.T), area


def _quad_normals(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals (3, q) and areas (q,) of quads with corners (3, 4, q)."""
    vector = cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 1])
    length = np.sqrt(dot(vector, vector))
    return vector / np.maximum(length, 1e-300), length / 2


def corner_jacobians(mesh: QuadMesh, normals: np.ndarray) -> np.ndarray:
    """Return the scaled Jacobian (q, 4) at each corner of quads, about normals (q, 3).

    This is the sine of the corner's angle seen along the normal: 1 for a right angle, 0 or less where it is folded.
    The mesh has no triangles.
    """
    return _corner_sines(gather_corners(mesh.vertices, mesh.faces), normals.T)[0].T


def _corner_sines(p: np.ndarray, *normals: np.ndarray) -> list[np.ndarray]:
    """Return scaled Jacobians (4, q) of quads with corners (3, 4, q) about each of normals (3, q)."""
    after = np.empty_like(p)
    np.subtract(p[:, 1:], p[:, :-1], out=after[:, :-1])
    np.subtract(p[:, 0], p[:, -1], out=after[:, -1])
    length = np.sqrt(dot(after, after))
    turn = cross(after[:, [3, 0, 1, 2]], after)
    scale = np.maximum(length * length[[3, 0, 1, 2]], 1e-300)
    return [dot(turn, n) / scale for n in normals]


def worst_jacobian(p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the smallest scaled Jacobian (q,) of each quad with corners (3, 4, q).

    It is the smaller of those about the quad's own normal and about `normals` (3, q).
    """
    about_own, about_given = _corner_sines(p, _quad_normals(p)[0], normals)
    return np.minimum(about_own, about_given).min(0)


def scaled_jacobian(mesh: QuadMesh) -> np.ndarray:
    """Return the smallest scaled Jacobian (q,) of each quad's corners, about its normal; no face may be a triangle."""
    if not len(mesh.faces):
        return np.zeros(0)
    p = gather_corners(mesh.vertices, mesh.faces)
    return _corner_sines(p, _quad_normals(p)[0])[0].min(0)


def valences(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of edges at each of `count` vertices (v,), and whether it is used and on no boundary (v,)."""
    edges = edges_of(faces)
    valence = np.bincount(edges.ends.ravel(), minlength=count)
    inner = valence > 0
    inner[edges.ends[edges.count != 2].ravel()] = False
    return valence, inner


def topology_figures(mesh: QuadMesh) -> dict[str, float | int | bool]:
    """Report pieces, watertightness, boundary and non-manifold edges, and the share of irregular inner vertices.

    Irregular vertices have other than four edges.
    """
    edges = edges_of(mesh.faces)
    valence, inner = valences(mesh.faces, len(mesh.vertices))
    return {
        "pieces": components(mesh.faces)[0],
        "watertight": bool((edges.count == 2).all() and not edges.turned.any()),
        "boundary_edges": int((edges.count == 1).sum()),
        "nonmanifold_edges": int((edges.count > 2).sum()),
        "irregular_share": float((valence[inner] != 4).mean()) if inner.any() else 0.0,
    }


def shape_figures(mesh: QuadMesh) -> dict[str, float]:
    """Report the quads' scaled Jacobian (mean, least, share folded) and the corners' mean deviation from 90 degrees.

    Triangles do not count; empty where there are no quads.
    """
    quads = mesh.faces[mesh.is_quad]
    if not len(quads):
        return {}
    quad_mesh = QuadMesh(mesh.vertices, quads)
    corners = corner_jacobians(quad_mesh, polygon_normals(quad_mesh)[0])
    least = corners.min(1)
    p = mesh.vertices[quads]
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
    mesh: TriMesh, source: TriMesh, count: int, seed: int = 0, closest_on_source: ClosestPoints | None = None
) -> dict[str, float]:
    """Measure distances between two surfaces at `count` samples of each, in their unit.

    Reports the mean of both directions, the largest of both, and the mean angle between the normals at a sample and at
    its closest point. closest_on_source: finds closest points on the source, where a search tree exists already.
    """
    from gdtool.geometry.distance import closest_points, sample_surface
    from gdtool.geometry.normals import face_normals

    rng = np.random.default_rng(seed)
    distances, angles = [], []
    for sampled, other in ((mesh, source), (source, mesh)):
        points, face_idx, _ = sample_surface(sampled, count, rng)
        distance, other_idx, _ = (
            closest_on_source(points)
            if closest_on_source is not None and other is source
            else closest_points(points, other)
        )
        distances.append(distance)
        here, there = (
            face_normals(TriMesh(surface.vertices, surface.faces[index]))[0]
            for surface, index in ((sampled, face_idx), (other, other_idx))
        )
        cosine = (here * there).sum(1)
        angles.append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return {
        "distance_mean": float((distances[0].mean() + distances[1].mean()) / 2),
        "hausdorff": float(max(d.max() for d in distances)),
        "normal_deg": float(np.concatenate(angles).mean()),
    }
