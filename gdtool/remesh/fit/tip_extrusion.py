"""Extrude tips and rims of the surface that quads leave uncovered: engines cut off what is thinner than a quad."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gdtool.geometry.distance import closest_points, sample_surface
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import components, edges_of, euler_number, triangulated
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.surface_projection import ProjectionTarget

# All in edge lengths.
_UNCOVERED = 0.5  # distance from the quads beyond which a sample belongs to a tip
_CLOSE = 0.75  # a tip this near is finished
_STRAYS = 1.0  # extrusion starts only where some sample is this far away
_MAX_SINGLE_TIP = 1.5  # size of a tip that one vertex can reach
_STEP = 1.5  # that a tip is extruded at once
_MIN_SPACING = 0.75  # between fixed vertices: nearer ones leave no room for the quads between them

_FIXED_SHARE = 0.75  # of the largest movement: vertices that move this far are fixed
_MAX_STEPS = 24
_SAMPLES = 20000  # points of the surface: half vertices, half spread over its area


class ExtrudedQuads(NamedTuple):
    """Quads extruded over the tips of a surface.

    tips (t,): the vertices at tips, fixed in the constraints. distance: the largest from the surface to the quads.
    sample_distances (n,): distances of samples spread over the surface's area. Both were measured before the last
    vertices moved.
    """

    mesh: QuadMesh
    constraints: Constraints
    tips: np.ndarray
    distance: float
    sample_distances: np.ndarray


class _Tip(NamedTuple):
    """A part of the surface that the quads leave uncovered: points (n, 3), their nearest quads (n,), distances (n,)."""

    points: np.ndarray
    quads: np.ndarray
    distances: np.ndarray


def extrude_tips(
    mesh: QuadMesh,
    constraints: Constraints,
    surface: ProjectionTarget,
    edge: float,
    max_added: float = 0.03,
) -> ExtrudedQuads:
    """Extrude quads of mean edge length `edge` over the parts of the surface that they leave uncovered.

    The farthest tip goes first. The vertices nearest to it move along it, an edge or two at a time, with the quads
    around them, and each step inserts a ring of new quads, as one models a horn by hand. It ends when the share
    max_added of the quads is new: surfaces that need more have other faults than tips. A tip nearer than an edge takes
    one vertex and no ring. The quads stay closed and manifold where they were, with as many pieces and handles.
    """
    vertices, faces = mesh.vertices, mesh.faces
    step = max(len(surface.vertices) // _SAMPLES, 1)
    points = samples = np.concatenate(
        [
            surface.vertices[::step],
            sample_surface(surface.mesh, _SAMPLES // 2, np.random.default_rng(0))[0],
        ]
    )
    max_faces, input_constraints = len(faces) * (1 + max_added), constraints
    triangles, face_idx = triangulated(faces)
    away, nearest, _ = closest_points(points, TriMesh(vertices, triangles))
    of_samples = away, face_idx[nearest]  # None once the quads have changed
    for turn in range(_MAX_STEPS):
        if turn:
            triangles, face_idx = triangulated(faces)
            away, nearest = _nearest_within(points, away, TriMesh(vertices, triangles))
        uncovered = away > _UNCOVERED * edge  # the other samples stay near
        points, away, nearest = points[uncovered], away[uncovered], nearest[uncovered]
        if not len(points) or not turn and away.max() < _STRAYS * edge:
            break
        alive = np.ones(len(points), bool)
        for tip in _group_tips(points, away, edge):
            if away[tip].max() < _CLOSE * edge or len(faces) > max_faces:
                break
            samples_of_tip = _Tip(points[tip], face_idx[nearest[tip]], away[tip])
            extruded = _extrude_tip(QuadMesh(vertices, faces), constraints, samples_of_tip, surface, edge)
            if extruded is None:
                alive[tip] = False
            else:
                longer, constraints = extruded
                vertices, faces = longer.vertices, longer.faces
                of_samples = None
        points, away = points[alive], away[alive]
        if not len(points) or len(faces) > max_faces or away.max() < _CLOSE * edge:
            break
    if of_samples is None:
        triangles, face_idx = triangulated(faces)
        away, nearest, _ = closest_points(samples, TriMesh(vertices, triangles))
        of_samples = away, face_idx[nearest]
    away, nearest = of_samples
    vertices, constraints = _move_to_near_tips(
        QuadMesh(vertices, faces), constraints, _Tip(samples, nearest, away), edge
    )
    if constraints is not input_constraints:
        constraints = _remaining_paths(constraints, faces)
    was_fixed = np.concatenate([input_constraints.fixed, np.zeros(len(vertices) - len(input_constraints.fixed), bool)])
    tips = np.flatnonzero(constraints.fixed & ~was_fixed)
    return ExtrudedQuads(QuadMesh(vertices, faces), constraints, tips, float(away.max()), away[-(_SAMPLES // 2) :])


def _move_to_near_tips(
    mesh: QuadMesh, constraints: Constraints, samples: _Tip, edge: float
) -> tuple[np.ndarray, Constraints]:
    """Move the nearest vertex to the end of each tip less than an edge away, and fix it there."""
    vertices, faces = mesh.vertices, mesh.faces
    near = (samples.distances > _UNCOVERED * edge) & (samples.distances < _STRAYS * edge)
    points, quads, away = samples.points[near], samples.quads[near], samples.distances[near]
    if not len(points):
        return vertices, constraints
    ends = [
        tip[away[tip].argmax()]
        for tip in _group_tips(points, away, edge)
        if np.ptp(points[tip], 0).max() < _MAX_SINGLE_TIP * edge
    ]
    corner = faces[quads[ends], np.linalg.norm(vertices[faces[quads[ends]]] - points[ends][:, None], axis=-1).argmin(1)]
    moved, first = np.unique(corner, return_index=True)  # the farthest tip comes first
    out = vertices.copy()
    out[moved] = points[ends][first]
    return out, _extend_constraints(constraints, len(vertices), moved, moved)


def _nearest_within(points: np.ndarray, away: np.ndarray, mesh: TriMesh) -> tuple[np.ndarray, np.ndarray]:
    """Compute the distances (n,) from points (n, 3) to a mesh, and their nearest triangles (n,).

    away (n,): estimates of the distances. Triangles farther away than the largest of these are searched only if a point
    is.
    """
    from scipy.spatial import cKDTree

    vertices, triangles = mesh.vertices, mesh.faces

    corners = vertices[triangles]
    reach = away.max()
    longest = np.linalg.norm(corners - np.roll(corners, 1, 1), axis=-1).max()
    near = np.isfinite(cKDTree(points).query(vertices, distance_upper_bound=reach + longest)[0])
    few = np.flatnonzero(near[triangles].any(1))
    if len(few):
        distances, nearest, _ = closest_points(points, TriMesh(vertices, triangles[few]))
        if distances.max() <= reach:
            return distances, few[nearest]
    return closest_points(points, mesh)[:2]


def _group_tips(points: np.ndarray, away: np.ndarray, edge: float) -> list[np.ndarray]:
    """Group points that are connected by steps of an edge: the indices of each tip, the farthest tip first."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(edge, output_type="ndarray")
    count, label = connected_components(
        coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(points),) * 2), False
    )
    tips = [np.flatnonzero(label == k) for k in range(count)]
    return sorted(tips, key=lambda tip: -away[tip].max())


