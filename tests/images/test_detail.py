"""Compute means, gains and guided filters over the covered part of a picture."""

import numpy as np
import pytest

from gdtool.images.detail import detail_gain, guided, masked_mean

SIZE = 48


@pytest.fixture(scope="module")
def disc():
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    return (((x - SIZE / 2) ** 2 + (y - SIZE / 2) ** 2) < (0.4 * SIZE) ** 2).astype(float)


def test_masked_mean_leaves_out_uncovered_pixels(disc):
    values = np.where(disc[..., None] > 0, 0.7, 100.0) * np.ones(3)
    np.testing.assert_allclose(masked_mean(values, disc, 4.0)[disc > 0], 0.7, rtol=1e-9)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0, 1.5])
def test_detail_gain_is_the_share_of_common_detail(disc, share):
    rng = np.random.default_rng(0)
    picture = rng.normal(0, 1, (SIZE, SIZE, 3))
    y, x = np.mgrid[:SIZE, :SIZE] / SIZE
    second = share * picture + (x + y)[..., None]  # a slope is no detail
    np.testing.assert_allclose(detail_gain(picture, second, disc)[disc > 0], share, atol=0.02)


def test_guided_keeps_values_linear_in_the_guide_and_smooths_others(disc):
    rng = np.random.default_rng(1)
    guide = rng.normal(0, 1, (SIZE, SIZE, 3))
    linear = guide @ rng.normal(0, 1, (3, 3)) + 2.0
    noise = rng.normal(0, 1, (SIZE, SIZE, 3))
    inside = disc > 0
    np.testing.assert_allclose(guided(linear, guide, disc, 6.0, 1e-6)[inside], linear[inside], atol=1e-3)
    assert guided(noise, guide, disc, 6.0, 1e-6)[inside].std() < 0.3 * noise[inside].std()


def test_a_constant_guide_gives_the_mean(disc):
    rng = np.random.default_rng(2)
    values, guide = rng.normal(0, 1, (SIZE, SIZE, 2)), np.ones((SIZE, SIZE, 3))
    np.testing.assert_allclose(
        guided(values, guide, disc, 4.0, 1e-3), masked_mean(masked_mean(values, disc, 4.0), disc, 4.0), atol=1e-6
    )
