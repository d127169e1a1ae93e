"""Fit an engine's quads to the surface (snap, square up, untangle), and judge how well they represent it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.distance import closest_points, sample_surface
from gdtool.geometry.mesh_quality import polygon_normals, scaled_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.remesh.connectivity.diagonal_collapse import collapse_folded_quads
from gdtool.remesh.fit.feature_curves import Constraints, Features, release_straight_corners, trace_features
from gdtool.remesh.fit.feature_diagonals import choose_diagonals, hold_centres, quads_crossed_by_features, snap_boundary
from gdtool.remesh.fit.squaring import ReleaseOptions, balance_heights, release_and_smooth, square_up
from gdtool.remesh.fit.surface_projection import ProjectionTarget, project, relax, subdivide
from gdtool.remesh.fit.tip_extrusion import extrude_tips
from gdtool.remesh.fit.untangle import untangle

if TYPE_CHECKING:
    from gdtool.remesh.task import Request

# Limits of an acceptable result: the largest distance (edge lengths), and the share of the area cut off. Paired
# triangles keep edges better than that. Subdivided results have stricter limits, for finer attempts follow them.
FAR_EDGES, FAR_SUBDIVIDED = 2.0, 1.0
CUT_OFF, CUT_SUBDIVIDED = 0.0125, 0.005
_CUT_EDGES = 0.25  # edge lengths: surface farther than this from the quads lies beyond an edge that they cut off
_LOST_EDGES, _MAX_LOST_SHARE = 0.75, 0.003  # surface farther than this (edge lengths) is lost; how much of it may be
_MAX_FOLDED_SHARE = 0.01  # of the quads

# A subdivided result this far away before it is fitted (edge lengths), or with this share of its area cut off, is given
# up: fitting brings it a third nearer at most.
_HOPELESS_EDGES, _HOPELESS_SHARE = 1.7, 0.02
_LIKELY_SHARE = 0.75  # of the limit: results nearer than this before fitting hardly ever end beyond it
_BOUNDARY_EDGES = 2.0  # edge lengths: an engine's quads end this near to a boundary of the surface

_FOLDED_JACOBIAN = 0.05  # scaled Jacobian below which a quad counts as folded
_MAX_UNCOVERED_EDGES = 0.8  # edge lengths that a corner may be uncovered by, rather than leave quads folded
_ABANDONED_EDGES = 0.25  # edge lengths: smoothing must not leave surface farther than this from the quads
_MIN_AREA = 1e-4  # squared edge lengths: quads of less have no area
_SURFACE_SAMPLES, _SHARE_SAMPLES = 20000, 10000

# First words of the reasons of rejection_reason(); TOO_COARSE are those that no other density mends.
TOO_COARSE = _STRAYS, LEAVES_OUT, STICKS_OUT, _CUTS_OFF = "strays", "leaves out", "sticks out", "cuts off"


@dataclass(frozen=True)
class SnappedQuads:
    """An engine's quads snapped to the features, subdivided and extruded over tips, before they are smoothed.

    tips (t,): vertices that have to stay; edge: about the edge length of the quads. distance_edges: the largest
    distance from samples of the surface; limit_edges: the largest that the fitted quads may have, both in edge lengths.
    hopeless: too far away for fitting to help.
    """

    mesh: QuadMesh
    constraints: Constraints
    tips: np.ndarray
    edge: float
    distance_edges: float
    limit_edges: float
    hopeless: bool


class FittedQuads(NamedTuple):
    """Quads fitted to the surface, and the constraints that later steps keep."""

    mesh: QuadMesh
    constraints: Constraints


def snap_to_features(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    subdivisions: int,
    request: Request,
) -> SnappedQuads:
    """Snap an engine's quads to creases and boundaries, subdivide them, and extrude them over tips."""
    vertices, faces = mesh.vertices, mesh.faces
    edge = (polygon_normals(mesh)[1].sum() / len(faces)) ** 0.5
    vertices, traced = trace_features(
        QuadMesh(snap_boundary(mesh, surface, _BOUNDARY_EDGES * edge), faces), features, edge
    )
    constraints = release_straight_corners(QuadMesh(vertices, faces), traced)
    crossed_quads, curve = quads_crossed_by_features(faces, traced, constraints)

    def relaxed() -> np.ndarray:
        projected = project(vertices, surface, features, constraints)
        return relax(QuadMesh(projected, faces), surface, features, constraints, request.smooth_iterations)

    vertices = relaxed()
    for turn in range(subdivisions):
        count = len(faces)
        subdivided, constraints = subdivide(QuadMesh(vertices, faces), constraints)
        vertices, faces = subdivided.vertices, subdivided.faces
        if not turn:
            constraints = hold_centres(constraints, len(vertices) - count, crossed_quads, curve)
        vertices = relaxed()
    edge /= 2**subdivisions
    if subdivisions:  # features that ran across a quad have vertices nearer to them now
        vertices, constraints = trace_features(QuadMesh(vertices, faces), features, edge)
    extruded = extrude_tips(QuadMesh(vertices, faces), constraints, surface, edge)
    hopeless = subdivisions > 0 and (
        extruded.distance > _HOPELESS_EDGES * edge
        or (extruded.sample_distances > _CUT_EDGES * edge).mean() > _HOPELESS_SHARE
    )
    limit = FAR_SUBDIVIDED if subdivisions else FAR_EDGES
    return SnappedQuads(
        extruded.mesh, extruded.constraints, extruded.tips, edge, extruded.distance / edge, limit, hopeless
    )


