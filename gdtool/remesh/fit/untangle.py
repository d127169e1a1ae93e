"""Folded and needle-like quads mended one vertex at a time."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import columns_of, worst_jacobian
from gdtool.geometry.topology import edges_of
from gdtool.remesh.fit.feature_curves import Constraints, Features, closest_on_segments
from gdtool.remesh.fit.surface_projection import Lists, Surface, incidence, neighbours, normals_below

_LET_OFF_BELOW = 0.22  # a vertex leaves its feature for a quad with a smaller scaled Jacobian only
_LOOSE_ROUNDS = 4
_GAIN = 1e-3  # of the worst scaled Jacobian, for which a vertex moves
_ANGLES = np.arange(8) * (np.pi / 4)
_PLACES = 4 + 2 * len(_ANGLES)
_NEAR, _FAR = 0.12, 0.35  # of the mean distance to the neighbours: radii of the rings of places


def unfold(
    vertices: np.ndarray,
    faces: np.ndarray,
    surface: Surface,
    features: Features,
    constraints: Constraints,
    least: float = 0.3,
    rounds: int = 12,
    most_visits: int = 6000,
) -> np.ndarray:
    """Vertices of folded and needle-like quads moved to the best of a few places near them.

    A vertex moves only where the worst scaled Jacobian of its quads, against the surface's normals, gets better. Free
    vertices stay on the surface, held ones slide along their curve; in the last rounds they may leave it. most_visits
    bounds the work (a count, not a time: equal input gives equal output). Vertices that share no quad move at once.
    """
    edges = edges_of(faces)
    ring, near = incidence(faces, len(vertices)), neighbours(edges.ends, len(vertices))
    boundary = np.zeros(len(vertices), bool)
    boundary[edges.ends[edges.count != 2].ravel()] = True
    held = constraints.curve >= 0
    vertices = vertices.copy()
    normals = normals_below(vertices, faces, surface)
    below = np.ascontiguousarray(normals.T)
    settled = np.zeros(len(vertices), bool)  # found no better place, and nothing beside them moved since
    for turn in range(rounds):
        loose = turn >= rounds - _LOOSE_ROUNDS
        if turn == rounds - _LOOSE_ROUNDS:
            settled &= ~held & ~constraints.fixed
        bad = worst_jacobian(columns_of(vertices, faces), below) < (_LET_OFF_BELOW if loose else least)
        if not bad.any():
            break
        touched = np.unique(faces[bad])
        most_visits -= len(touched)
        if most_visits < 0:
            break
        may = touched[~(constraints.fixed[touched] & (not loose)) & (~boundary | held)[touched]]
        for batch in _apart(may, faces, ring):
            batch = batch[~settled[batch]]
            if not len(batch):
                continue
            around, size = ring.rows(batch), np.stack([ring.lengths(batch), near.lengths(batch)], -1)
            places = np.empty((len(batch), _PLACES, 3))
            for alike in {tuple(one) for one in size.tolist()}:
                of = (size == alike).all(1)
                places[of] = _places(vertices, batch[of], faces[ring.rows(batch[of])], near.rows(batch[of]))
            tied = held[batch] & (not loose)
            if not tied.all():
                places[~tied, 1:] = surface.closest(places[~tied, 1:].reshape(-1, 3))[2].reshape(
                    -1, places.shape[1] - 1, 3
                )
            for k in np.flatnonzero(tied):
                curve = features.segments[features.curve == constraints.curve[batch[k]]]
                places[k, 1:] = closest_on_segments(places[k, 1:], features.points, curve)[2]
            best, better = _best(vertices, batch, faces[around], normals[around], places)
            settled[batch] = ~better
            vertices[batch[better]] = places[better, best[better]]
            settled[faces[around[better]]] = False
    return vertices


def _apart(chosen: np.ndarray, faces: np.ndarray, ring: Lists) -> list[np.ndarray]:
    """The chosen vertices (n,) in batches: those of one share no face."""
    batches: list[list[int]] = []
    color: dict[int, int] = {}
    for v in chosen.tolist():
        taken = {color.get(u) for u in faces[ring[v]].ravel().tolist()}
        color[v] = next(c for c in range(len(taken) + 1) if c not in taken)
        if color[v] == len(batches):
            batches.append([])
        batches[color[v]].append(v)
    return [np.array(batch) for batch in batches]


def _places(vertices: np.ndarray, batch: np.ndarray, quads: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(n, _PLACES, 3) places that vertices (n,) may move to, the first of them where they are; quads (n, k, 4) and
    neighbours (n, m) around them."""
    here, beside = vertices[batch][:, None], vertices[near]
    mean = beside.mean(1, keepdims=True)
    spread = np.linalg.norm(beside - mean, axis=2).mean(1)[:, None, None]
    axes = np.linalg.svd(beside - mean, full_matrices=False)[2]
    # A ring of places in the plane of the neighbours finds a way out of most folds.
    circle = (
        np.cos(_ANGLES)[:, None] * axes[:, :1] + np.sin(_ANGLES)[:, None] * axes[:, min(1, axes.shape[1] - 1), None]
    )
    return np.concatenate(
        [
            here,
            mean,
            vertices[quads].mean((1, 2))[:, None],
            (mean + here) / 2,
            here + _NEAR * spread * circle,
            here + _FAR * spread * circle,
        ],
        1,
    )


def _best(
    vertices: np.ndarray, batch: np.ndarray, quads: np.ndarray, normals: np.ndarray, places: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which place (n,) makes the worst quad (n, k, 4) around each vertex best, and whether that is better than to stay
    (n,) bool."""
    n, p, k = *places.shape[:2], quads.shape[1]
    corners = np.where(
        (quads == batch[:, None, None])[:, None, ..., None], places[:, :, None, None], vertices[quads][:, None]
    )
    # Against the surface's normal and the quad's own: a quad may be folded in one and not in the other.
    got = worst_jacobian(
        np.ascontiguousarray(corners.reshape(-1, 4, 3).T), np.repeat(normals[:, None], p, 1).reshape(-1, 3).T
    )
    got = got.reshape(n, p, k).min(2)
    best = got.argmax(1)
    return best, got[np.arange(n), best] > got[:, 0] + _GAIN
