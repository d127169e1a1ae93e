"""Check where the samples of a pixel lie, and the error of a mean over them."""

import numpy as np
import pytest

from gdtool.shading.render.pattern import pixel_pattern
from gdtool.shading.render.render import ERROR_POWER, ERROR_SCALE


@pytest.mark.parametrize("count", [4, 8, 16, 32, 64])
def test_every_pass_is_evenly_spread_and_centred(count):
    points = pixel_pattern(count)
    assert points.min() >= 0
    assert points.max() < 1
    assert np.abs(points.mean(0) - 0.5).max() < 1e-6
    # There is one Sobol point in each of `count` columns and rows; centring moves it by up to another cell.
    for axis in (0, 1):
        ranks = np.sort(points[:, axis])
        assert np.abs(ranks - (np.arange(count) + 0.5) / count).max() < 1.6 / count


@pytest.mark.parametrize("count", [4, 8, 16, 32, 64])
def test_the_expected_error_is_that_of_straight_edges(count):
    """Compare the error model that stops sampling with the RMS over edges of every angle and place, within a third."""
    random = np.random.default_rng(0)
    angle, offset = random.uniform(0, 2 * np.pi, 20_000), random.uniform(-0.7, 0.7, 20_000)
    normal = np.stack([np.cos(angle), np.sin(angle)])

    def covered(points):
        return np.concatenate(
            [
                ((points - 0.5) @ part < o).mean(0)
                for part, o in zip(np.split(normal, 40, 1), np.split(offset, 40), strict=True)
            ]
        )

    fine = (np.stack(np.meshgrid(*[np.arange(48)] * 2), -1).reshape(-1, 2) + 0.5) / 48
    mean = covered(pixel_pattern(count))
    error = np.sqrt(((mean - covered(fine)) ** 2).mean())
    standard = np.sqrt((mean * (1 - mean) / count).mean())
    assert error / standard == pytest.approx(ERROR_SCALE * count**ERROR_POWER, rel=1 / 3)
