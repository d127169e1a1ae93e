"""Handle features that run across quads: hold vertices to diagonals, and choose diagonals that follow the surface."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gdtool.geometry.mesh_quality import gather_corners
from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import edges_of
from gdtool.remesh.fit.feature_curves import Constraints, closest_on_segments
from gdtool.remesh.fit.surface_projection import ProjectionTarget

_FLAT = 1e-3  # of a quad's size: where its diagonals pass nearer to each other, either will do


def quads_crossed_by_features(
    faces: np.ndarray, before: Constraints, after: Constraints
) -> tuple[np.ndarray, np.ndarray]:
    """Find the quads (k,) of faces (q, 4) that a feature crosses from corner to corner, and its curve (k,).

    before and after are the constraints before and after release_straight_corners. A corner released between two held
    ones leaves a quad whose diagonal the curve follows.
    """
    width = len(before.curve) + 1
    path = np.sort(before.path, 1)
    order = np.argsort(path[:, 0] * width + path[:, 1])
    key = (path[:, 0] * width + path[:, 1])[order]
    if not len(key):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    following = np.roll(faces, -1, 1)
    edge_key = np.minimum(faces, following) * width + np.maximum(faces, following)
    index = np.minimum(np.searchsorted(key, edge_key), len(key) - 1)
    curve = np.where(key[index] == edge_key, before.path_curve[order][index], -1)  # of the edge from each corner on
    was_released = (before.curve[faces] >= 0) & (after.curve[faces] < 0)
    is_held = (after.curve >= 0) | after.fixed
    is_crossed = (
        was_released
        & (curve >= 0)
        & (curve == np.roll(curve, 1, 1))
        & is_held[following]
        & is_held[np.roll(faces, 1, 1)]
        & ~is_held[np.roll(faces, 2, 1)]
    )
    face_idx, corner = np.nonzero(is_crossed)
    first_of_face = np.unique(face_idx, return_index=True)[1]
    return face_idx[first_of_face], curve[face_idx[first_of_face], corner[first_of_face]]


def hold_centres(constraints: Constraints, first_centre: int, face_idx: np.ndarray, curve: np.ndarray) -> Constraints:
    """Hold the centres of quads (k,) to the curve (k,) that crosses them, in the constraints of the subdivided mesh.

    first_centre: the vertex at the centre of face 0.
    """
    curve_of_vertex = constraints.curve.copy()
    curve_of_vertex[first_centre + face_idx] = curve
    return replace(constraints, curve=curve_of_vertex)


def choose_diagonals(mesh: QuadMesh, surface: ProjectionTarget) -> np.ndarray:
    """Rotate the corners of quads so that the diagonal from the first corner is the one nearer to the surface.

    Quads are cut into triangles along that diagonal, so bent quads across a crease then follow it. Returns the faces
    (q, 4).
    """
    vertices, faces = mesh.vertices, mesh.faces
    columns = gather_corners(vertices, faces)
    middle = np.stack([(columns[:, 0] + columns[:, 2]) / 2, (columns[:, 1] + columns[:, 3]) / 2])
    gap = np.sqrt(((middle[0] - middle[1]) ** 2).sum(0))
    size = np.sqrt(((columns[:, 0] - columns[:, 2]) ** 2).sum(0))
    bent = np.flatnonzero(gap > _FLAT * size)
    first, second = surface.closest(middle[:, :, bent].transpose(0, 2, 1).reshape(-1, 3))[0].reshape(2, -1)
    rotated = bent[second < first]
    out = faces.copy()
    out[rotated] = np.roll(faces[rotated], -1, 1)
    return out


def snap_boundary(mesh: QuadMesh, surface: ProjectionTarget, reach: float) -> np.ndarray:
    """Move boundary vertices of the quads to the boundary of the surface where it is within `reach`.

    Returns vertices (v, 3).
    """
    vertices, faces = mesh.vertices, mesh.faces
    surface_edges = edges_of(surface.faces)
    segments = surface_edges.ends[surface_edges.count == 1]
    if not len(segments):
        return vertices
    quad_edges = edges_of(faces)
    boundary = np.unique(quad_edges.ends[quad_edges.count == 1])
    distance, _, point = closest_on_segments(vertices[boundary], surface.vertices, segments)
    out = vertices.copy()
    out[boundary[distance < reach]] = point[distance < reach]
    return out
