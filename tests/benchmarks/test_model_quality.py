"""benchmarks/train/quality.py: how one way's lead over another is told."""

import numpy as np
import pytest

from benchmarks.train.quality import leads


def test_small_errors_and_large_psnr_are_ahead():
    own = [
        {"psnr": 20.0, "normal_degrees": 10.0},
        {"psnr": 22.0, "normal_degrees": 15.0},
        {"psnr": 21.0, "normal_degrees": 11.0},
    ]
    other = [
        {"psnr": 19.0, "normal_degrees": 12.0},
        {"psnr": 19.0, "normal_degrees": 14.0},
        {"psnr": 19.0, "normal_degrees": 16.0},
    ]
    found = leads(own, other)
    assert found["lead over the nearest"] == {"psnr": 2.0, "normal_degrees": 2.0}
    assert found["ahead on"] == {"psnr": 1.0, "normal_degrees": pytest.approx(2 / 3)}
    assert found["its standard error"]["normal_degrees"] == pytest.approx(np.std([2, -1, 5], ddof=1) / 3**0.5)


def test_objects_without_a_figure_are_left_out():
    own, other = [{"depth_error": 0.1}, {"depth_error": float("nan")}], [{"depth_error": 0.3}, {"depth_error": 0.2}]
    found = leads(own, other)
    assert found["lead over the nearest"]["depth_error"] == pytest.approx(0.2)
    assert found["ahead on"]["depth_error"] == 1.0
    assert np.isnan(found["its standard error"]["depth_error"])
