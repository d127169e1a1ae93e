"""Folded quads that no place of their corners unfolds taken out: two opposite corners become one."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.topology import edges_of, renumbered
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.surface_projection import Surface, incidence, neighbours

_FOLDED = 0.05  # scaled Jacobian
_GAIN = 0.1  # of the worst scaled Jacobian around it, for which a quad goes
_MOST = 200  # more of them are no matter of single quads


def without_folded(
    vertices: np.ndarray, faces: np.ndarray, surface: Surface, constraints: Constraints
) -> tuple[np.ndarray, np.ndarray, Constraints]:
    """Quads (f, 4) without those of a scaled Jacobian below 0.05 that can be collapsed along a diagonal (Daniels et al.
    2008).

    The corner that goes is on no feature; the other moves where the worst of the quads around them comes out best, if
    that is much better than it was. Closed, manifold, of as many handles and pieces as before, without new vertices of
    two edges; boundaries stay as they are."""
    quality = scaled_jacobian(vertices, faces)
    folded = np.flatnonzero(quality < _FOLDED)
    if not len(folded) or len(folded) > _MOST:
        return vertices, faces, constraints
    edges = edges_of(faces)
    ring, near = incidence(faces, len(vertices)), neighbours(edges.ends, len(vertices))
    rim = np.zeros(len(vertices), bool)
    rim[edges.ends[edges.count != 2].ravel()] = True
    free = (constraints.curve < 0) & ~constraints.fixed
    out, became, dead, touched = vertices.copy(), np.arange(len(vertices)), [], np.zeros(len(faces), bool)
    for quad in folded[np.argsort(quality[folded], kind="stable")].tolist():
        best = None
        for turn in range(4):
            keep, side, lose, other = np.roll(faces[quad], turn).tolist()
            around = np.union1d(ring[keep], ring[lose])
            if (
                not free[lose]
                or rim[faces[quad]].any()
                or touched[around].any()
                or min(len(near[side]), len(near[other])) < 4
            ):
                continue
            # Link condition: the two share the quad and its other corners, nothing else.
            if (
                set(near[keep].tolist()) & set(near[lose].tolist()) != {side, other}
                or len(np.intersect1d(ring[keep], ring[lose])) > 1
            ):
                continue
            rest = faces[around[around != quad]]
            moves = (rest == keep) | (rest == lose)
            places = out[[keep]]
            if free[keep]:
                places = np.concatenate(
                    [places, out[[lose]], surface.closest(out[[keep, lose]].mean(0, keepdims=True))[2]]
                )
            for place in places:
                corners = np.where(moves[..., None], place, out[rest]).reshape(-1, 3)
                least = scaled_jacobian(corners, np.arange(len(corners)).reshape(-1, 4)).min()
                if least > (best[0] if best else quality[around].min() + _GAIN):
                    best = least, keep, lose, place, np.concatenate([around, ring[side], ring[other]])
        if best is not None:
            _, keep, lose, out[best[1]], around = best
            became[lose], touched[around] = keep, True
            dead.append(quad)
    if not dead:
        return vertices, faces, constraints
    used, found = renumbered(became[np.delete(faces, dead, 0)], len(out))
    number = np.full(len(out), -1)
    number[used] = np.arange(len(used))
    return (
        out[used],
        found,
        Constraints(constraints.curve[used], constraints.fixed[used], number[constraints.path], constraints.path_curve),
    )
