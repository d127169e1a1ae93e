"""Depth of views that hold none: against the depth that the views would have shown."""

import numpy as np
import pytest

from gdtool.cameras import camera_at, rays, rig
from gdtool.cameras.camera import SIX_VIEWS
from gdtool.fields.grid.carve import hull_bounds
from gdtool.fields.grid.fusion import depth_for, prepare_all
from gdtool.fields.views import multiview_stereo
from gdtool.fields.views.multiview_stereo import STEP_COST, _aggregate_rows, match_views, pixel_steps, slopes, stretched

from .shapes import sphere, torus, two_balls, views_of

MATCHING_SIZE = 96


def ball_before_a_wall(points):
    """What normals alone cannot tell: how far the ball is in front."""
    wall = np.abs(points - [0, 0, -0.25]) - [0.4, 0.4, 0.06]
    box = np.linalg.norm(np.maximum(wall, 0), axis=-1) + np.minimum(wall.max(-1), 0)
    return np.minimum(box, sphere(points - [0.05, 0, 0.2], 0.15))


def perspective(size=MATCHING_SIZE):
    return [camera_at(azimuth, name=name, size=size, fov_degrees=45) for name, azimuth in SIX_VIEWS]


def error(images, mask, depth):
    """(k, pixels) absolute, of pixels that show one surface."""
    return np.abs(depth - images["depth"])[mask > 0.99]


@pytest.mark.parametrize("cameras", [rig("six", MATCHING_SIZE), perspective()], ids=["orthographic", "perspective"])
@pytest.mark.parametrize("solid, bound", [(torus, 0.003), (ball_before_a_wall, 0.015)])
def test_depth_is_found_from_normals_and_albedo(solid, bound, cameras):
    """Pixels are 0.015 wide, the ball is 0.24 before the wall."""
    cameras, images, mask = views_of(solid, MATCHING_SIZE, cameras=cameras)
    assert error(images, mask, depth_for(cameras, mask, images["normal"], {"albedo": images["albedo"]})).mean() < bound


def test_what_looks_alike_helps_where_normals_do_not():
    """A box' side has one normal: its texture says where it is."""

    def box(points):
        q = np.abs(points - [0, 0, 0.1]) - [0.35, 0.3, 0.2]
        hole = np.abs(points - [0, 0, 0.3]) - [0.25, 0.2, 0.1]  # a recess that no silhouette shows
        solid = np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)
        return np.maximum(solid, -(np.linalg.norm(np.maximum(hole, 0), axis=-1) + np.minimum(hole.max(-1), 0)))

    cameras, images, mask = views_of(box, MATCHING_SIZE)
    plain = error(images, mask, depth_for(cameras, mask, images["normal"])).mean()
    told = error(images, mask, depth_for(cameras, mask, images["normal"], {"albedo": images["albedo"]})).mean()
    assert told < 0.7 * plain


@pytest.mark.parametrize("camera", [rig("six", 64)[1], perspective(64)[1]], ids=["orthographic", "perspective"])
def test_slopes_are_a_planes_depth_from_pixel_to_pixel(camera):
    normal = camera.world_from_camera[:3, :3] @ np.array([0.4, -0.3, 0.86])
    normal /= np.linalg.norm(normal)
    origins, directions = rays(camera)
    along = ((np.array([0.02, 0.05, 0.0]) - origins) @ normal) / (directions @ normal)
    depth = stretched(camera, along * -(directions @ camera.backward))
    right, down, facing = slopes(camera, np.broadcast_to(normal, directions.shape), 0.05, directions)
    middle = (slice(20, 44), slice(20, 44))
    assert np.allclose(np.gradient(depth, axis=1)[middle], right[middle], atol=2e-2 * pixel_steps(camera)[0])
    assert np.allclose(np.gradient(depth, axis=0)[middle], down[middle], atol=2e-2 * pixel_steps(camera)[1])
    assert (facing[middle] > 0).all()


