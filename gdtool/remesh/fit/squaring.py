"""Quads made square where they are: each asks for the rectangle nearest to it, each vertex gives its quads their
mean."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.distance import closest_points
from gdtool.geometry.mesh_quality import columns_of, polygon_normals, scaled_jacobian, worst_jacobian
from gdtool.geometry.topology import edges_of, triangulated
from gdtool.geometry.vectors import cross, dot
from gdtool.remesh.fit.feature_curves import Constraints, Features
from gdtool.remesh.fit.surface_projection import Slide, Surface, normals_below, relax, still_vertices
from gdtool.remesh.fit.untangle import unfold

_SQUARE_SHARE = 0.4  # of the way from the nearest rectangle to the nearest square
_POOR = 0.6  # quads with a smaller scaled Jacobian pull harder
_NORMALS_EVERY = 6
_THIN = 0.3  # quads of a smaller scaled Jacobian stay where they are balanced
# More bad quads than these are given up after so many rounds in a row that leave most of them.
_FEW_BAD, _MOST_IN_VAIN = 8, 2
_MOST_LEFT = 0.75


def square_up(
    vertices: np.ndarray,
    faces: np.ndarray,
    surface: Surface,
    features: Features,
    constraints: Constraints,
    iterations: int,
    strength: float = 1.2,
) -> np.ndarray:
    """Vertices (v, 3) such that the quads (f, 4) have right angles, on the surface and on the feature curves.

    Shape projection (Bouaziz et al. 2012) onto rectangles in the plane of the surface below each quad. That plane says
    which way round a quad goes, so folded quads are asked to turn over. The best vertices met are returned: fewest
    folded quads first, then the largest mean Jacobian. strength: of the way that vertices go at once; beyond 1 ten
    rounds do what takes fifteen at 0.8."""
    if not len(faces) or not iterations:
        return vertices
    still = still_vertices(edges_of(faces), len(vertices), constraints)
    flat = faces.T.ravel()
    best, best_rank = vertices, None
    slide = Slide(surface, features, constraints)
    for turn in range(iterations + 1):
        if turn % _NORMALS_EVERY == 0:
            normals = np.ascontiguousarray(normals_below(vertices, faces, surface).T)
        p = columns_of(vertices, faces)
        quality = worst_jacobian(p, normals)
        rank = (-int((quality < 0.2).sum()), float(quality.mean()))
        if best_rank is None or rank > best_rank:
            best, best_rank = vertices, rank
        if turn == iterations:
            break
        weight = 1 + 6 * np.clip(_POOR - quality, 0, 1)
        asked = _rectangles(p, normals).reshape(3, -1)
        shares = np.tile(weight, 4)
        total = np.maximum(np.bincount(flat, shares, len(vertices)), 1e-300)
        target = np.stack([np.bincount(flat, shares * asked[i], len(vertices)) for i in range(3)], -1) / total[:, None]
        moved = vertices + strength * (target - vertices)
        moved[still] = vertices[still]
        vertices = slide.step(moved, vertices, turn == iterations - 1)
    return best if best is slide.placed else slide.exact(best)


def balance(vertices: np.ndarray, faces: np.ndarray, surface: Surface, constraints: Constraints) -> np.ndarray:
    """Vertices moved off the surface by the mean height of it above their quads, so that as much of it lies above as
    below.

    A quad whose corners lie on a curved surface lies beneath it everywhere: half of its error is that it does. Features
    and boundaries stay where they are, and so do quads that do not run along the surface and thin ones that it would
    make thinner."""
    edges = edges_of(faces)
    free = (constraints.curve < 0) & ~still_vertices(edges, len(vertices), constraints)
    normals, area = polygon_normals(vertices, faces)
    corners = vertices[faces]
    # Of the two triangles that the quad is cut into: centroids, and middles of the edges, which are those of the quads
    # beside them too.
    a, b, c, d = (corners[:, i] for i in range(4))
    inner = np.concatenate([(a + b + c) / 3, (a + c + d) / 3, (a + c) / 2])
    samples = np.concatenate([inner, vertices[edges.ends].mean(1)])
    weight = np.array([3, 3, 2, 1, 1, 1, 1]) / 12
    _, face_idx, point = surface.closest(samples)
    # (q, 7).
    own = np.concatenate([np.arange(len(inner)).reshape(3, -1).T, len(inner) + edges.half_edge_idx.reshape(-1, 4)], 1)
    height = np.einsum("qki,qi->qk", (point - samples).take(own, 0), normals)
    along = np.einsum("qki,qi->qk", surface.normals[face_idx].take(own, 0), normals) > 0.9
    mean = np.where(along.all(1) & (np.abs(height).max(1) < 0.1 * np.sqrt(area)), height @ weight, 0.0)
    flat, shares = faces.ravel(), np.repeat(area, 4)
    total = np.maximum(np.bincount(flat, shares, len(vertices)), 1e-300)
    move = (
        np.stack([np.bincount(flat, shares * np.repeat(mean * normals[:, i], 4), len(vertices)) for i in range(3)], -1)
        / total[:, None]
    )
    out = np.where(free[:, None], vertices + move, vertices)
    before, after = scaled_jacobian(vertices, faces), scaled_jacobian(out, faces)
    thin = faces[(after < _THIN) & (after < before)]
    out[thin] = vertices[thin]
    return out


def _rectangles(p: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(3, 4, q) corners of the rectangle nearest to each quad with corners (3, 4, q), counter-clockwise about normals
    (3, q)."""
    centre = p.mean(1, keepdims=True)
    offset = p - centre
    x = offset[:, 0] - (offset[:, 0] * normals).sum(0) * normals
    length = np.sqrt((x * x).sum(0))
    flat = length <= 1e-12
    if flat.any():
        aside = np.where(np.abs(normals[0]) < 0.9, np.array([[1.0], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]]))
        x = np.where(flat, cross(normals, aside), x)
        length = np.sqrt((x * x).sum(0))
    x /= np.maximum(length, 1e-300)
    y = cross(normals, x)
    z = np.empty(offset.shape[1:], np.complex128)
    z.real = dot(offset, x)
    z.imag = dot(offset, y)
    size = np.sqrt((z.real**2 + z.imag**2).mean(0))
    # The nearest square; one that is folded has hardly any, so it gets the size it takes up.
    a = (z[0] - 1j * z[1] - z[2] + 1j * z[3]) / 4
    strength = np.abs(a)
    a = np.where(strength > 1e-9 * size, a / np.maximum(strength, 1e-300), 1) * np.maximum(strength, 0.5 * size)
    # The nearest rectangle: diagonals of one length that keep their directions. A rectangle's corners lie opposite in
    # pairs.
    one, two = (z[0] - z[2]) / 2, (z[1] - z[3]) / 2
    one_length, two_length = np.abs(one), np.abs(two)
    half = (one_length + two_length) / 2
    one, two = one / np.maximum(one_length, 1e-300), two / np.maximum(two_length, 1e-300)
    upright = (np.conj(one) * two).imag > 0.5
    first = np.where(upright, (1 - _SQUARE_SHARE) * one * half + _SQUARE_SHARE * a, a)
    second = np.where(upright, (1 - _SQUARE_SHARE) * two * half + _SQUARE_SHARE * 1j * a, 1j * a)
    first, second = (w.real * x + w.imag * y for w in (first, second))
    return centre + np.stack([first, second, -first, -second], 1)


