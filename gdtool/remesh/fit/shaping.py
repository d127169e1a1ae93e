"""Quads drawn onto the surface that they stand for: to its creases and boundaries, evened out, unfolded; and how well
they do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import polygon_normals, scaled_jacobian
from gdtool.geometry.topology import triangulated
from gdtool.remesh.connectivity.diagonal_collapse import without_folded
from gdtool.remesh.fit.feature_curves import Constraints, Features, trace, untied
from gdtool.remesh.fit.feature_diagonals import crossed, cut_along_features, held_at_centres, to_rim
from gdtool.remesh.fit.squaring import balance, ease, square_up
from gdtool.remesh.fit.surface_projection import Surface, onto, relax, subdivide
from gdtool.remesh.fit.tip_extrusion import draw_out
from gdtool.remesh.fit.untangle import unfold

if TYPE_CHECKING:
    from gdtool.remesh.task import Request

_NO_AREA = 1e-4  # squared edge lengths
# Farther than this before it is shaped, or so much of its area cut off, a subdivided result is given up.
_HOPELESS_EDGES, _HOPELESS_SHARE = 1.7, 0.02
_RIM_EDGES = 2.0  # the engine ends its quads so near to a boundary of the surface
# Edge lengths that a result may stray; of a subdivided one, after which others come.
FAR_EDGES, FAR_SUBDIVIDED = 2.0, 1.0
_LIKELY = 0.75  # of them: what strays less before it is shaped is not likely to stray more than it may afterwards
_LOST_EDGES, _LOST_SHARE = 0.75, 0.003  # surface so far from the quads is lost on them, and how much of it may be
_MOST_FOLDED = 0.01  # of the quads
_CUT_EDGES = 0.25  # surface so far from the quads lies beyond an edge that they cut off
# How much of it may, as paired triangles keep its edges; of a subdivided result, after which finer ones come.
CUT_OFF, CUT_SUBDIVIDED = 0.0125, 0.005
TOO_COARSE = _STRAYS, LEAVES_OUT, STICKS_OUT, _CUTS_OFF = "strays", "leaves out", "sticks out", "cuts off"
_MOST_BARE = 0.8  # edge lengths that a corner may be from quads, rather than that they stay folded
_FOLDED, _LET_GO = 0.05, 0.25  # scaled Jacobian; edge lengths


@dataclass(frozen=True)
class Outline:
    """An engine's quads drawn to the creases, subdivided and drawn out over tips, not evened out yet."""

    vertices: np.ndarray  # (v, 3)
    faces: np.ndarray  # (f, 4)
    constraints: Constraints
    tips: np.ndarray  # vertices (t,) that are to stay
    edge: float  # about its quads' edge length
    far: float  # edge lengths that samples of the surface are from it at most
    limit: float  # edge lengths that quads made of it may stray
    hopeless: bool  # shaping brings it a third nearer at most, which does not do


def outlined(
    vertices: np.ndarray, faces: np.ndarray, surface: Surface, features: Features, subdivisions: int, request: Request
) -> Outline:
    """The engine's quads drawn to creases, subdivided, and drawn out over tips."""
    edge = (polygon_normals(vertices, faces)[1].sum() / len(faces)) ** 0.5
    vertices, constraints = trace(to_rim(vertices, faces, surface, _RIM_EDGES * edge), faces, features, edge)
    free = untied(vertices, faces, constraints)
    (across, curve), constraints = crossed(faces, constraints, free), free
    vertices = relax(
        onto(vertices, surface, features, constraints), faces, surface, features, constraints, request.smooth_iterations
    )
    for turn in range(subdivisions):
        count = len(faces)
        vertices, faces, constraints = subdivide(vertices, faces, constraints)
        if not turn:
            constraints = held_at_centres(constraints, len(vertices) - count, across, curve)
        vertices = relax(
            onto(vertices, surface, features, constraints),
            faces,
            surface,
            features,
            constraints,
            request.smooth_iterations,
        )
    edge /= 2**subdivisions
    if subdivisions:  # what ran across a quad has vertices nearer to it now
        vertices, constraints = trace(vertices, faces, features, edge)
    vertices, faces, constraints, tips, far, away = draw_out(vertices, faces, constraints, surface, edge)
    hopeless = subdivisions > 0 and (
        far > _HOPELESS_EDGES * edge or (away > _CUT_EDGES * edge).mean() > _HOPELESS_SHARE
    )
    return Outline(
        vertices, faces, constraints, tips, edge, far / edge, FAR_SUBDIVIDED if subdivisions else FAR_EDGES, hopeless
    )