def fit_to_surface(
    snapped: SnappedQuads, surface: ProjectionTarget, features: Features, request: Request
) -> FittedQuads:
    """Smooth snapped quads on the surface, untangle them, and collapse those that stay folded.

    Hopeless quads are returned as they are.
    """
    if snapped.hopeless:
        return FittedQuads(snapped.mesh, snapped.constraints)
    faces = snapped.mesh.faces
    vertices, constraints = _square_twice(snapped.mesh, surface, features, snapped.constraints, request)
    if (
        snapped.distance_edges > _LIKELY_SHARE * snapped.limit_edges
        and max_distance(target_of_quads(QuadMesh(vertices, faces)), surface) > snapped.limit_edges * snapped.edge
    ):
        return FittedQuads(QuadMesh(vertices, faces), constraints)  # rejected anyway: untangling brings it no nearer
    vertices, constraints = _untangle_and_release(
        QuadMesh(vertices, faces), surface, features, constraints, snapped.tips
    )
    fixed = np.flatnonzero(constraints.fixed)
    mesh, constraints = collapse_folded_quads(QuadMesh(vertices, faces), surface, constraints)
    if len(mesh.faces) < len(faces):
        mesh = QuadMesh(untangle(mesh, surface, features, constraints), mesh.faces)
    if (scaled_jacobian(mesh) <= 0).any():
        # Collapsing keeps fixed vertices, in their order: so the tips are found again.
        tips = np.flatnonzero(constraints.fixed)[np.isin(fixed, snapped.tips)]
        options = ReleaseOptions(_FOLDED_JACOBIAN, _MAX_UNCOVERED_EDGES)
        vertices, constraints = release_and_smooth(mesh, surface, features, constraints, tips=tips, options=options)
        mesh = QuadMesh(vertices, mesh.faces)
    return FittedQuads(mesh, constraints)


def finalize(fitted: FittedQuads, full_surface: ProjectionTarget, request: Request) -> QuadMesh:
    """Balance the heights of fitted quads about the full surface, and choose the diagonals that follow it.

    full_surface: the input before it was simplified. Balance: see squaring.balance_heights.
    """
    mesh = fitted.mesh
    if request.smooth_iterations:
        mesh = QuadMesh(balance_heights(mesh, full_surface, fitted.constraints), mesh.faces)
    return QuadMesh(mesh.vertices, choose_diagonals(mesh, full_surface))


def _square_twice(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    request: Request,
) -> tuple[np.ndarray, Constraints]:
    """Square up the quads, release straight corners, and square up again; return vertices and constraints."""
    vertices = square_up(mesh, surface, features, constraints, request.smooth_iterations)
    squared = QuadMesh(vertices, mesh.faces)
    constraints = release_straight_corners(squared, constraints)
    return square_up(squared, surface, features, constraints, 2 * request.smooth_iterations), constraints


def _untangle_and_release(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    constraints: Constraints,
    tips: np.ndarray | None = None,
) -> tuple[np.ndarray, Constraints]:
    """Untangle the few quads that stay folded or thin, and release them from features where needed."""
    untangled = QuadMesh(untangle(mesh, surface, features, constraints), mesh.faces)
    return release_and_smooth(untangled, surface, features, constraints, tips=tips)


def smoothed(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    features: Features,
    request: Request,
) -> tuple[np.ndarray, Constraints]:
    """Snap quads to the features and smooth them on the surface, even where that makes some worse.

    Returns vertices (v, 3) and constraints. keep_better_vertices() chooses between these vertices and the input's.
    """
    quad_faces = mesh.faces
    edge = (polygon_normals(mesh)[1].sum() / len(quad_faces)) ** 0.5
    vertices, constraints = trace_features(mesh, features, edge)
    constraints = release_straight_corners(QuadMesh(vertices, quad_faces), constraints)
    vertices = relax(
        QuadMesh(project(vertices, surface, features, constraints), quad_faces),
        surface,
        features,
        constraints,
        request.smooth_iterations,
    )
    vertices, constraints = _square_twice(QuadMesh(vertices, quad_faces), surface, features, constraints, request)
    return _untangle_and_release(QuadMesh(vertices, quad_faces), surface, features, constraints)