def ease(
    vertices: np.ndarray,
    faces: np.ndarray,
    surface: Surface,
    features: Features,
    constraints: Constraints,
    least: float = 0.2,
    rounds: int = 6,
    tips: np.ndarray | None = None,
    most_bare: float = 0.5,
) -> tuple[np.ndarray, Constraints]:
    """Surroundings of quads that stay worse than `least` let off their feature curves and evened out; what got better
    is kept.

    A path along a crease that winds cannot be straightened by moving vertices; here it is given up for a few quads.
    Evened out, corners and tips of the surface shrink back: where that would leave them bare by more than most_bare
    edge lengths, the vertices at corners stay. tips: vertices that stay anyway."""
    in_vain, left = 0, np.inf
    for turn in range(rounds):
        bad = scaled_jacobian(vertices, faces) < least
        in_vain, left = in_vain + 1 if bad.sum() > _MOST_LEFT * left else 0, bad.sum()
        if not left or in_vain == _MOST_IN_VAIN and left > _FEW_BAD:
            break
        near = np.zeros(len(vertices), bool)
        near[faces[bad]] = True
        for _ in range(1 + turn):
            near[faces[near[faces].any(1)]] = True
        own = np.flatnonzero(near[faces].any(1))
        if len(own) > max(len(faces) // 5, 2000):
            break
        if tips is not None:
            near[tips] = False
        used, local = np.unique(faces[own], return_inverse=True)
        local = local.reshape(-1, 4)
        before = vertices[used]
        mesh_rim = still_vertices(edges_of(faces), len(vertices), constraints) & ~constraints.fixed
        for loose in (near, near & ~constraints.fixed):
            # Off their curves inside; where they were at the rim.
            mine = Constraints(
                np.full(len(used), -1), (~loose | mesh_rim)[used], constraints.path[:0], constraints.path_curve[:0]
            )
            trial = relax(before, local, surface, features, mine, 10 + 10 * turn)
            trial = square_up(trial, local, surface, features, mine, 10)
            trial = unfold(trial, local, surface, features, mine, most_visits=1500)
            if _faults(scaled_jacobian(trial, local), least) >= _faults(scaled_jacobian(before, local), least):
                break
            if not _leaves_bare(before, trial, local, most_bare):
                vertices = vertices.copy()
                vertices[used] = trial
                kept = ~loose[constraints.path].any(1)
                constraints = Constraints(
                    np.where(loose, -1, constraints.curve),
                    constraints.fixed & ~loose,
                    constraints.path[kept],
                    constraints.path_curve[kept],
                )
                break
    return vertices, constraints


def _leaves_bare(before: np.ndarray, after: np.ndarray, faces: np.ndarray, most: float) -> bool:
    """Whether some of the places of vertices (v, 3) are more than so many edge lengths from the quads (f, 4) once these
    have moved."""
    edge = (polygon_normals(before, faces)[1].sum() / len(faces)) ** 0.5
    return bool(closest_points(before, after, triangulated(faces)[0])[0].max() > most * edge)


def _faults(jacobian: np.ndarray, least: float) -> tuple[int, int, float]:
    """How bad quads of these scaled Jacobians are: those folded, those below `least`, the worst."""
    return int((jacobian <= 0).sum()), int((jacobian < least).sum()), -float(jacobian.min())