def drawn(
    outline: Outline, surface: Surface, features: Features, request: Request
) -> tuple[np.ndarray, np.ndarray, Constraints]:
    """An outline evened out on the surface, unfolded and without what stays folded, unless that is hopeless; what it is
    held to."""
    if outline.hopeless:
        return outline.vertices, outline.faces, outline.constraints
    faces = outline.faces
    vertices, constraints = _squared(outline.vertices, faces, surface, features, outline.constraints, request)
    if (
        outline.far > _LIKELY * outline.limit
        and farthest(surface_of(vertices, faces), surface) > outline.limit * outline.edge
    ):
        return vertices, faces, constraints  # what unfolds quads brings them no nearer
    vertices, constraints = _unfolded(vertices, faces, surface, features, constraints, outline.tips)
    fixed = np.flatnonzero(constraints.fixed)
    vertices, faces, constraints = without_folded(vertices, faces, surface, constraints)
    if len(faces) < len(outline.faces):
        vertices = unfold(vertices, faces, surface, features, constraints)
    if (scaled_jacobian(vertices, faces) <= 0).any():
        # What was fixed is there still, in its order.
        tips = np.flatnonzero(constraints.fixed)[np.isin(fixed, outline.tips)]
        vertices, constraints = ease(
            vertices, faces, surface, features, constraints, _FOLDED, tips=tips, most_bare=_MOST_BARE
        )
    return vertices, faces, constraints


def settled(
    vertices: np.ndarray, faces: np.ndarray, constraints: Constraints, fine: Surface, request: Request
) -> tuple[np.ndarray, np.ndarray]:
    """Quads balanced about the input as it was before it was simplified, and cut in two where they bend along it."""
    if request.smooth_iterations:
        vertices = balance(vertices, faces, fine, constraints)
    return vertices, cut_along_features(vertices, faces, fine)


def _squared(
    vertices: np.ndarray,
    faces: np.ndarray,
    surface: Surface,
    features: Features,
    constraints: Constraints,
    request: Request,
) -> tuple[np.ndarray, Constraints]:
    """The quads squared up; what they are held to from then on."""
    vertices = square_up(vertices, faces, surface, features, constraints, request.smooth_iterations)
    constraints = untied(vertices, faces, constraints)
    return square_up(vertices, faces, surface, features, constraints, 2 * request.smooth_iterations), constraints


def _unfolded(
    vertices: np.ndarray,
    faces: np.ndarray,
    surface: Surface,
    features: Features,
    constraints: Constraints,
    tips: np.ndarray | None = None,
) -> tuple[np.ndarray, Constraints]:
    """The few quads that stay folded or thin unfolded one vertex at a time; what they are held to from then on."""
    vertices = unfold(vertices, faces, surface, features, constraints)
    return ease(vertices, faces, surface, features, constraints, tips=tips)


def evened(
    quad_vertices: np.ndarray, quad_faces: np.ndarray, surface: Surface, features: Features, request: Request
) -> tuple[np.ndarray, Constraints]:
    """Vertices of quads of a surface evened out on it, whatever becomes of the quads, and what they are held to."""
    edge = (polygon_normals(quad_vertices, quad_faces)[1].sum() / len(quad_faces)) ** 0.5
    traced, constraints = trace(quad_vertices, quad_faces, features, edge)
    constraints = untied(traced, quad_faces, constraints)
    traced = relax(
        onto(traced, surface, features, constraints),
        quad_faces,
        surface,
        features,
        constraints,
        request.smooth_iterations,
    )
    traced, constraints = _squared(traced, quad_faces, surface, features, constraints, request)
    return _unfolded(traced, quad_faces, surface, features, constraints)