def keep_better_vertices(
    mesh: QuadMesh,
    moved: np.ndarray,
    constraints: Constraints,
    surface: ProjectionTarget,
    request: Request,
    full_surface: ProjectionTarget,
) -> np.ndarray:
    """Choose for each vertex its smoothed position or its original one, by piece and by quad.

    moved (v, 3) and constraints are those of smoothed(). Before the choice, the smoothed quads are moved so that as
    much of the full surface lies above as below them (squaring.balance_heights).
    """
    quad_vertices, quad_faces = mesh.vertices, mesh.faces
    edge = (polygon_normals(mesh)[1].sum() / len(quad_faces)) ** 0.5
    if request.smooth_iterations:
        moved = balance_heights(QuadMesh(moved, quad_faces), full_surface, constraints)
    # Pieces a few quads wide fold and shrink when smoothed, so they keep their original vertices. Elsewhere the quads
    # that folded, or left a corner of the surface uncovered, keep theirs.
    count, piece = topology.components(quad_faces)
    original_quality, quality = (scaled_jacobian(QuadMesh(v, quad_faces)) for v in (quad_vertices, moved))
    worse = (np.bincount(piece, quality, count) < np.bincount(piece, original_quality, count))[piece]
    worse[_abandoning_faces(surface, mesh, moved, _ABANDONED_EDGES * edge)] = True
    stays = np.zeros(len(quad_vertices), bool)
    while worse.any():
        stays[quad_faces[worse]] = True
        quality = scaled_jacobian(QuadMesh(np.where(stays[:, None], quad_vertices, moved), quad_faces))
        worse = (quality < _FOLDED_JACOBIAN) & (original_quality > quality) & ~stays[quad_faces].all(1)
    # Quads without area in the original position are better off smoothed.
    min_area = _MIN_AREA * edge**2
    flat = polygon_normals(QuadMesh(np.where(stays[:, None], quad_vertices, moved), quad_faces))[1] < min_area
    stays[quad_faces[flat & (polygon_normals(QuadMesh(moved, quad_faces))[1] >= min_area)]] = False
    return np.where(stays[:, None], quad_vertices, moved)


def _abandoning_faces(surface: ProjectionTarget, mesh: QuadMesh, moved: np.ndarray, distance: float) -> np.ndarray:
    """Find the faces (k,) whose move leaves some of the surface uncovered.

    Such surface is then farther than `distance` from all quads, and twice as far as before.
    """
    points = sample_surface(surface.mesh, _SURFACE_SAMPLES, np.random.default_rng(0))[0]
    triangles, face_idx = mesh.triangulation
    before, nearest = closest_points(points, TriMesh(mesh.vertices, triangles))[:2]
    after = closest_points(points, TriMesh(moved, triangles))[0]
    return np.unique(face_idx[nearest[(after > distance) & (after > 2 * before)]])


def rejection_reason(
    mesh: QuadMesh,
    surface: ProjectionTarget,
    edge: float,
    limit_edges: float,
    max_cut_share: float,
) -> tuple[str | None, float]:
    """Judge finished quads against the surface; return the reason to reject them, or None, and their distance.

    limit_edges: the largest distance allowed from the surface, in edge lengths. max_cut_share: the largest share of the
    surface's area that may lie beyond an edge that the quads cut off. The distance returned is the largest from the
    surface, in edge lengths.
    """
    quad_surface = target_of_quads(mesh)
    if (distance := max_distance(quad_surface, surface) / edge) > limit_edges:
        return f"{_STRAYS} {distance:.2g} edge lengths from the surface", distance
    lost, cut = uncovered_shares(quad_surface, surface, (_LOST_EDGES * edge, _CUT_EDGES * edge))
    if lost > _MAX_LOST_SHARE:
        return f"{LEAVES_OUT} {lost:.1%} of the surface", distance
    if (overshoot := max_overshoot(mesh, surface) / edge) > limit_edges:
        return f"{STICKS_OUT} {overshoot:.2g} edge lengths", distance
    if (folded := float((scaled_jacobian(mesh) <= 0).mean())) > _MAX_FOLDED_SHARE:
        return f"{folded:.1%} of the quads are folded", distance
    if cut > max_cut_share:
        return f"{_CUTS_OFF} {cut:.1%} of the surface", distance
    return None, distance


def target_of_quads(mesh: QuadMesh) -> ProjectionTarget:
    """Make the projection target of the triangles that quads are cut into."""
    return ProjectionTarget(mesh.triangles)


def max_distance(quads: ProjectionTarget, surface: ProjectionTarget) -> float:
    """Compute the largest distance from the surface's vertices (at most about 20,000 of them) to the quads.

    It is large where quads are too coarse for a detail, or leave out a corner.
    """
    step = max(len(surface.vertices) // _SURFACE_SAMPLES, 1)
    return float(quads.closest(surface.vertices[::step])[0].max())


def max_overshoot(mesh: QuadMesh, surface: ProjectionTarget) -> float:
    """Compute the largest distance from a quad's centre to the surface; it is large where quads bridge a gap."""
    return float(surface.closest(mesh.vertices[mesh.faces].mean(1))[0].max())


def uncovered_shares(quads: ProjectionTarget, surface: ProjectionTarget, distances: tuple[float, ...]) -> list[float]:
    """Compute for each distance the share of the surface's area that lies farther from the quads."""
    points = sample_surface(surface.mesh, _SHARE_SAMPLES, np.random.default_rng(0))[0]
    away = quads.closest(points)[0]
    return [float((away > distance).mean()) for distance in distances]