def _extrude_tip(
    mesh: QuadMesh,
    constraints: Constraints,
    tip: _Tip,
    surface: ProjectionTarget,
    edge: float,
) -> tuple[QuadMesh, Constraints] | None:
    """Extrude the disc of quads under one tip toward it; None where no disc of quads lies under it."""
    vertices, faces = mesh.vertices, mesh.faces
    points, away = tip.points, tip.distances
    corner = faces[tip.quads, np.linalg.norm(vertices[faces[tip.quads]] - points[:, None], axis=-1).argmin(1)]
    # Each vertex aims at its farthest point within a step, or at its nearest where all are farther.
    order = np.argsort(np.where(away <= _STEP * edge, -away, away), kind="stable")
    cap, first = np.unique(corner[order], return_index=True)
    aim = points[order[first]]
    patch = np.isin(faces, cap).any(1)
    loop = _disc_boundary(faces, patch, cap)
    if loop is None:  # then the farthest vertex alone
        cap, aim = np.array([corner[order[0]]]), points[order[:1]]
        patch = np.isin(faces, cap).any(1)
        loop = _disc_boundary(faces, patch, cap)
    if loop is None:
        return None
    shift = np.zeros_like(vertices)
    shift[cap] = aim - vertices[cap]
    length = np.linalg.norm(shift[cap], axis=1)
    rings = max(round(length.max() / edge), 1)
    base = loop[:, 0]
    for vertex in base.tolist():
        near = np.intersect1d(faces[patch & (faces == vertex).any(1)], cap)
        shift[vertex] = shift[near].mean(0) if len(near) else 0
    share = np.arange(1, rings + 1)[:, None, None] / (rings + 1)
    new = surface.closest((vertices[base] + share * shift[base]).reshape(-1, 3))[2]
    ring = np.concatenate([base, len(vertices) + np.arange(len(new))]).reshape(rings + 1, -1)
    after = np.roll(ring, -1, 1)
    sides = np.stack([ring[:-1], after[:-1], after[1:], ring[1:]], -1).reshape(-1, 4)
    lifted = np.arange(len(vertices))
    lifted[base] = ring[-1]
    faces = np.concatenate([np.where(patch[:, None], lifted[faces], faces), sides])
    vertices = np.concatenate([vertices, new])
    vertices[cap] = aim
    far_first = [k for k in np.argsort(-length, kind="stable") if length[k] > _FIXED_SHARE * length.max()]
    fixed = cap[_spaced_out(aim, far_first, _MIN_SPACING * edge)]
    return QuadMesh(vertices, faces), _extend_constraints(constraints, len(vertices), cap, fixed)


