"""The picture's contrast in the albedo of its view: paint comes back, light stays out."""

import numpy as np
import pytest

from gdtool.diffusion.inference.paint import restore_albedo_contrast

SIZE = 64


@pytest.fixture(scope="module")
def ball():
    """Coverage (SIZE, SIZE) and unit normals of a ball, and the light on it: linear in the normal, and an edge of
    shadow none."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE * 2 - 1
    z = np.sqrt(np.clip(0.8**2 - x**2 - y**2, 0, None))
    normal = np.stack([x, -y, z], -1) / np.maximum(np.sqrt(x**2 + y**2 + z**2), 1e-6)[..., None]
    return (z > 0.2).astype(np.float32), normal.astype(np.float32), 0.5 + 0.3 * normal @ np.array([0.6, 0.5, 0.6])


def painted():
    y, x = np.mgrid[:SIZE, :SIZE]
    return np.where(((x // 5 + y // 5) % 2 == 0)[..., None], [0.7, 0.6, 0.2], [0.2, 0.1, 0.3])


def washed(albedo, kept):
    """What a model makes of it: kept of the contrast, in logarithms, about the mean color."""
    logs = np.log(albedo)
    mean = logs.mean((0, 1))
    return np.exp(mean + kept * (logs - mean))


def error(albedo, truth, mask):
    return float(np.sqrt(((albedo - truth)[mask > 0] ** 2).mean()))


def test_contrast_that_the_model_left_half_of_comes_back(ball):
    mask, normal, light = ball
    truth = painted()
    given = washed(truth, 0.55)
    found, share = restore_albedo_contrast(given, truth * light[..., None], mask, normal)
    assert error(found, truth, mask) < 0.35 * error(given, truth, mask)
    assert share[mask > 0].min() > 0.9


def test_without_normals_too(ball):
    mask, _, light = ball
    truth = painted()
    given = washed(truth, 0.55)
    assert error(restore_albedo_contrast(given, truth * light[..., None], mask)[0], truth, mask) < 0.6 * error(
        given, truth, mask
    )


def test_shadows_on_one_color_stay_out(ball):
    mask, normal, light = ball
    y, x = np.mgrid[:SIZE, :SIZE]
    truth = np.full((SIZE, SIZE, 3), 0.5)
    shadow = np.where((x + y) % 20 < 8, 0.3, 1.0)
    color = truth * (light * shadow)[..., None]
    leaked = washed(truth * shadow[..., None], 0.2)  # a model that takes a fifth of the shadow for paint
    found, share = restore_albedo_contrast(leaked, color, mask, normal)
    assert share.max() == 0
    np.testing.assert_array_equal(found, leaked)


def test_what_a_metal_mirrors_stays_out(ball):
    mask, normal, light = ball
    given = washed(painted(), 0.55)
    found, share = restore_albedo_contrast(given, painted() * light[..., None], mask, normal, np.ones_like(mask))
    assert share.max() == 0
    np.testing.assert_array_equal(found, given)


def test_an_albedo_that_is_right_stays(ball):
    mask, normal, light = ball
    truth = painted()
    found, _ = restore_albedo_contrast(truth, truth * light[..., None], mask, normal)
    assert error(found, truth, mask) < 0.02


def test_black_white_and_empty_pictures_stay_finite(ball):
    mask, normal, _ = ball
    for color in (0.0, 1.0, 50.0):
        found, _ = restore_albedo_contrast(np.full((SIZE, SIZE, 3), 0.5), np.full((SIZE, SIZE, 3), color), mask, normal)
        assert np.isfinite(found).all()
        assert (found >= 0).all()
        assert (found <= 1).all()
    assert restore_albedo_contrast(painted(), painted(), np.zeros_like(mask), normal)[1].max() == 0
