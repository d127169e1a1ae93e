"""Collapse folded quads that moving vertices cannot untangle: two opposite corners become one vertex."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import edges_of, renumbered
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.surface_projection import ProjectionTarget, faces_around_vertices, neighbours

_FOLDED = 0.05  # scaled Jacobian below which a quad is folded
_MIN_GAIN = 0.1  # in the worst scaled Jacobian around it, for which a quad is collapsed
_MAX_FOLDED = 200  # more folded quads have another cause than single bad quads


class _Collapse(NamedTuple):
    """A possible collapse of one quad, and the worst scaled Jacobian that it leaves.

    It names the corner kept and the corner lost, the position of the kept one, and the faces around the quad. No other
    collapse of the same round may touch these faces.
    """

    quality: float
    keep: int
    lose: int
    position: np.ndarray
    touched: np.ndarray


def collapse_folded_quads(
    mesh: QuadMesh, surface: ProjectionTarget, constraints: Constraints
) -> tuple[QuadMesh, Constraints]:
    """Collapse folded quads along a diagonal (Daniels et al. 2008) where that clearly improves the quads around.

    The lost corner is on no feature. The kept corner moves to the position at which the worst quad around has the best
    scaled Jacobian. The result is closed and manifold where the mesh was, with as many handles and pieces, and without
    new vertices of two edges. Boundaries stay as they are.
    """
    vertices, faces = mesh.vertices, mesh.faces
    quality = scaled_jacobian(mesh)
    folded = np.flatnonzero(quality < _FOLDED)
    if not len(folded) or len(folded) > _MAX_FOLDED:
        return mesh, constraints
    edges = edges_of(faces)
    face_lists = faces_around_vertices(faces, len(vertices))
    neighbour_lists = neighbours(edges.ends, len(vertices))
    boundary = np.zeros(len(vertices), bool)
    boundary[edges.ends[edges.count != 2].ravel()] = True
    free = (constraints.curve < 0) & ~constraints.fixed
    out, merged_into = vertices.copy(), np.arange(len(vertices))
    dead, touched = [], np.zeros(len(faces), bool)
    for quad in folded[np.argsort(quality[folded], kind="stable")].tolist():
        best: _Collapse | None = None
        for turn in range(4):
            keep, side, lose, other = np.roll(faces[quad], turn).tolist()
            around = np.union1d(face_lists[keep], face_lists[lose])
            if (
                not free[lose]
                or boundary[faces[quad]].any()
                or touched[around].any()
                or min(len(neighbour_lists[side]), len(neighbour_lists[other])) < 4
            ):
                continue
            # Link condition: the two corners share this quad and its other corners, nothing else.
            if (
                set(neighbour_lists[keep].tolist()) & set(neighbour_lists[lose].tolist()) != {side, other}
                or len(np.intersect1d(face_lists[keep], face_lists[lose])) > 1
            ):
                continue
            other_faces = faces[around[around != quad]]
            moves = (other_faces == keep) | (other_faces == lose)
            positions = out[[keep]]
            if free[keep]:
                positions = np.concatenate(
                    [positions, out[[lose]], surface.closest(out[[keep, lose]].mean(0, keepdims=True))[2]]
                )
            for position in positions:
                corners = np.where(moves[..., None], position, out[other_faces]).reshape(-1, 3)
                worst = scaled_jacobian(QuadMesh(corners, np.arange(len(corners)).reshape(-1, 4))).min()
                if worst > (best.quality if best else quality[around].min() + _MIN_GAIN):
                    all_touched = np.concatenate([around, face_lists[side], face_lists[other]])
                    best = _Collapse(worst, keep, lose, position, all_touched)
        if best is not None:
            out[best.keep], merged_into[best.lose] = best.position, best.keep
            touched[best.touched] = True
            dead.append(quad)
    if not dead:
        return mesh, constraints
    used, collapsed = renumbered(merged_into[np.delete(faces, dead, 0)], len(out))
    number = np.full(len(out), -1)
    number[used] = np.arange(len(used))
    remaining = Constraints(
        constraints.curve[used], constraints.fixed[used], number[constraints.path], constraints.path_curve
    )
    return QuadMesh(out[used], collapsed), remaining
