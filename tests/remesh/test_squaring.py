"""Squaring quads: folds are undone on the surface, and straight corners are released from their curves."""

import numpy as np
import pytest

from gdtool.geometry.distance import closest_points
from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.topology import triangulated
from gdtool.remesh.fit.feature_curves import Constraints, Features, release_straight_corners
from gdtool.remesh.fit.squaring import ReleaseOptions, balance_heights, release_and_smooth, square_up
from gdtool.remesh.fit.surface_projection import ProjectionTarget
from tests.geometry.solids import plane, sphere

NO_FEATURES = Features(np.zeros((0, 3)), np.zeros((0, 2), np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64))


def grid(n=8):
    line = np.linspace(-0.5, 0.5, n + 1)
    x, y = np.meshgrid(line, line)
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    return np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1), np.stack([i, i + 1, i + n + 2, i + n + 1], -1)


def test_folded_quads_are_unfolded_on_the_surface():
    vertices, quads = grid()
    bent = vertices.copy()
    bent[40] += [0.19, 0.17, 0]  # past its neighbour
    assert scaled_jacobian(QuadMesh(bent, quads)).min() < 0
    out = square_up(
        QuadMesh(bent, quads), ProjectionTarget(TriMesh(*plane())), NO_FEATURES, Constraints.none(len(vertices)), 20
    )
    assert scaled_jacobian(QuadMesh(out, quads)).min() > 0.8
    assert np.abs(out[:, 2]).max() < 1e-12
    rim = np.abs(vertices[:, :2]).max(1) > 0.49
    assert np.array_equal(out[rim], vertices[rim])


def test_the_middle_of_three_corners_in_a_line_is_released_from_its_curve():
    vertices, quads = grid()
    path = np.array([[38, 39], [39, 40], [40, 49], [49, 50]])  # straight, then around a quad's corner at 40
    curve = np.full(len(vertices), -1)
    curve[[39, 40, 49]] = 0
    fixed = np.zeros(len(vertices), bool)
    fixed[[38, 50]] = True
    released = release_straight_corners(
        QuadMesh(vertices, quads), Constraints(curve, fixed, path, np.zeros(4, np.int64))
    )
    assert released.curve[40] == -1
    assert released.curve[49] == -1
    assert released.curve[39] == 0
    assert released.path.tolist() == [[38, 39]]
    assert released.fixed[[38, 50]].all()
    fixed[[40, 49]] = True  # true corners of the surface, square here: they stay
    assert (
        len(
            release_straight_corners(
                QuadMesh(vertices, quads), Constraints(curve, fixed, path, np.zeros(4, np.int64))
            ).path
        )
        == 4
    )


def test_a_corner_pinned_in_the_wrong_place_is_released():
    vertices, quads = grid()
    bent = vertices.copy()
    bent[40] = bent[50] + [0.01, 0.01, 0]
    fixed = np.zeros(len(vertices), bool)
    fixed[40] = True
    pinned = Constraints(np.full(len(vertices), -1), fixed, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
    out, constraints = release_and_smooth(
        QuadMesh(bent, quads), ProjectionTarget(TriMesh(*plane())), NO_FEATURES, pinned
    )
    assert scaled_jacobian(QuadMesh(out, quads)).min() >= 0.2
    assert not constraints.fixed[40]


@pytest.mark.parametrize("moved, by", [(49, (0.1, -0.1, 0)), (41, (0, 0.2, 0))])
@pytest.mark.parametrize("height", [0.15, 0.25])
def test_a_tip_beside_folded_quads_stays_where_smoothing_would_shrink_it(height, moved, by):
    vertices, quads = grid()
    tip = 40
    vertices[tip, 2] = height
    triangles = triangulated(quads)[0]
    surface, constraints = (
        ProjectionTarget(TriMesh(vertices, triangles.astype(np.int64))),
        Constraints.none(len(vertices)),
    )
    constraints.fixed[tip] = True
    bent = vertices.copy()
    bent[moved] += by
    bent = surface.closest(bent)[2]
    assert scaled_jacobian(QuadMesh(bent, quads)).min() < 0

    def uncovered_edges(out):
        return closest_points(vertices[[tip]], TriMesh(out, triangles))[0][0] * 8  # edges are 1/8 long

    out, remaining = release_and_smooth(QuadMesh(bent, quads), surface, NO_FEATURES, constraints)
    assert scaled_jacobian(QuadMesh(out, quads)).min() > 0.5
    assert uncovered_edges(out) < 1e-9
    assert remaining.fixed[tip]
    out, remaining = release_and_smooth(
        QuadMesh(bent, quads), surface, NO_FEATURES, constraints, options=ReleaseOptions(max_uncovered_edges=2.0)
    )
    assert 0.75 < uncovered_edges(out) < 2
    assert not remaining.fixed[tip]


def test_releasing_folds_no_further_quads():
    vertices, quads = grid()
    for seed in range(20):
        rng = np.random.default_rng(seed)
        fixed = rng.random(len(vertices)) < 0.2
        pinned = Constraints(np.full(len(vertices), -1), fixed, np.zeros((0, 2), np.int64), np.zeros(0, np.int64))
        bent = vertices + rng.normal(0, 0.06, vertices.shape) * (1, 1, 0)
        before = scaled_jacobian(QuadMesh(bent, quads))
        after = scaled_jacobian(
            QuadMesh(
                release_and_smooth(QuadMesh(bent, quads), ProjectionTarget(TriMesh(*plane())), NO_FEATURES, pinned)[0],
                quads,
            )
        )
        assert (after <= 0).sum() <= (before <= 0).sum()


def test_balancing_lifts_quads_to_the_surface_but_leaves_thin_ones():
    """A grid below the top of a ball, with a few corners nearly on the opposite diagonal."""
    vertices, quads = grid()
    vertices = vertices * 0.3
    thin = quads[[10, 30, 50]]
    vertices[thin[:, 0]] = 0.55 * vertices[thin[:, 1]] + 0.45 * vertices[thin[:, 3]]
    ball = ProjectionTarget(TriMesh(*sphere(48, 0.8)))
    vertices[:, 2] = np.sqrt(0.8**2 - (vertices[:, :2] ** 2).sum(1))
    vertices = ball.closest(vertices)[2]
    before = scaled_jacobian(QuadMesh(vertices, quads))
    out = balance_heights(QuadMesh(vertices, quads), ball, Constraints.none(len(vertices)))
    after = scaled_jacobian(QuadMesh(out, quads))
    assert (before < 0.3).any()
    assert (after[before < 0.3] >= before[before < 0.3] - 1e-12).all()
    centre = np.abs(ball.closest(out[quads].mean(1))[0]).mean(), np.abs(ball.closest(vertices[quads].mean(1))[0]).mean()
    assert centre[0] < 0.8 * centre[1]
