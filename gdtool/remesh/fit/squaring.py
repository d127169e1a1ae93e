"""Make quads square on the surface.

Each quad is fitted with its nearest rectangle, and each vertex moves toward the mean of its rectangles' corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.geometry.distance import closest_points
from gdtool.geometry.mesh_quality import gather_corners, polygon_normals, scaled_jacobian, worst_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import edges_of, triangulated
from gdtool.geometry.vectors import cross, dot
from gdtool.remesh.fit.feature_curves import Constraints, Features
from gdtool.remesh.fit.surface_projection import (
    ConstrainedProjector,
    ProjectionTarget,
    immovable_vertices,
    relax,
    surface_normals_below,
)
from gdtool.remesh.fit.untangle import untangle

_SQUARE_SHARE = 0.4  # of the way from the nearest rectangle to the nearest square
_POOR = 0.6  # scaled Jacobian below which quads pull harder
_POOR_WEIGHT = 6  # extra weight of a quad, for each unit of Jacobian below _POOR
_FOLDED = 0.2  # scaled Jacobian below which a quad counts as folded when rounds are compared
_NORMALS_EVERY = 6  # rounds between two samplings of the surface's normals
_THIN = 0.3  # scaled Jacobian below which balance_heights() does not make quads worse
# Balanced quads run along the surface (cosine of the normals) and are low (heights, in edge lengths).
_ALONG_COSINE, _MAX_HEIGHT = 0.9, 0.1
# release_and_smooth() gives up after this many rounds in a row that leave most bad quads, unless these are few.
_MAX_ROUNDS_IN_VAIN, _FEW_BAD = 2, 8
_MOST_LEFT = 0.75  # share of the bad quads
_RELEASE_ROUNDS = 6
_MAX_REGION_SHARE, _MIN_REGION = 5, 2000  # faces worked on at once: one over the first of all, or the second


@dataclass(frozen=True)
class ReleaseOptions:
    """Limits of release_and_smooth().

    min_jacobian: quads with a smaller scaled Jacobian are worked on. max_uncovered_edges: the largest distance, in edge
    lengths, from the old position of a vertex to the quads after they moved.
    """

    min_jacobian: float = 0.2
    max_uncovered_edges: float = 0.5


def square_up(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    iterations: int,
    strength: float = 1.2,
) -> np.ndarray:
    """Move vertices so that the quads get right angles, on the surface and on the feature curves.

    This is shape projection (Bouaziz et al. 2012) onto rectangles in the plane of the surface under each quad. That
    plane fixes the orientation of each rectangle, so folded quads are unfolded. Returns the best vertices (v, 3) of all
    rounds: those with the fewest folded quads, then the largest mean Jacobian. strength: over-relaxation; at 1.2 ten
    rounds do what takes fifteen at 0.8.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces) or not iterations:
        return vertices
    immovable = immovable_vertices(edges_of(faces), len(vertices), constraints)
    flat_faces = faces.T.ravel()
    best, best_rank = vertices, None
    projector = ConstrainedProjector(surface, features, constraints)
    for turn in range(iterations + 1):
        if turn % _NORMALS_EVERY == 0:
            normals = np.ascontiguousarray(surface_normals_below(QuadMesh(vertices, faces), surface).T)
        p = gather_corners(vertices, faces)
        quality = worst_jacobian(p, normals)
        rank = (-int((quality < _FOLDED).sum()), float(quality.mean()))
        if best_rank is None or rank > best_rank:
            best, best_rank = vertices, rank
        if turn == iterations:
            break
        weight = 1 + _POOR_WEIGHT * np.clip(_POOR - quality, 0, 1)
        wanted = _nearest_rectangles(p, normals).reshape(3, -1)
        weights = np.tile(weight, 4)
        total = np.maximum(np.bincount(flat_faces, weights, len(vertices)), 1e-300)
        target = (
            np.stack([np.bincount(flat_faces, weights * wanted[i], len(vertices)) for i in range(3)], -1)
            / total[:, None]
        )
        moved = vertices + strength * (target - vertices)
        moved[immovable] = vertices[immovable]
        vertices = projector.step(moved, vertices, turn == iterations - 1)
    return best if best is projector.placed else projector.exact(best)