def test_trust_is_in_what_another_view_shows_too():
    cameras, images, mask = views_of(ball_before_a_wall, MATCHING_SIZE)
    prepared = prepare_all(cameras, mask, None, None)
    matched = match_views(cameras, mask, images["normal"], {}, prepared, hull_bounds(prepared))
    for view, shown, true in zip(matched, mask, images["depth"], strict=True):
        sure = (view.trust == 1) & (shown > 0.99)
        assert np.median(np.append(np.abs(view.depth - true)[sure], 0)) < 0.015  # a pixel
    back = cameras[[c.name for c in cameras].index("back")]
    faces_back = images["normal"][3] @ back.backward > 0.99  # no other camera of the six sees these
    assert matched[3].trust[faces_back & (mask[3] > 0.99)].mean() < 0.1


def test_costs_are_passed_along_planes():
    """Against the recurrence of Hirschmüller 2008, eq. 13, with depths that grow by whole candidates from pixel to
    pixel."""
    rng = np.random.default_rng(0)
    cost, slope = rng.uniform(0, 1, (1, 6, 9)).astype(np.float32), np.full((1, 6), 2.0)
    jump = rng.uniform(0.2, 1, (1, 6)).astype(np.float32)
    found = _aggregate_rows(cost, np.array([[1, 1, 1, 0, 1, 1]], bool), slope, jump, 1)[0]
    wanted = cost[0].copy()
    for p in (1, 2, 5):  # pixel 3 shows nothing, so 4 starts anew
        for d in range(9):
            reached = [wanted[p - 1].min() + min(jump[0, p], jump[0, p - 1])]
            reached += [wanted[p - 1, d - 2 + k] + STEP_COST * abs(k) for k in (-1, 0, 1) if 0 <= d - 2 + k < 9]
            wanted[p, d] += min(reached) - wanted[p - 1].min()
    assert np.allclose(found[[0, 1, 2, 4, 5]], wanted[[0, 1, 2, 4, 5]], atol=1e-5)


def test_one_view_alone_is_bounded_by_its_silhouette():
    cameras, images, mask = views_of(sphere, MATCHING_SIZE)
    depth = depth_for(cameras[:1], mask[:1], images["normal"][:1])
    assert np.isfinite(depth).all()
    assert (depth[0][mask[0] > 0.5] > 0).all()
    inside = mask[0] > 0.99
    off = (depth[0] - images["depth"][0])[inside]
    assert np.abs(off - np.median(off)).mean() < 0.01  # the form; how far away it is nothing tells


def test_views_that_show_nothing_have_no_depth():
    cameras, images, mask = views_of(sphere, MATCHING_SIZE)
    mask = mask.copy()
    mask[2] = 0
    depth = depth_for(cameras, mask, images["normal"])
    assert (depth[2] == 0).all()
    assert error(images, mask, depth).mean() < 0.008


@pytest.mark.parametrize("lie", ["other sides", "noise", "nothing"])
def test_normals_that_lie_still_leave_depths_within_the_silhouettes(lie):
    cameras, images, mask = views_of(torus, MATCHING_SIZE)
    normal = {
        "other sides": images["normal"][[0, 5, 4, 3, 2, 1]],
        "nothing": np.zeros_like(images["normal"]),
        "noise": np.random.default_rng(0).standard_normal(images["normal"].shape).astype(np.float32),
    }[lie]
    depth = depth_for(cameras, mask, normal)
    inside = mask > 0.5
    assert np.isfinite(depth).all()
    assert (depth[~inside] == 0).all()
    assert ((depth[inside] > 1) & (depth[inside] < 3)).all()


def test_views_that_do_not_fit_one_another_lean_on_the_silhouettes(monkeypatch):
    """Normals of each view turned by another 12 degrees; two balls fill their silhouettes, so these are right."""
    cameras, images, mask = views_of(two_balls, MATCHING_SIZE)
    rng, normal = np.random.default_rng(0), images["normal"].copy()
    for k in range(len(cameras)):
        axis = rng.standard_normal(3)
        turned = np.cross(axis / np.linalg.norm(axis), normal[k]) * np.tan(np.radians(12)) + normal[k]
        normal[k] = turned / np.maximum(np.linalg.norm(turned, axis=-1, keepdims=True), 1e-9)
    leaning = error(images, mask, depth_for(cameras, mask, normal)).mean()
    monkeypatch.setattr(multiview_stereo, "CONSISTENT_MISFIT", 1e9)
    trusting = error(images, mask, depth_for(cameras, mask, normal)).mean()
    assert leaning < 0.8 * trusting
