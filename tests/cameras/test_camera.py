"""Check the conventions of cameras on numbers that can be verified by hand."""

import numpy as np
import pytest

from gdtool.cameras import camera_at, look_at, project, rays, rig
from gdtool.cameras.camera import SIX_VIEWS


def test_the_rig_stands_where_the_format_says():
    cameras = {c.name: c for c in rig("six", 256)}
    assert list(cameras) == ["front", "front_right", "right", "back", "left", "front_left"]
    assert np.allclose(cameras["front"].position, (0, 0, 2))
    assert np.allclose(cameras["right"].position, (2, 0, 0))
    assert np.allclose(cameras["back"].position, (0, 0, -2))
    assert np.allclose(cameras["left"].position, (-2, 0, 0))
    assert np.allclose(cameras["front_right"].position, (2**0.5, 0, 2**0.5))
    assert all(c.half_width == 0.72 and (c.near, c.far) == (1, 3) for c in cameras.values())
    with pytest.raises(ValueError, match="unknown rig"):
        rig("seven", 256)


def test_nothing_is_mirrored():
    """+X is on the right of the front picture and on the left of the back one. +Y is up. +Z is on the right seen from
    -X.
    """
    cameras = {c.name: c for c in rig("six", 100)}
    x, y, z = np.eye(3) * 0.36

    def at(view, point):
        return project(cameras[view], point[None])[0][0]

    assert np.allclose(at("front", x), (75, 50))
    assert np.allclose(at("back", x), (25, 50))
    assert np.allclose(at("front", y), (50, 25))
    assert np.allclose(at("left", z), (75, 50))
    assert np.allclose(at("right", z), (25, 50))


@pytest.mark.parametrize("fov", [None, 35.0])
def test_rays_and_projection_are_inverse(fov):
    camera = camera_at(33, 20, name="c", size=32, fov_degrees=fov)
    origins, directions = rays(camera)
    assert np.allclose(np.linalg.norm(directions, axis=-1), 1)
    points = (origins + 1.7 * directions).reshape(-1, 3)
    pixels, depth = project(camera, points)
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(32) + 0.5)
    assert np.allclose(pixels, np.stack([x, y], -1).reshape(-1, 2))
    assert np.allclose(depth, -((points - camera.position) @ camera.backward))
    if fov is None:
        assert np.allclose(depth, 1.7)


@pytest.mark.parametrize("position", [(0, 2, 0), (0, -2, 0), (1, 1, 1)])
def test_poses_are_rigid_also_from_above(position):
    pose = look_at(position)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.isclose(np.linalg.det(pose[:3, :3]), 1)
    assert np.allclose(-pose[:3, 2], -np.array(position) / np.linalg.norm(position))


def test_the_rigs_views_have_the_names_that_every_stage_knows():
    from gdtool.core.kinds import VIEW_NAMES

    assert tuple(name for name, _ in SIX_VIEWS) == VIEW_NAMES