def balance_heights(mesh: QuadMesh, surface: ProjectionTarget, constraints: Constraints) -> np.ndarray:
    """Move vertices off the surface so that as much of it lies above their quads as below.

    A quad whose corners lie on a curved surface lies beneath it everywhere, which is half of its error. Vertices move
    by the mean height of the surface over their quads. Vertices on features and boundaries stay, as do those of quads
    that do not run along the surface, and of thin quads that would become thinner.
    """
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    free = (constraints.curve < 0) & ~immovable_vertices(edges, len(vertices), constraints)
    normals, area = polygon_normals(mesh)
    corners = vertices[faces]
    # Samples on the two triangles of each quad: their centroids, and midpoints of their edges. Midpoints of quad edges
    # are shared with the neighbouring quads.
    a, b, c, d = (corners[:, i] for i in range(4))
    inner = np.concatenate([(a + b + c) / 3, (a + c + d) / 3, (a + c) / 2])
    samples = np.concatenate([inner, vertices[edges.ends].mean(1)])
    weight = np.array([3, 3, 2, 1, 1, 1, 1]) / 12
    _, face_idx, point = surface.closest(samples)
    # (q, 7): the samples of each quad.
    quad_samples = np.concatenate(
        [np.arange(len(inner)).reshape(3, -1).T, len(inner) + edges.half_edge_idx.reshape(-1, 4)], 1
    )
    height = np.einsum("qki,qi->qk", (point - samples).take(quad_samples, 0), normals)
    is_along = np.einsum("qki,qi->qk", surface.normals[face_idx].take(quad_samples, 0), normals) > _ALONG_COSINE
    mean = np.where(is_along.all(1) & (np.abs(height).max(1) < _MAX_HEIGHT * np.sqrt(area)), height @ weight, 0.0)
    flat_faces, weights = faces.ravel(), np.repeat(area, 4)
    total = np.maximum(np.bincount(flat_faces, weights, len(vertices)), 1e-300)
    move = (
        np.stack(
            [np.bincount(flat_faces, weights * np.repeat(mean * normals[:, i], 4), len(vertices)) for i in range(3)], -1
        )
        / total[:, None]
    )
    out = np.where(free[:, None], vertices + move, vertices)
    before, after = scaled_jacobian(mesh), scaled_jacobian(QuadMesh(out, faces))
    thin = faces[(after < _THIN) & (after < before)]
    out[thin] = vertices[thin]
    return out


