"""Features across quads: vertices held to diagonals, and quads cut along them."""

import numpy as np

from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.remesh.fit.feature_curves import Constraints, release_straight_corners
from gdtool.remesh.fit.feature_diagonals import choose_diagonals, hold_centres, quads_crossed_by_features
from gdtool.remesh.fit.surface_projection import ProjectionTarget, subdivide


def grid(n: int = 4):
    """Make a flat grid of n x n unit quads."""
    y, x = np.mgrid[: n + 1, : n + 1]
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1).astype(float)
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return vertices, np.stack([corner, corner + 1, corner + n + 2, corner + n + 1], -1)


def test_a_path_around_a_corner_crosses_its_quad():
    vertices, faces = grid()
    walk = [5, 6, 11, 12]  # right, up, right: a staircase about the quads of corners 6 and 5
    path = np.stack([walk[:-1], walk[1:]], -1)
    curve = np.full(len(vertices), -1)
    curve[walk] = 3
    before = Constraints(curve, np.zeros(len(vertices), bool), path, np.full(3, 3))
    # One of the staircase's two corners is released here.
    after = Constraints(np.where(np.arange(len(vertices)) == 6, -1, curve), before.fixed, path[2:], np.full(1, 3))
    face_idx, crossing_curve = quads_crossed_by_features(faces, before, after)
    assert len(face_idx) == 1
    assert set(faces[face_idx[0]]) == {5, 6, 10, 11}
    assert crossing_curve.tolist() == [3]
    made, halved = subdivide(QuadMesh(vertices, faces), after)
    new_vertices = made.vertices
    constraints = hold_centres(halved, len(new_vertices) - len(faces), face_idx, crossing_curve)
    added = np.flatnonzero(constraints.curve != halved.curve)
    assert np.allclose(new_vertices[added], [[0.5, 1.5, 0]])
    released = release_straight_corners(QuadMesh(vertices, faces), before)
    assert (released.curve[[6, 11]] < 0).all()
    assert not len(quads_crossed_by_features(faces, before, before)[0])


def test_bent_quads_are_cut_along_the_ridge():
    # The ridge runs from the first corner to the third.
    ridge = np.array([[0, 0, 0], [2, 0, -1], [2, 2, 0], [0, 2, -1.0]])
    surface = ProjectionTarget(TriMesh(ridge, np.array([[0, 1, 2], [0, 2, 3]])))
    for turn in range(4):
        quad = np.roll([0, 1, 2, 3], turn)[None]
        out = choose_diagonals(QuadMesh(ridge, quad), surface)[0]
        assert out[0] in (0, 2)
        assert np.roll(out, -int(np.argmin(out))).tolist() == [0, 1, 2, 3]
