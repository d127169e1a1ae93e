"""Quads made square where they are: each asks for the rectangle nearest to it, each vertex gives its quads their mean."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.features import Constraints, Features
from gdtool.geometry.mesh_quality import corner_jacobians, polygon_normals, scaled_jacobian
from gdtool.geometry.quad_shape import Slide, Surface, normals_below, relax, still_vertices, unfold

_CORNER = np.array([1, 1j, -1, -1j])
_SQUARE_SHARE = 0.4  # of the way from the nearest rectangle to the nearest square
_POOR = 0.6  # quads with a smaller scaled Jacobian pull harder
_NORMALS_EVERY = 6


def square_up(vertices: np.ndarray, faces: np.ndarray, surface: Surface, features: Features, constraints: Constraints,
              iterations: int, strength: float = 0.8) -> np.ndarray:
    """Vertices (v, 3) such that the quads (f, 4) have right angles, on the surface and on the feature curves.

    Shape projection (Bouaziz et al. 2012) onto rectangles in the plane of the surface below each quad. That plane says
    which way round a quad goes, so folded quads are asked to turn over. The best vertices met are returned: fewest
    folded quads first, then the largest mean Jacobian.
    """
    if not len(faces) or not iterations:
        return vertices
    still = still_vertices(faces, len(vertices), constraints)
    flat = faces.ravel()
    best, best_rank = vertices, None
    slide = Slide(surface, features, constraints)
    for turn in range(iterations + 1):
        if turn % _NORMALS_EVERY == 0:
            normals = normals_below(vertices, faces, surface)
        quality = np.minimum(corner_jacobians(vertices, faces, normals).min(1), scaled_jacobian(vertices, faces))
        rank = (-int((quality < 0.2).sum()), float(quality.mean()))
        if best_rank is None or rank > best_rank:
            best, best_rank = vertices, rank
        if turn == iterations:
            break
        weight = 1 + 6 * np.clip(_POOR - quality, 0, 1)
        asked = _rectangles(vertices[faces], normals).reshape(-1, 3)
        shares = np.repeat(weight, 4)
        total = np.maximum(np.bincount(flat, shares, len(vertices)), 1e-300)
        target = np.stack([np.bincount(flat, shares * asked[:, i], len(vertices)) for i in range(3)], -1) / total[:, None]
        moved = vertices + strength * (target - vertices)
        moved[still] = vertices[still]
        vertices = slide.step(moved, vertices, turn == iterations - 1)
    return slide.exact(best)


def balance(vertices: np.ndarray, faces: np.ndarray, surface: Surface, constraints: Constraints) -> np.ndarray:
    """Vertices moved off the surface by the mean height of it above their quads, so that as much of it lies above as below.

    A quad whose corners lie on a curved surface lies beneath it everywhere: half of its error is that it does. Features
    and boundaries stay where they are, and so do quads that do not run along the surface.
    """
    free = (constraints.curve < 0) & ~still_vertices(faces, len(vertices), constraints)
    normals, area = polygon_normals(vertices, faces)
    corners = vertices[faces]
    # Of the two triangles that the quad is cut into: centroids and middles of the inner edges.
    a, b, c, d = (corners[:, i] for i in range(4))
    samples = np.stack([(a + b + c) / 3, (a + c + d) / 3, (a + c) / 2, (a + b) / 2, (b + c) / 2, (c + d) / 2, (d + a) / 2], 1)
    weight = np.array([3, 3, 2, 1, 1, 1, 1]) / 12
    _, face_idx, point = surface.closest(samples.reshape(-1, 3))
    height = np.einsum("qki,qi->qk", point.reshape(samples.shape) - samples, normals)
    along = np.einsum("qki,qi->qk", surface.normals[face_idx].reshape(samples.shape), normals) > 0.9
    mean = np.where(along.all(1) & (np.abs(height).max(1) < 0.1 * np.sqrt(area)), height @ weight, 0.0)
    flat, shares = faces.ravel(), np.repeat(area, 4)
    total = np.maximum(np.bincount(flat, shares, len(vertices)), 1e-300)
    move = np.stack([np.bincount(flat, shares * np.repeat(mean * normals[:, i], 4), len(vertices)) for i in range(3)], -1) / total[:, None]
    return np.where(free[:, None], vertices + move, vertices)


def _rectangles(corners: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(q, 4, 3) corners of the rectangle nearest to each quad (q, 4, 3), counter-clockwise about normals (q, 3)."""
    centre = corners.mean(1, keepdims=True)
    offset = corners - centre
    x = offset[:, 0] - np.einsum("qi,qi->q", offset[:, 0], normals)[:, None] * normals
    length = np.sqrt(np.einsum("qi,qi->q", x, x))
    other = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    x = np.where((length > 1e-12)[:, None], x, other)
    x /= np.maximum(np.sqrt(np.einsum("qi,qi->q", x, x)), 1e-300)[:, None]
    y = np.cross(normals, x)
    z = np.einsum("qki,qi->qk", offset, x) + 1j * np.einsum("qki,qi->qk", offset, y)
    size = np.sqrt((np.abs(z) ** 2).mean(1))
    # The nearest square; one that is folded has hardly any, so it gets the size it takes up.
    a = (z * np.conj(_CORNER)).mean(1)
    strength = np.abs(a)
    a = np.where(strength > 1e-9 * size, a / np.maximum(strength, 1e-300), 1) * np.maximum(strength, 0.5 * size)
    square = a[:, None] * _CORNER
    # The nearest rectangle: diagonals of one length that keep their directions.
    one, two = (z[:, 0] - z[:, 2]) / 2, (z[:, 1] - z[:, 3]) / 2
    half = (np.abs(one) + np.abs(two)) / 2
    one_way, two_way = one / np.maximum(np.abs(one), 1e-300), two / np.maximum(np.abs(two), 1e-300)
    upright = (np.conj(one_way) * two_way).imag > 0.5
    diagonals = np.stack([one_way, two_way, -one_way, -two_way], -1) * half[:, None]
    asked = np.where(upright[:, None], (1 - _SQUARE_SHARE) * diagonals + _SQUARE_SHARE * square, square)
    return centre + asked.real[..., None] * x[:, None] + asked.imag[..., None] * y[:, None]


