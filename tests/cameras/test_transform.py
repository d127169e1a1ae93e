"""Move cameras with their world, and compare them."""

from dataclasses import replace

import numpy as np
import pytest

from gdtool.cameras import camera_at, fit_depth_range, project, same_view, transform_camera


@pytest.fixture(params=[None, 40.0], ids=["orthographic", "perspective"])
def camera(request):
    return camera_at(30, 20, name="view", size=64, fov_degrees=request.param)


def similarity(scale=2.0):
    """Make a turn about z by 90 degrees, a scale, and a shift."""
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    matrix[:3, 3] = 3, -1, 2
    return matrix


def test_a_transformed_camera_sees_the_transformed_points_at_the_same_pixels(camera):
    points, matrix = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)), similarity()
    pixels, depth = project(camera, points)
    moved_pixels, moved_depth = project(transform_camera(camera, matrix), points @ matrix[:3, :3].T + matrix[:3, 3])
    np.testing.assert_allclose(moved_pixels, pixels, atol=1e-9)
    np.testing.assert_allclose(moved_depth, 2 * depth, atol=1e-9)


def test_the_depth_range_encloses_the_unit_sphere(camera):
    fitted = fit_depth_range(replace(camera, near=0.1, far=0.2))
    distance = np.linalg.norm(camera.position)
    assert fitted.near == pytest.approx(distance - 1)
    assert fitted.far == pytest.approx(distance + 1)


def test_the_same_view_may_have_another_size(camera):
    twice = replace(camera, width=128, height=128, fx=2 * camera.fx, fy=2 * camera.fy)
    assert same_view(camera, twice)


def test_another_pose_is_another_view(camera):
    assert not same_view(camera, transform_camera(camera, similarity(1.0)))


def test_another_aspect_ratio_is_another_view(camera):
    assert not same_view(camera, replace(camera, height=48))


def test_another_field_of_view_is_another_view(camera):
    assert not same_view(camera, replace(camera, half_width=0.5, fx=camera.fx * 1.1 + 1))


def test_another_projection_is_another_view(camera):
    other = "perspective" if camera.projection == "orthographic" else "orthographic"
    assert not same_view(camera, replace(camera, projection=other))
