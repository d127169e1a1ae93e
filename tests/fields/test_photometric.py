"""What colors say of depth: measured against planes and solids whose depth is known to be wrong."""

import numpy as np
import pytest

from gdtool.cameras import project
from gdtool.fields.grid.fusion import AlignmentOptions, align_depth, grid_step
from gdtool.fields.views.photometric import Picture, color_equations

from .shapes import sphere, views_of

SIZE = 96
REACH = 0.04


def painted(points):
    return 0.5 + 0.3 * np.sin(25 * points @ np.array([[1.0, 0.3, -0.4], [0.2, 0.9, 0.5], [0.7, -0.5, 0.8]]))


@pytest.fixture(scope="module")
def ball():
    cameras, images, mask = views_of(lambda points: sphere(points, 0.45), SIZE)
    images["albedo"] = np.where(mask[..., None] > 0, painted(0.45 * images["normal"]), 0).astype(np.float32)
    return cameras, images, mask


def rows(ball, error, gain=1.0, offset=0.0):
    """color_equations of the front view's points, `error` too far away, against front_right."""
    cameras, images, mask = ball
    names = [camera.name for camera in cameras]
    first, second = names.index("front"), names.index("front_right")
    pictures = [
        Picture.of(
            cameras[k],
            images["albedo"][k] * (gain if k == second else 1) + (offset if k == second else 0),
            mask[k],
            REACH,
        )
        for k in (first, second)
    ]
    normal = images["normal"][first]
    seen = (mask[first] > 0.99) & (normal @ cameras[first].backward > 0.5) & (normal @ cameras[second].backward > 0.5)
    points = (0.45 * normal - error * cameras[first].backward)[seen].astype(np.float64)
    here = np.argwhere(seen)[:, ::-1] + 0.5
    return color_equations(points, here, project(cameras[second], points)[0], *pictures, np.ones(len(points)))


@pytest.mark.parametrize("error", [0.004, -0.004])
@pytest.mark.parametrize("gain, offset", [(1.0, 0.0), (0.8, 0.1)])
def test_the_rows_give_the_error_of_depth_back(ball, error, gain, offset):
    slope, difference, weight = rows(ball, error, gain, offset)
    assert (difference * slope * weight).sum() / (slope**2 * weight).sum() == pytest.approx(error, rel=0.15)


def test_a_flat_picture_says_nothing(ball):
    cameras, images, mask = ball
    flat = cameras, images | {"albedo": np.full_like(images["albedo"], 0.5)}, mask
    slope, difference, weight = rows(flat, 0.004)
    assert np.abs(slope).max() < 1e-4
    assert np.abs(difference).max() < 1e-4
    assert np.isfinite(weight).all()


def bent(ball):
    """Depth (k, h, w) of each view with a smooth error of its own."""
    cameras, images, mask = ball
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    wave = np.stack([0.012 * np.sin(9 * x + 2 * k) * np.cos(8 * y - k) for k in range(len(cameras))])
    return np.where(mask > 0, images["depth"] + wave, 0).astype(np.float32)


def off(ball, colors):
    """Mean error of the aligned views' points."""
    cameras, images, mask = ball
    prepared = align_depth(cameras, mask, bent(ball), None, grid_step(cameras, 0), AlignmentOptions(colors=colors))[0]
    return float(np.mean([np.abs(sphere(s.points[s.weight > 0.3], 0.45)).mean() for s in prepared]))


def test_colors_find_what_the_views_get_wrong_together(ball):
    assert off(ball, [ball[1]["albedo"]]) < 0.6 * off(ball, [])


def test_colors_that_contradict_each_other_do_little_harm(ball):
    noise = np.random.default_rng(0).random(ball[1]["albedo"].shape).astype(np.float32)
    assert off(ball, [noise]) < 1.1 * off(ball, [])
    assert off(ball, [np.zeros_like(noise)]) == pytest.approx(off(ball, []), rel=1e-6)