def ease(vertices: np.ndarray, faces: np.ndarray, surface: Surface, features: Features, constraints: Constraints,
         least: float = 0.2, rounds: int = 6) -> tuple[np.ndarray, Constraints]:
    """Surroundings of quads that stay worse than `least` let off their feature curves and evened out; what got better is kept.

    A path along a crease that winds cannot be straightened by moving vertices; here it is given up for a few quads.
    """
    for turn in range(rounds):
        bad = scaled_jacobian(vertices, faces) < least
        if not bad.any():
            break
        near = np.zeros(len(vertices), bool)
        near[faces[bad]] = True
        for _ in range(1 + turn):
            near[faces[near[faces].any(1)]] = True
        own = np.flatnonzero(near[faces].any(1))
        if len(own) > max(len(faces) // 5, 2000):
            break
        used, local = np.unique(faces[own], return_inverse=True)
        local = local.reshape(-1, 4)
        # Off their curves inside; where they were at the rim.
        curve, fixed = np.where(near, -1, constraints.curve), constraints.fixed & ~near
        mesh_rim = still_vertices(faces, len(vertices), constraints) & ~constraints.fixed
        mine = Constraints(np.full(len(used), -1), (~near | mesh_rim)[used], constraints.path[:0], constraints.path_curve[:0])
        trial = relax(vertices[used], local, surface, features, mine, 10 + 10 * turn)
        trial = square_up(trial, local, surface, features, mine, 10)
        trial = unfold(trial, local, surface, features, mine, most_visits=1500)
        before, after = scaled_jacobian(vertices[used], local), scaled_jacobian(trial, local)
        if (int((after < least).sum()), -float(after.min())) < (int((before < least).sum()), -float(before.min())):
            vertices = vertices.copy()
            vertices[used] = trial
            kept = ~near[constraints.path].any(1)
            constraints = Constraints(curve, fixed, constraints.path[kept], constraints.path_curve[kept])
    return vertices, constraints
