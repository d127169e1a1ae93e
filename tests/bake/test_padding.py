"""Gutters: nothing stays black, nothing known changes, mip levels stay clean."""

import numpy as np
import pytest

from gdtool.bake.padding import fill_gutters, push_pull


def disc(size=65, radius=14):
    y, x = np.mgrid[:size, :size]
    return (x - 30) ** 2 + (y - 34) ** 2 < radius**2


@pytest.mark.parametrize("shape", [(65, 65), (64, 64), (1, 9), (37, 20)])
def test_constant_stays_constant_everywhere(shape):
    mask = np.zeros(shape, bool)
    mask[0, -1] = True
    image = np.where(mask[..., None], [0.2, 0.5, 0.9], 0.0)
    np.testing.assert_allclose(push_pull(image, mask), np.broadcast_to([0.2, 0.5, 0.9], (*shape, 3)), atol=1e-6)


def test_known_texels_stay_and_filled_texels_lie_within_their_range():
    mask = disc()
    rng = np.random.default_rng(0)
    image = np.where(mask[..., None], rng.uniform(0.3, 0.6, (65, 65, 3)), -100.0)
    filled = push_pull(image, mask)
    np.testing.assert_array_equal(filled[mask], image[mask].astype(np.float32))
    assert filled.min() >= 0.3 - 1e-6
    assert filled.max() <= 0.6 + 1e-6


def test_gutter_takes_the_colour_of_the_nearest_chart():
    mask = np.zeros((64, 64), bool)
    mask[:, :20], mask[:, 44:] = True, True
    image = np.where(np.arange(64) < 32, 0.0, 1.0) * np.ones((64, 1))
    filled = push_pull(image, mask)
    assert (filled[:, 20:24] < 0.12).all()
    assert (filled[:, 40:44] > 0.88).all()


def test_padding_limits_the_gutter():
    mask = disc()
    image = np.where(mask, 0.7, 0.0)
    filled = fill_gutters(image, mask, padding=3, background=0.1)
    from scipy.ndimage import binary_dilation

    near = binary_dilation(mask, iterations=2)
    np.testing.assert_allclose(filled[near], 0.7, atol=1e-6)
    assert filled[0, 0] == np.float32(0.1)
    np.testing.assert_allclose(fill_gutters(image, mask, padding=3)[0, 0], 0.7, rtol=1e-6)


def test_mip_levels_near_a_chart_keep_its_colour():
    mask = disc(64, 16)
    filled = push_pull(np.where(mask[..., None], [0.8, 0.2, 0.1], 0.0), mask)
    for _ in range(4):
        filled = (filled[::2, ::2] + filled[1::2, ::2] + filled[::2, 1::2] + filled[1::2, 1::2]) / 4
    np.testing.assert_allclose(filled, np.broadcast_to([0.8, 0.2, 0.1], filled.shape), atol=1e-6)


def test_an_empty_mask_returns_the_image():
    image = np.random.default_rng(0).uniform(size=(8, 8))
    np.testing.assert_array_equal(push_pull(image, np.zeros((8, 8), bool)), image)
