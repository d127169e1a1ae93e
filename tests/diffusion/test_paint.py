"""Check that the picture's contrast returns to the albedo of its view, and that light does not."""

import numpy as np
import pytest

from gdtool.diffusion.inference.paint import restore_albedo_contrast

SIZE = 64


@pytest.fixture(scope="module")
def ball():
    """Return a ball's coverage (SIZE, SIZE), its unit normals, and light on it that is linear in the normal."""
    y, x = (np.mgrid[:SIZE, :SIZE] + 0.5) / SIZE * 2 - 1
    z = np.sqrt(np.clip(0.8**2 - x**2 - y**2, 0, None))
    normal = np.stack([x, -y, z], -1) / np.maximum(np.sqrt(x**2 + y**2 + z**2), 1e-6)[..., None]
    return (z > 0.2).astype(np.float32), normal.astype(np.float32), 0.5 + 0.3 * normal @ np.array([0.6, 0.5, 0.6])


def painted():
    y, x = np.mgrid[:SIZE, :SIZE]
    return np.where(((x // 5 + y // 5) % 2 == 0)[..., None], [0.7, 0.6, 0.2], [0.2, 0.1, 0.3])


def washed(albedo, contrast):
    """Reduce the contrast of the logarithm of albedo to the share `contrast`, as a model does."""
    logs = np.log(albedo)
    mean = logs.mean((0, 1))
    return np.exp(mean + contrast * (logs - mean))


def error(albedo, truth, mask):
    return float(np.sqrt(((albedo - truth)[mask > 0] ** 2).mean()))


def test_contrast_that_the_model_halved_is_restored(ball):
    mask, normal, light = ball
    truth = painted()
    faded = washed(truth, 0.55)
    restored, share = restore_albedo_contrast(faded, truth * light[..., None], mask, normal)
    assert error(restored, truth, mask) < 0.35 * error(faded, truth, mask)
    assert share[mask > 0].min() > 0.9


def test_contrast_is_restored_without_normals(ball):
    mask, _, light = ball
    truth = painted()
    faded = washed(truth, 0.55)
    assert error(restore_albedo_contrast(faded, truth * light[..., None], mask)[0], truth, mask) < 0.6 * error(
        faded, truth, mask
    )


def test_shadows_on_one_color_stay_out(ball):
    mask, normal, light = ball
    y, x = np.mgrid[:SIZE, :SIZE]
    truth = np.full((SIZE, SIZE, 3), 0.5)
    shadow = np.where((x + y) % 20 < 8, 0.3, 1.0)
    color = truth * (light * shadow)[..., None]
    leaked = washed(truth * shadow[..., None], 0.2)  # a model that takes a fifth of the shadow for paint
    restored, share = restore_albedo_contrast(leaked, color, mask, normal)
    assert share.max() == 0
    np.testing.assert_array_equal(restored, leaked)


def test_reflections_of_a_metal_stay_out(ball):
    mask, normal, light = ball
    faded = washed(painted(), 0.55)
    restored, share = restore_albedo_contrast(faded, painted() * light[..., None], mask, normal, np.ones_like(mask))
    assert share.max() == 0
    np.testing.assert_array_equal(restored, faded)


def test_a_correct_albedo_stays(ball):
    mask, normal, light = ball
    truth = painted()
    restored, _ = restore_albedo_contrast(truth, truth * light[..., None], mask, normal)
    assert error(restored, truth, mask) < 0.02


def test_black_white_and_empty_pictures_stay_finite(ball):
    mask, normal, _ = ball
    for color in (0.0, 1.0, 50.0):
        restored, _ = restore_albedo_contrast(
            np.full((SIZE, SIZE, 3), 0.5), np.full((SIZE, SIZE, 3), color), mask, normal
        )
        assert np.isfinite(restored).all()
        assert (restored >= 0).all()
        assert (restored <= 1).all()
    assert restore_albedo_contrast(painted(), painted(), np.zeros_like(mask), normal)[1].max() == 0