def _spaced_out(points: np.ndarray, order: list[int], distance: float) -> list[int]:
    """Choose points (n, 3) greedily in the given order, each farther than `distance` from those chosen before it."""
    chosen: list[int] = []
    for k in order:
        if (np.linalg.norm(points[chosen] - points[k], axis=1) > distance).all():
            chosen.append(k)
    return chosen


def _disc_boundary(faces: np.ndarray, patch: np.ndarray, cap: np.ndarray) -> np.ndarray | None:
    """Find the boundary of a patch of faces (f,) bool: its directed edges (n, 2), in order.

    Returns None unless the patch is a disc whose inner vertices are exactly `cap`.
    """
    patch_faces = faces[patch]
    edges = edges_of(patch_faces)
    half = edges.half_ends[edges.count[edges.half_edge_idx] == 1]
    # Inner edges have two quads, the boundary passes no vertex twice and none of the cap.
    if (
        (edges.count > 2).any()
        or edges.turned.any()
        or len(np.unique(half[:, 0])) < len(half)
        or np.isin(half, cap).any()
    ):
        return None
    # One piece without handles.
    if (
        components(patch_faces)[0] != 1
        or euler_number(patch_faces) != 1
        or len(np.unique(patch_faces)) != len(half) + len(cap)
    ):
        return None
    following = dict(half.tolist())
    loop = [int(half[0, 0])]
    while (on := following[loop[-1]]) != loop[0]:
        loop.append(on)
        if len(loop) > len(half):
            return None
    return np.stack([loop, np.roll(loop, -1)], -1) if len(loop) == len(half) else None


def _extend_constraints(constraints: Constraints, count: int, moved: np.ndarray, fixed: np.ndarray) -> Constraints:
    """Extend constraints to `count` vertices: release those that moved, and fix the `fixed` ones; paths stay."""
    curve, is_fixed = np.full(count, -1), np.zeros(count, bool)
    curve[: len(constraints.curve)], is_fixed[: len(constraints.fixed)] = constraints.curve, constraints.fixed
    curve[moved], is_fixed[moved], is_fixed[fixed] = -1, False, True
    return replace(constraints, curve=curve, fixed=is_fixed)


def _remaining_paths(constraints: Constraints, faces: np.ndarray) -> Constraints:
    """Drop path edges that are no longer edges of the faces, or no longer held at both ends."""
    ends, path, width = edges_of(faces).ends, np.sort(constraints.path, 1), len(constraints.curve) + 1
    remaining = np.isin(path[:, 0] * width + path[:, 1], ends[:, 0] * width + ends[:, 1]) & (
        constraints.curve[path] >= 0
    ).all(1)
    return replace(constraints, path=constraints.path[remaining], path_curve=constraints.path_curve[remaining])
