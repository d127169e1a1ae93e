"""Cast rays at shapes with analytic distances, barycentric weights and visibility."""

from __future__ import annotations

import numpy as np
import pytest

from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.rays import RayCaster

TWO = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
FACES = np.array([[0, 1, 2], [3, 4, 5]])
DOWN = np.array([[0.0, 0.0, -1.0]])


@pytest.mark.parametrize("scale, shift", [(1.0, 0.0), (1e6, 0.0), (1e-6, 0.0), (1.0, 1e4)])
def test_nearest_face_distance_and_weights_in_any_unit(scale, shift):
    caster = RayCaster(TriMesh(TWO * scale + shift, FACES))
    origin = np.array([[0.2, 0.3, 5.0]]) * scale + shift
    hits = caster.first_hit(origin, DOWN)
    assert hits.face_idx[0] == 1
    assert hits.distance[0] == pytest.approx(4 * scale, rel=1e-9)
    assert np.allclose(hits.barycentric[0], (0.5, 0.2, 0.3), atol=1e-7)


def test_a_miss_has_infinite_distance_and_no_weights():
    hits = RayCaster(TriMesh(TWO, FACES)).first_hit(np.array([[3.0, 3, 5]]), DOWN)
    assert hits.face_idx[0] == -1
    assert np.isinf(hits.distance[0])
    assert not hits.barycentric.any()
    assert not hits.is_hit[0]


def test_a_face_is_hit_from_behind_too():
    hits = RayCaster(TriMesh(TWO, FACES)).first_hit(np.array([[0.2, 0.2, -5.0]]), -DOWN)
    assert hits.face_idx[0] == 0
    assert hits.distance[0] == pytest.approx(5)


def test_occlusion_counts_up_to_a_distance():
    caster = RayCaster(TriMesh(TWO, FACES))
    origin = np.array([[0.2, 0.2, 5.0]] * 3)
    direction = np.repeat(DOWN, 3, 0)
    assert caster.occluded(origin, direction).all()
    assert caster.occluded(origin, direction, np.array([3.9, 4.1, np.inf])).tolist() == [False, True, True]
    assert not caster.occluded(origin, -direction).any()


def test_hit_points_agree_with_weights_over_many_chunks():
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(300, 3))
    faces = np.arange(300).reshape(-1, 3)
    caster = RayCaster(TriMesh(vertices, faces))
    origins = rng.normal(size=(200_000, 3)) * 4
    directions = rng.normal(size=origins.shape) - origins
    hits = caster.first_hit(origins, directions)
    hit = hits.is_hit
    assert 0.1 < hit.mean() < 1
    along = origins[hit] + directions[hit] * hits.distance[hit, None]
    inside = np.einsum("nij,ni->nj", vertices[faces[hits.face_idx[hit]]], hits.barycentric[hit])
    assert np.quantile(np.abs(along - inside).max(1), 0.999) < 1e-6
    assert (caster.occluded(origins, directions) == hit).mean() > 0.99999


def test_an_empty_mesh_is_never_hit():
    caster = RayCaster(TriMesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    assert not caster.occluded(np.zeros((2, 3)), np.repeat(DOWN, 2, 0)).any()
