"""Folded quads are collapsed, and nothing else changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gdtool.geometry import topology
from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.meshes import QuadMesh
from gdtool.remesh.connectivity.diagonal_collapse import collapse_folded_quads
from gdtool.remesh.fit.feature_curves import Constraints
from gdtool.remesh.fit.shaping import target_of_quads
from tests.geometry.solids import quad_torus


def opened(vertices: np.ndarray, faces: np.ndarray, at: int, apart: float) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Split vertex `at` of four quads into two, with a new quad between them that is folded by `apart` edge lengths.

    Returns the vertices, the faces and the new quad's corners.
    """
    ring = [faces[(faces == at).any(1)][0].tolist()]
    while len(ring) < 4:
        before = ring[-1][(ring[-1].index(at) - 1) % 4]
        ring.append(next(f for f in faces.tolist() if at in f and f[(f.index(at) + 1) % 4] == before))
    first_end, second_end = (quad[(quad.index(at) + 1) % 4] for quad in (ring[0], ring[2]))
    out = faces.copy()
    for quad in ring[:2]:
        is_quad = (faces == quad).all(1)
        out[is_quad] = np.where(faces[is_quad] == at, len(vertices), faces[is_quad])
    side = vertices[ring[1][(ring[1].index(at) + 1) % 4]] - vertices[at]
    new = [at, second_end, len(vertices), first_end]
    if not topology.is_watertight(np.concatenate([out, [new]])):
        new = new[::-1]
    return np.concatenate([vertices, (vertices[at] - apart * side)[None]]), np.concatenate([out, [new]]), new


@pytest.mark.parametrize("apart", [0.0, 0.2])
def test_a_folded_quad_is_collapsed_and_its_surroundings_stay(apart):
    vertices, faces = quad_torus()
    torn, quads, _ = opened(vertices, faces, 17, apart)
    assert topology.is_watertight(quads)
    assert len(quads) == len(faces) + 1
    assert scaled_jacobian(QuadMesh(torn, quads)).min() < 0.05
    made, _ = collapse_folded_quads(
        QuadMesh(torn, quads), target_of_quads(QuadMesh(vertices, faces)), Constraints.none(len(torn))
    )
    out, quads_out = made.vertices, made.faces
    assert len(quads_out) == len(faces)
    assert len(out) == len(vertices)
    assert topology.is_watertight(quads_out)
    assert topology.is_manifold(quads_out)
    assert topology.euler_number(quads_out) == topology.euler_number(faces)
    assert scaled_jacobian(QuadMesh(out, quads_out)).min() > 0.8 * scaled_jacobian(QuadMesh(vertices, faces)).min()
    assert len(np.unique(np.concatenate([out, vertices]).round(9), axis=0)) <= len(vertices) + 1


def test_vertices_held_by_constraints_are_not_collapsed():
    vertices, faces = quad_torus()
    torn, quads, new = opened(vertices, faces, 17, 0.1)
    constraints = Constraints.none(len(torn))
    constraints.curve[[new[0], new[2]]] = 0
    made, _ = collapse_folded_quads(
        QuadMesh(torn, quads),
        target_of_quads(QuadMesh(vertices, faces)),
        replace(constraints, fixed=np.ones(len(torn), bool)),
    )
    out, quads_out = made.vertices, made.faces
    assert out is torn
    assert quads_out is quads
    # If one of the two corners is on a curve, that corner is kept where it is.
    constraints.curve[new[2]] = -1
    made, after = collapse_folded_quads(QuadMesh(torn, quads), target_of_quads(QuadMesh(vertices, faces)), constraints)
    out, quads_out = made.vertices, made.faces
    assert len(quads_out) == len(faces)
    assert (after.curve >= 0).sum() == 1
    assert (out[after.curve >= 0] == torn[new[0]]).all()


def test_a_mesh_without_folded_quads_is_unchanged():
    vertices, faces = quad_torus()
    made, _ = collapse_folded_quads(
        QuadMesh(vertices, faces), target_of_quads(QuadMesh(vertices, faces)), Constraints.none(len(vertices))
    )
    out, quads_out = made.vertices, made.faces
    assert out is vertices
    assert quads_out is faces
