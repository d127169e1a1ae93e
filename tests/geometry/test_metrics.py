"""Measure surfaces whose distances are known."""

import numpy as np
import pytest
import trimesh

from gdtool.cameras import camera_at, rig
from gdtool.geometry import metrics
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.rays import RayCaster


def arrays(mesh):
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces)


def sphere(radius=0.5, center=(0, 0, 0), subdivisions=3):
    vertices, faces = arrays(trimesh.creation.icosphere(subdivisions, radius))
    return vertices + center, faces


def cube(side=1.0, center=(0, 0, 0)):
    vertices, faces = arrays(trimesh.creation.box((side,) * 3))
    return vertices + center, faces


def plane(height):
    return np.array([[0, 0, height], [1, 0, height], [1, 1, height], [0, 1, height]], float), np.array(
        [[0, 1, 2], [0, 2, 3]]
    )


def measure(a, b, **options):
    options = {"samples": 20_000, "cells": 48, **options}
    return metrics.surface_protocol(TriMesh(*a), TriMesh(*b), metrics.SurfaceOptions(**options))


def test_identical_surfaces_have_no_distance():
    figures = measure(cube(), cube(), cameras=rig("six", 64))
    for name in ("distance", "accuracy", "completeness", "hausdorff", "seen_distance", "flipped_share"):
        assert figures[name] == pytest.approx(0, abs=1e-7), name
    assert figures["normal_degrees"] == pytest.approx(0, abs=1e-4)
    for name in ("f_score", "precision", "recall", "iou", "seen_f_score"):
        assert figures[name] == 1, name


def test_the_distance_of_parallel_planes():
    figures = measure(plane(0.03), plane(0))
    assert figures["accuracy"] == pytest.approx(0.03)
    assert figures["completeness"] == pytest.approx(0.03)
    assert figures["distance"] == pytest.approx(0.03)
    assert figures["hausdorff"] == pytest.approx(0.03)
    assert figures["f_score"] == 0
    assert figures["normal_degrees"] == pytest.approx(0, abs=1e-4)
    assert "iou" not in figures  # an open truth has no volume
    assert measure(plane(0.0099), plane(0))["f_score"] == 1


def test_distances_are_in_units_of_the_truths_extent():
    small = measure(sphere(0.45), sphere(0.5))
    large = measure(sphere(45, (7, 0, 0)), sphere(50, (7, 0, 0)))
    assert small["distance"] == pytest.approx(0.05, rel=0.01)
    assert large["distance"] == pytest.approx(small["distance"], rel=1e-6)
    assert small["iou"] == pytest.approx(0.9**3, rel=0.01)
    assert large["iou"] == pytest.approx(small["iou"], rel=1e-3)


def test_half_a_square_is_accurate_and_incomplete():
    vertices, faces = plane(0)
    half = measure((vertices * [0.5, 1, 1], faces), (vertices, faces))
    assert half["accuracy"] == pytest.approx(0, abs=1e-12)
    assert half["precision"] == 1
    assert half["completeness"] == pytest.approx(0.125, rel=0.02)  # half of it is nearer than 0, the rest 0 to 0.5
    assert half["recall"] == pytest.approx(0.51, abs=0.01)
    assert half["f_score"] == pytest.approx(2 * half["recall"] / (1 + half["recall"]))


def test_flipped_faces_are_told_apart_from_wrong_normals():
    vertices, faces = cube()
    figures = measure((vertices, faces[:, ::-1]), (vertices, faces))
    assert figures["flipped_share"] == pytest.approx(1, abs=0.01)
    assert figures["normal_degrees"] == pytest.approx(0, abs=1e-4)
    assert figures["iou"] == 1  # the volume is the same


def test_the_normal_angle_of_a_tilted_plane():
    angle = np.radians(10)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    vertices, faces = plane(0)
    figures = measure((vertices @ turn.T, faces), (vertices, faces))
    assert figures["normal_degrees"] == pytest.approx(10, abs=1e-6)


@pytest.mark.parametrize("offset, iou", [(0, 1), (0.25, 0.75 / 1.25), (0.5, 1 / 3)])
def test_the_iou_of_offset_cubes_is_exact(offset, iou):
    # The cube around the truth is 1.1 wide: with 22 cells, borders of cells lie on the faces of both cubes. The part of
    # the result beyond 0.55 is left out of the union.
    beyond = max(0.0, offset - 0.05)
    expected = (1 - offset) / (1 + offset - beyond)
    assert metrics.volume_iou(TriMesh(*cube(1, (offset, 0, 0))), TriMesh(*cube()), cells=22) == pytest.approx(
        expected, abs=1e-9
    )
    assert metrics._grid_iou(
        TriMesh(*cube(1, (offset, 0, 0))), TriMesh(*cube()), np.zeros(3), 2.0, 64
    ) == pytest.approx(iou, abs=1e-9)