def _nearest_rectangles(p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return (3, 4, q) corners of the rectangle nearest to each quad.

    p (3, 4, q): corners of the quads; normals (3, q), about which the rectangles are counter-clockwise.
    """
    centre = p.mean(1, keepdims=True)
    offset = p - centre
    x = offset[:, 0] - (offset[:, 0] * normals).sum(0) * normals
    length = np.sqrt((x * x).sum(0))
    degenerate = length <= 1e-12
    if degenerate.any():
        aside = np.where(np.abs(normals[0]) < 0.9, np.array([[1.0], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]]))
        x = np.where(degenerate, cross(normals, aside), x)
        length = np.sqrt((x * x).sum(0))
    x /= np.maximum(length, 1e-300)
    y = cross(normals, x)
    z = np.empty(offset.shape[1:], np.complex128)
    z.real = dot(offset, x)
    z.imag = dot(offset, y)
    size = np.sqrt((z.real**2 + z.imag**2).mean(0))
    # The nearest square. A folded quad has hardly any, so it gets the size it takes up.
    a = (z[0] - 1j * z[1] - z[2] + 1j * z[3]) / 4
    strength = np.abs(a)
    a = np.where(strength > 1e-9 * size, a / np.maximum(strength, 1e-300), 1) * np.maximum(strength, 0.5 * size)
    # The nearest rectangle: both diagonals keep their directions and get the same length.
    first_half, second_half = (z[0] - z[2]) / 2, (z[1] - z[3]) / 2
    first_length, second_length = np.abs(first_half), np.abs(second_half)
    half = (first_length + second_length) / 2
    first_half, second_half = (
        first_half / np.maximum(first_length, 1e-300),
        second_half / np.maximum(second_length, 1e-300),
    )
    upright = (np.conj(first_half) * second_half).imag > 0.5
    first = np.where(upright, (1 - _SQUARE_SHARE) * first_half * half + _SQUARE_SHARE * a, a)
    second = np.where(upright, (1 - _SQUARE_SHARE) * second_half * half + _SQUARE_SHARE * 1j * a, 1j * a)
    first, second = (w.real * x + w.imag * y for w in (first, second))
    return centre + np.stack([first, second, -first, -second], 1)


def release_and_smooth(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    tips: np.ndarray | None = None,
    options: ReleaseOptions = ReleaseOptions(),  # noqa: B008 - frozen
) -> tuple[np.ndarray, Constraints]:
    """Release bad quads and their neighbours from feature curves and smooth them; keep what improves.

    A path along a winding crease cannot be straightened by moving vertices, so a few quads give it up. Smoothing
    shrinks corners and tips of the surface. Where it would uncover them by more than the options allow, the vertices at
    corners stay. tips: vertices that always stay. Returns vertices and constraints.
    """
    vertices, faces = mesh.vertices, mesh.faces
    in_vain, bad_count = 0, np.inf
    for turn in range(_RELEASE_ROUNDS):
        bad = scaled_jacobian(QuadMesh(vertices, faces)) < options.min_jacobian
        in_vain, bad_count = in_vain + 1 if bad.sum() > _MOST_LEFT * bad_count else 0, bad.sum()
        if not bad_count or in_vain == _MAX_ROUNDS_IN_VAIN and bad_count > _FEW_BAD:
            break
        near = np.zeros(len(vertices), bool)
        near[faces[bad]] = True
        for _ in range(1 + turn):
            near[faces[near[faces].any(1)]] = True
        region = np.flatnonzero(near[faces].any(1))
        if len(region) > max(len(faces) // _MAX_REGION_SHARE, _MIN_REGION):
            break
        if tips is not None:
            near[tips] = False
        used, local = np.unique(faces[region], return_inverse=True)
        local = local.reshape(-1, 4)
        before = vertices[used]
        open_boundary = immovable_vertices(edges_of(faces), len(vertices), constraints) & ~constraints.fixed
        for released in (near, near & ~constraints.fixed):
            # Inside the region vertices are off their curves; on its rim they stay where they were.
            local_constraints = Constraints(
                np.full(len(used), -1),
                (~released | open_boundary)[used],
                constraints.path[:0],
                constraints.path_curve[:0],
            )
            trial = _smooth_region(QuadMesh(before, local), surface, features, local_constraints, turn)
            limit = options.min_jacobian
            if _badness(scaled_jacobian(QuadMesh(trial, local)), limit) >= _badness(
                scaled_jacobian(QuadMesh(before, local)), limit
            ):
                break
            if not _uncovers_surface(before, trial, local, options.max_uncovered_edges):
                vertices = vertices.copy()
                vertices[used] = trial
                constraints = _released(constraints, released)
                break
    return vertices, constraints


def _smooth_region(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    turn: int,
) -> np.ndarray:
    """Smooth, square up and untangle a small region, with more rounds the higher `turn` is."""
    vertices, faces = mesh.vertices, mesh.faces
    vertices = relax(QuadMesh(vertices, faces), surface, features, constraints, 10 + 10 * turn)
    vertices = square_up(QuadMesh(vertices, faces), surface, features, constraints, 10)
    return untangle(QuadMesh(vertices, faces), surface, features, constraints, max_visits=1500)


def _released(constraints: Constraints, released: np.ndarray) -> Constraints:
    """Remove some vertices, released (v,) bool, and the path edges at them from constraints."""
    remaining = ~released[constraints.path].any(1)
    return Constraints(
        np.where(released, -1, constraints.curve),
        constraints.fixed & ~released,
        constraints.path[remaining],
        constraints.path_curve[remaining],
    )


def _uncovers_surface(before: np.ndarray, after: np.ndarray, faces: np.ndarray, most: float) -> bool:
    """Return whether some vertex's old position is farther from the moved quads (f, 4) than `most` edge lengths."""
    edge = (polygon_normals(QuadMesh(before, faces))[1].sum() / len(faces)) ** 0.5
    return bool(closest_points(before, TriMesh(after, triangulated(faces)[0]))[0].max() > most * edge)


def _badness(jacobian: np.ndarray, limit: float) -> tuple[int, int, float]:
    """Compute a key that compares sets of quads; less is better.

    It counts the folded quads, then those with a scaled Jacobian below `limit`, then takes the worst.
    """
    return int((jacobian <= 0).sum()), int((jacobian < limit).sum()), -float(jacobian.min())
