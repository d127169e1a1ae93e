"""Folded quads are untangled on the surface and on their curves, and nothing else moves."""

import numpy as np
import pytest

from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.remesh.fit.feature_curves import Constraints, find_features
from gdtool.remesh.fit.surface_projection import ProjectionTarget, faces_around_vertices
from gdtool.remesh.fit.untangle import _independent_batches, untangle
from tests.geometry.solids import cube, plane, quad_cube


def grid(n):
    """Make a square of side 1 in z = 0 of n x n quads."""
    line = np.linspace(-0.5, 0.5, n + 1)
    x, y = np.meshgrid(line, line)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1), np.stack([i, i + 1, i + n + 2, i + n + 1], -1)


def folded(n, step=0.25):
    """Make a grid with some inner vertices, no two adjacent, pulled past their neighbours; also return these."""
    vertices, faces = grid(n)
    pulled = [y * (n + 1) + x for y in range(2, n - 1, 3) for x in range(2, n - 1, 3)]
    vertices[pulled, 0] += step
    return vertices, faces, np.array(pulled)


def test_many_folds_are_untangled_at_once_and_other_vertices_stay():
    vertices, faces, pulled = folded(12)
    assert (scaled_jacobian(QuadMesh(vertices, faces)) <= 0).sum() >= len(pulled)
    out = untangle(
        QuadMesh(vertices, faces),
        ProjectionTarget(TriMesh(*plane())),
        find_features(TriMesh(*plane()), 181.0, 1.0),
        Constraints.none(len(vertices)),
    )
    assert scaled_jacobian(QuadMesh(out, faces)).min() > 0.2
    assert np.abs(out[:, 2]).max() < 1e-12
    touched = np.unique(faces[scaled_jacobian(QuadMesh(vertices, faces)) < 0.3])
    around = np.unique(faces[np.isin(faces, touched).any(1)])
    still = np.setdiff1d(np.arange(len(vertices)), around)
    assert len(still)
    assert np.array_equal(out[still], vertices[still])


def test_fixed_vertices_move_in_the_last_rounds_only():
    vertices, faces, pulled = folded(6)
    fixed = np.zeros(len(vertices), bool)
    fixed[pulled] = True
    constraints = Constraints(np.full(len(vertices), -1), fixed, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
    surface, features = ProjectionTarget(TriMesh(*plane())), find_features(TriMesh(*plane()), 181.0, 1.0)
    early = untangle(
        QuadMesh(vertices, faces), surface, features, constraints, max_visits=10
    )  # too few visits to reach the last rounds
    assert np.array_equal(early[pulled], vertices[pulled])
    out = untangle(QuadMesh(vertices, faces), surface, features, constraints)
    assert scaled_jacobian(QuadMesh(out, faces)).min() > scaled_jacobian(QuadMesh(vertices, faces)).min()


def test_vertices_on_a_crease_slide_along_it():
    vertices, faces = quad_cube(2)
    surface, features = ProjectionTarget(TriMesh(*cube())), find_features(TriMesh(*cube()), 30.0, 0.1)
    top, front = np.isclose(vertices[:, 1], vertices[:, 1].max()), np.isclose(vertices[:, 2], vertices[:, 2].max())
    on = np.flatnonzero(top & front)
    on = on[np.argsort(vertices[on, 0])]
    middles = features.points[features.segments].mean(1)
    curve = features.curve[np.abs(middles - vertices[on].mean(0)).sum(1).argmin()]
    curve_of_vertex = np.full(len(vertices), -1)
    curve_of_vertex[on[1:-1]] = curve
    moved = vertices.copy()
    moved[on[1], 0] = vertices[on[2], 0] + 0.3 * (vertices[on[3], 0] - vertices[on[2], 0])  # past the next vertex
    assert scaled_jacobian(QuadMesh(moved, faces)).min() <= 0
    out = untangle(
        QuadMesh(moved, faces),
        surface,
        features,
        Constraints(curve_of_vertex, np.zeros(len(vertices), bool), np.zeros((0, 2), np.int64), np.zeros(0, np.int64)),
    )
    assert scaled_jacobian(QuadMesh(out, faces)).min() > 0.2
    assert np.abs(out[on, 1:] - vertices[on, 1:]).max() < 1e-9


@pytest.mark.parametrize("mesh", [grid(7), quad_cube(2)])
def test_vertices_of_a_batch_share_no_face(mesh):
    vertices, faces = mesh
    batches = _independent_batches(np.arange(len(vertices)), faces, faces_around_vertices(faces, len(vertices)))
    assert sorted(np.concatenate(batches)) == list(range(len(vertices)))
    for batch in batches:
        assert np.isin(faces, batch).sum(1).max() == 1


def test_vertices_of_a_batch_move_as_each_would_alone(monkeypatch):
    """A batch mixes vertices with different numbers of faces and neighbours: beside the rim, in corners and within."""
    vertices, faces, _ = folded(9)
    vertices[[12, 38, 56], 1] += 0.2
    surface_and_constraints = (
        ProjectionTarget(TriMesh(*plane())),
        find_features(TriMesh(*plane()), 181.0, 1.0),
        Constraints.none(len(vertices)),
    )
    together, batches_of = untangle(QuadMesh(vertices, faces), *surface_and_constraints), _independent_batches
    monkeypatch.setattr(
        "gdtool.remesh.fit.untangle._independent_batches",
        lambda *arguments: [batch[k : k + 1] for batch in batches_of(*arguments) for k in range(len(batch))],
    )
    np.testing.assert_array_equal(untangle(QuadMesh(vertices, faces), *surface_and_constraints), together)
    assert (together != vertices).any(1).sum() > 10