def test_occupancy_by_blocks_equals_occupancy_by_cells():
    """A torus and a ball touch several blocks; the expected values test every cell."""
    from gdtool.geometry.metrics import _cell_centers, inside, occupancy

    vertices, faces = arrays(trimesh.creation.torus(0.35, 0.12))
    ball = sphere(0.1, (0.3, 0.3, 0.3), 2)
    both = np.concatenate([vertices, ball[0]]), np.concatenate([faces, ball[1] + len(vertices)])
    center = np.array([0.02, 0.01, -0.03])
    expected = inside(_cell_centers(32, 1.1) + center, TriMesh(*both)).reshape(32, 32, 32)
    assert (occupancy(TriMesh(*both), center, 1.1, 32) == expected).all()
    assert 0.05 < expected.mean() < 0.2


def test_the_iou_of_separate_shapes_is_zero():
    assert metrics.volume_iou(TriMesh(*cube(0.1, (5, 0, 0))), TriMesh(*cube()), cells=16) == 0


def test_a_surface_is_closed_where_faces_traverse_each_edge_both_ways():
    vertices, faces = cube()
    assert metrics.is_closed(TriMesh(vertices, faces))
    assert not metrics.is_closed(TriMesh(vertices, faces[1:]))
    assert metrics.is_closed(
        TriMesh(vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3))
    )  # split at every corner
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not metrics.is_closed(TriMesh(vertices, flipped))
    two = np.concatenate([vertices, vertices + [1, 1, 0]])  # two cubes that share an edge
    assert metrics.is_closed(TriMesh(two, np.concatenate([faces, faces + len(vertices)])))
    assert not metrics.is_closed(TriMesh(*plane(0)))


def test_six_views_see_a_sphere_but_for_its_poles():
    """Cameras on the equator, 45 or 90 degrees apart in azimuth, see the points that face one of them."""
    radius, cameras = 0.5, rig("six", 64)
    vertices, faces = sphere(radius, subdivisions=4)
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(20000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    caster = RayCaster(TriMesh(vertices, faces))
    hits = caster.first_hit(direction * 2, -direction)
    points, normals = direction * (2 - hits.distance)[:, None], direction
    figures = metrics.visible(points, normals, caster, cameras, metrics.VISIBLE_TOLERANCE)
    # Every direction off the poles is within 45 degrees of a camera's azimuth.
    facing = np.max(direction @ np.stack([c.backward for c in cameras], 1), axis=1)
    assert figures[facing > 0.06].all()
    assert not figures[facing < 0.04].any()
    from_front = metrics.visible(points, normals, caster, cameras[:1], metrics.VISIBLE_TOLERANCE)
    clear = np.abs(direction[:, 2]) > 0.08  # points seen edge-on do not count
    assert (from_front == (direction[:, 2] > 0))[clear].all()
    assert from_front.mean() == pytest.approx((1 - metrics.VISIBLE_COSINE) / 2, abs=0.01)


def test_a_visible_point_is_in_the_picture_and_not_hidden():
    vertices, faces = plane(0)
    low, high = vertices - [0.5, 0.5, 0.2], vertices - [0.5, 0.5, -0.2]
    both = np.concatenate([low, high * [0.5, 1, 1]]), np.concatenate([faces, faces + 4])
    caster, camera = RayCaster(TriMesh(*both)), rig("six", 64)[:1]
    normals = np.tile((0.0, 0, 1), (3, 1))
    points = np.array([[0.4, 0, -0.2], [0.1, 0, -0.2], [0.1, 0, 0.2]])
    assert metrics.visible(points, normals, caster, camera, 1e-3).tolist() == [True, False, True]
    near = [camera_at(0, name="near", size=64, half_width=0.3)]
    assert metrics.visible(points, normals, caster, near, 1e-3).tolist() == [False, False, True]


def test_figures_of_the_seen_part_leave_out_hidden_errors():
    """A box lacks its bottom, which none of the six views sees, so the seen part is perfect."""
    vertices, faces = cube()
    bottom = (vertices[faces][:, :, 1] < -0.49).all(1)
    figures = measure((vertices, faces[~bottom]), (vertices, faces), cameras=rig("six", 64))
    assert figures["completeness"] > 0.02
    assert figures["seen_distance"] == pytest.approx(0, abs=2e-4)
    assert figures["seen_share"] == pytest.approx(4 / 6, abs=0.02)


def test_figures_of_the_seen_part_leave_out_a_lid_that_no_view_sees():
    """A closed cylinder is measured against a cup: none of the six horizontal views sees the lid, or into the cup."""
    outer = trimesh.creation.cylinder(0.4, 1.0, sections=64)
    outer.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))
    vertices, faces = arrays(outer)
    top = (vertices[faces][:, :, 1] > 0.499).all(1)
    inner = vertices * [0.9, 0.9, 0.9] + [0, 0.05, 0]
    cup = np.concatenate([vertices, inner]), np.concatenate([faces[~top], faces[~top][:, ::-1] + len(vertices)])
    figures = measure((vertices, faces), cup, cameras=rig("six", 64))
    assert figures["distance"] > 0.015
    assert figures["seen_distance"] < 1e-3
    assert 0.4 < figures["seen_share"] < 0.6


