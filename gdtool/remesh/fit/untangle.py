"""Untangle folded and needle-like quads by moving one vertex at a time."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import gather_corners, worst_jacobian
from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import edges_of
from gdtool.remesh.fit.feature_curves import Constraints, Features, closest_on_segments
from gdtool.remesh.fit.surface_projection import (
    GroupedLists,
    ProjectionTarget,
    faces_around_vertices,
    neighbours,
    surface_normals_below,
)

_MIN_JACOBIAN = 0.3  # scaled Jacobian: quads below it are worked on
_ROUNDS = 12
_LOOSE_ROUNDS = 4  # the last rounds, in which vertices may leave their features ...
_LOOSE_JACOBIAN = 0.22  # ... for quads with a scaled Jacobian below this
_MIN_GAIN = 1e-3  # in the worst scaled Jacobian, for which a vertex moves
_RING_ANGLES = np.arange(8) * (np.pi / 4)
_POSITIONS = 4 + 2 * len(_RING_ANGLES)
_NEAR_RING, _FAR_RING = 0.12, 0.35  # radii of the two rings of positions, in mean distances to the neighbours


def untangle(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    max_visits: int = 6000,
) -> np.ndarray:
    """Move vertices of folded and needle-like quads to the best of a few positions near them.

    A vertex moves only where that improves the worst scaled Jacobian of its quads, measured against the surface's
    normals. Free vertices stay on the surface, held ones slide along their curve; in the last rounds they may leave it.
    max_visits bounds the work by a count, not a time, so that equal input gives equal output. Vertices that share no
    quad move at once. Returns vertices (v, 3).
    """
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    face_lists = faces_around_vertices(faces, len(vertices))
    neighbour_lists = neighbours(edges.ends, len(vertices))
    is_boundary = np.zeros(len(vertices), bool)
    is_boundary[edges.ends[edges.count != 2].ravel()] = True
    is_held = constraints.curve >= 0
    vertices = vertices.copy()
    normals = surface_normals_below(QuadMesh(vertices, faces), surface)
    normal_columns = np.ascontiguousarray(normals.T)
    is_settled = np.zeros(len(vertices), bool)  # found no better position, and nothing beside it moved since
    for turn in range(_ROUNDS):
        is_loose = turn >= _ROUNDS - _LOOSE_ROUNDS
        if turn == _ROUNDS - _LOOSE_ROUNDS:
            is_settled &= ~is_held & ~constraints.fixed
        bad = worst_jacobian(gather_corners(vertices, faces), normal_columns) < (
            _LOOSE_JACOBIAN if is_loose else _MIN_JACOBIAN
        )
        if not bad.any():
            break
        touched = np.unique(faces[bad])
        max_visits -= len(touched)
        if max_visits < 0:
            break
        movable = touched[~(constraints.fixed[touched] & (not is_loose)) & (~is_boundary | is_held)[touched]]
        for batch in _independent_batches(movable, faces, face_lists):
            batch = batch[~is_settled[batch]]
            if not len(batch):
                continue
            around = face_lists.rows(batch)
            positions = _batch_positions(vertices, batch, faces, face_lists, neighbour_lists)
            slides = is_held[batch] & (not is_loose)
            if not slides.all():
                positions[~slides, 1:] = surface.closest(positions[~slides, 1:].reshape(-1, 3))[2].reshape(
                    -1, positions.shape[1] - 1, 3
                )
            for k in np.flatnonzero(slides):
                curve = features.segments[features.curve == constraints.curve[batch[k]]]
                positions[k, 1:] = closest_on_segments(positions[k, 1:], features.points, curve)[2]
            best, better = _best_position(vertices, batch, faces[around], normals[around], positions)
            is_settled[batch] = ~better
            vertices[batch[better]] = positions[better, best[better]]
            is_settled[faces[around[better]]] = False
    return vertices


def _batch_positions(
    vertices: np.ndarray, batch: np.ndarray, faces: np.ndarray, face_lists: GroupedLists, neighbour_lists: GroupedLists
) -> np.ndarray:
    """Compute positions (n, _POSITIONS, 3) that a batch of vertices (n,) may move to.

    Vertices with equally many faces and neighbours are computed together.
    """
    size = np.stack([face_lists.lengths(batch), neighbour_lists.lengths(batch)], -1)
    positions = np.empty((len(batch), _POSITIONS, 3))
    for alike in {tuple(lengths) for lengths in size.tolist()}:
        same = (size == alike).all(1)
        positions[same] = _candidate_positions(
            vertices, batch[same], faces[face_lists.rows(batch[same])], neighbour_lists.rows(batch[same])
        )
    return positions


def _independent_batches(chosen: np.ndarray, faces: np.ndarray, face_lists: GroupedLists) -> list[np.ndarray]:
    """Split the chosen vertices (n,) into batches in which no two share a face (greedy colouring)."""
    batches: list[list[int]] = []
    color: dict[int, int] = {}
    for v in chosen.tolist():
        used_colors = {color.get(u) for u in faces[face_lists[v]].ravel().tolist()}
        color[v] = next(c for c in range(len(used_colors) + 1) if c not in used_colors)
        if color[v] == len(batches):
            batches.append([])
        batches[color[v]].append(v)
    return [np.array(batch) for batch in batches]


def _candidate_positions(
    vertices: np.ndarray, batch: np.ndarray, quads: np.ndarray, neighbour_idx: np.ndarray
) -> np.ndarray:
    """Compute the positions (n, _POSITIONS, 3) that vertices (n,) may move to; the first is where they are.

    quads (n, k, 4) and neighbours (n, m) around them.
    """
    present, beside = vertices[batch][:, None], vertices[neighbour_idx]
    mean = beside.mean(1, keepdims=True)
    radius = np.linalg.norm(beside - mean, axis=2).mean(1)[:, None, None]
    axes = np.linalg.svd(beside - mean, full_matrices=False)[2]
    # Rings of positions in the plane of the neighbours find a way out of most folds.
    circle = (
        np.cos(_RING_ANGLES)[:, None] * axes[:, :1]
        + np.sin(_RING_ANGLES)[:, None] * axes[:, min(1, axes.shape[1] - 1), None]
    )
    return np.concatenate(
        [
            present,
            mean,
            vertices[quads].mean((1, 2))[:, None],
            (mean + present) / 2,
            present + _NEAR_RING * radius * circle,
            present + _FAR_RING * radius * circle,
        ],
        1,
    )


def _best_position(
    vertices: np.ndarray, batch: np.ndarray, quads: np.ndarray, normals: np.ndarray, positions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Choose for each vertex the position that makes the worst quad around it best.

    quads (n, k, 4) around the vertices, normals (n, k, 3) of the surface under them, positions (n, p, 3). Returns the
    index (n,) of the best position, and (n,) bool: whether it is better than the present one.
    """
    n, p, k = *positions.shape[:2], quads.shape[1]
    corners = np.where(
        (quads == batch[:, None, None])[:, None, ..., None], positions[:, :, None, None], vertices[quads][:, None]
    )
    # worst_jacobian measures against the surface's normal and the quad's own: a quad may be folded in one alone.
    quality = worst_jacobian(
        np.ascontiguousarray(corners.reshape(-1, 4, 3).T), np.repeat(normals[:, None], p, 1).reshape(-1, 3).T
    )
    quality = quality.reshape(n, p, k).min(2)
    best = quality.argmax(1)
    return best, quality[np.arange(n), best] > quality[:, 0] + _MIN_GAIN
