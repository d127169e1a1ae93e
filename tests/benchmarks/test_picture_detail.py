"""benchmarks/sample_views/picture_detail.py: what it says of one color, and of paint."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.sample_views import picture_detail as picture
from gdtool.cameras import rig
from gdtool.images.metrics import resized


@pytest.mark.parametrize("painted", [False, True])
def test_the_ways_are_told_apart(painted):
    y, x = np.mgrid[:128, :128]
    truth = np.full((128, 128, 3), 0.4, np.float32)
    if painted:
        truth[(x // 7) % 2 > 0] = 0.8
    light = np.where((x + y) % 30 < 10, 0.4, 0.9)[..., None] if not painted else 0.7
    shown = np.concatenate([truth * light, np.ones((128, 128, 1))], -1).astype(np.float32)
    found = picture.errors(resized(truth, 32, 32), np.ones((32, 32)), shown, truth, replace(rig("six", 32)[0]))
    enlarged, sharpened, whole = (found[way][0] for way in picture.WAYS)
    if painted:
        assert sharpened > enlarged + 3
    else:
        assert sharpened == pytest.approx(enlarged, abs=1)
        assert whole < enlarged - 20