def test_syncdreamer_identical_and_scaled():
    same = metrics.syncdreamer_protocol(TriMesh(*sphere()), TriMesh(*sphere()))
    assert same["chamfer"] == 0
    assert same["iou"] == 1
    assert same["icp_scale"] == pytest.approx(1, abs=1e-6)
    figures = metrics.syncdreamer_protocol(TriMesh(*sphere(0.4)), TriMesh(*sphere(0.5)))
    assert figures["chamfer"] == pytest.approx(0.1, rel=0.03)
    assert figures["iou"] == pytest.approx(0.8**3, rel=0.03)
    assert figures["icp_scale"] == pytest.approx(1.25, rel=0.02)
    assert figures["icp_chamfer"] < 0.006
    assert figures["icp_iou"] > 0.95


def test_syncdreamer_scales_with_the_truth(monkeypatch):
    monkeypatch.setattr(metrics, "SYNC_SIZE", 64)
    a = metrics.syncdreamer_protocol(TriMesh(*sphere(0.4)), TriMesh(*sphere(0.5)))
    b = metrics.syncdreamer_protocol(TriMesh(*sphere(40, (3, 2, 1))), TriMesh(*sphere(50, (3, 2, 1))))
    assert b["chamfer"] == pytest.approx(a["chamfer"], rel=1e-3)
    assert b["iou"] == pytest.approx(a["iou"], rel=1e-3)


def test_syncdreamer_icp_undoes_a_similarity(monkeypatch):
    monkeypatch.setattr(metrics, "SYNC_SIZE", 128)
    rng = np.random.default_rng(0)
    vertices, faces = arrays(trimesh.creation.box((1, 0.7, 0.4)))
    vertices, faces = arrays(trimesh.Trimesh(vertices, faces).subdivide().subdivide())
    vertices = vertices + 0.02 * rng.normal(size=vertices.shape)
    angle = np.radians(6)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    figures = metrics.syncdreamer_protocol(
        TriMesh(0.93 * vertices @ turn.T + [0.02, -0.01, 0.03], faces), TriMesh(vertices, faces)
    )
    assert figures["icp_chamfer"] < 0.3 * figures["chamfer"]
    assert figures["icp_iou"] > 0.95
    assert figures["icp_scale"] == pytest.approx(1 / 0.93, rel=0.01)


def test_a_similarity_is_recovered_exactly():
    rng = np.random.default_rng(4)
    points = rng.normal(size=(50, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    matrix = metrics.similarity(points, 1.7 * points @ turn.T + [1, 2, 3], np.ones(50))
    np.testing.assert_allclose(matrix[:3], np.concatenate([1.7 * turn, [[1], [2], [3]]], 1), atol=1e-10)


def test_voxels_keep_the_mean_of_their_points():
    points = np.array([[0, 0, 0], [0.004, 0, 0], [0.5, 0, 0]])
    np.testing.assert_allclose(metrics.voxel_downsample(points, 0.01), [[0.002, 0, 0], [0.5, 0, 0]])


def test_an_unseen_result_gives_no_syncdreamer_figures():
    far = cube(0.1, (50, 0, 0))
    assert metrics.syncdreamer_protocol(TriMesh(*far), TriMesh(*cube())) == {}