def better(
    quad_vertices: np.ndarray,
    quad_faces: np.ndarray,
    traced: np.ndarray,
    constraints: Constraints,
    surface: Surface,
    request: Request,
    fine: Surface,
) -> np.ndarray:
    """Vertices of quads as they are or, balanced about the input before it was simplified, as evened() left them, each
    piece and each quad where that makes it better."""
    edge = (polygon_normals(quad_vertices, quad_faces)[1].sum() / len(quad_faces)) ** 0.5
    if request.smooth_iterations:
        traced = balance(traced, quad_faces, fine, constraints)
    # Pieces that are a few quads wide fold and shrink when their vertices are evened out: they stay as they were split,
    # and elsewhere the vertices of quads that folded or let go of a corner.
    count, piece = topology.components(quad_faces)
    split, evened = (scaled_jacobian(v, quad_faces) for v in (quad_vertices, traced))
    worse = (np.bincount(piece, evened, count) < np.bincount(piece, split, count))[piece]
    worse[_let_go(surface, quad_vertices, traced, quad_faces, _LET_GO * edge)] = True
    stays = np.zeros(len(quad_vertices), bool)
    while worse.any():
        stays[quad_faces[worse]] = True
        evened = scaled_jacobian(np.where(stays[:, None], quad_vertices, traced), quad_faces)
        worse = (evened < _FOLDED) & (split > evened) & ~stays[quad_faces].all(1)
    # What has no area as it was split was better off evened out.
    least = _NO_AREA * edge**2
    flat = polygon_normals(np.where(stays[:, None], quad_vertices, traced), quad_faces)[1] < least
    stays[quad_faces[flat & (polygon_normals(traced, quad_faces)[1] >= least)]] = False
    return np.where(stays[:, None], quad_vertices, traced)


def _let_go(
    surface: Surface, vertices: np.ndarray, moved: np.ndarray, faces: np.ndarray, distance: float
) -> np.ndarray:
    """Faces (k,) that stood for surface farther than `distance` from them, and twice as far as before, once their
    vertices moved."""
    from gdtool.geometry.distance import closest_points, sample_surface

    points = sample_surface(surface.vertices, surface.faces, 20000, np.random.default_rng(0))[0]
    triangles, face_idx = triangulated(faces)
    (before, nearest), after = (
        closest_points(points, vertices, triangles)[:2],
        closest_points(points, moved, triangles)[0],
    )
    return np.unique(face_idx[nearest[(after > distance) & (after > 2 * before)]])


def fault_of(
    vertices: np.ndarray, quads: np.ndarray, surface: Surface, edge: float, limit: float, most_cut: float
) -> tuple[str | None, float]:
    """What of finished quads does not do on the surface, or None, and how far they are from it, in edge lengths.

    limit: edge lengths that they may stray. most_cut: share of the surface that may lie beyond an edge that they cut
    off."""
    mine = surface_of(vertices, quads)
    if (far := farthest(mine, surface) / edge) > limit:
        return f"{_STRAYS} {far:.2g} edge lengths from the surface", far
    left, cut = left_out(mine, surface, (_LOST_EDGES * edge, _CUT_EDGES * edge))
    if left > _LOST_SHARE:
        return f"{LEAVES_OUT} {left:.1%} of the surface", far
    if (over := sticks_out(vertices, quads, surface) / edge) > limit:
        return f"{STICKS_OUT} {over:.2g} edge lengths", far
    if (folded := float((scaled_jacobian(vertices, quads) <= 0).mean())) > _MOST_FOLDED:
        return f"{folded:.1%} of the quads are folded", far
    if cut > most_cut:
        return f"{_CUTS_OFF} {cut:.1%} of the surface", far
    return None, far


def surface_of(vertices: np.ndarray, quads: np.ndarray) -> Surface:
    """The surface of the triangles that quads are cut into."""
    return Surface(vertices, triangulated(quads)[0])


def farthest(quads: Surface, surface: Surface) -> float:
    """How far the surface is from the quads at most: large where they are too coarse for a detail or leave out a
    corner."""
    step = max(len(surface.vertices) // 20000, 1)
    return float(quads.closest(surface.vertices[::step])[0].max())


def sticks_out(vertices: np.ndarray, faces: np.ndarray, surface: Surface) -> float:
    """How far the middle of a quad is from the surface at most: large where quads bridge a gap or stand away from
    it."""
    return float(surface.closest(vertices[faces].mean(1))[0].max())


def left_out(quads: Surface, surface: Surface, distances: tuple[float, ...]) -> list[float]:
    """Shares of the surface's area that lie farther than each of `distances` from the quads: thin parts and rims that
    they do without."""
    from gdtool.geometry.distance import sample_surface

    points = sample_surface(surface.vertices, surface.faces, 10000, np.random.default_rng(0))[0]
    away = quads.closest(points)[0]
    return [float((away > distance).mean()) for distance in distances]
