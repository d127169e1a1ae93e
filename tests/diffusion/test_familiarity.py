"""Pictures unlike the training's are told, with the figure that is outside; training's own are not."""

import numpy as np
import pytest

from gdtool.core.errors import InputError
from gdtool.diffusion.familiarity import FILE, picture_figures, ranges, read_ranges, unfamiliar, write_ranges


def box(width, height, brightness, noise=0.02, size=32, seed=0):
    """A framed box of so many pixels: a condition (4, size, size)."""
    alpha = np.zeros((size, size), np.float32)
    top, left = (size - height) // 2, (size - width) // 2
    alpha[top: top + height, left: left + width] = 1
    grey = brightness + np.random.default_rng(seed).normal(0, noise, (size, size))
    return np.concatenate([np.repeat(((2 * grey - 1) * alpha)[None], 3, 0), 2 * alpha[None] - 1]).astype(np.float32)


@pytest.fixture
def known():
    return ranges(box(width, 20, brightness, seed=width) for width in range(10, 21) for brightness in (0.4, 0.5, 0.6))


def test_a_boxes_figures():
    own = picture_figures(box(10, 20, 0.5, noise=0.0))
    assert list(own.values()) == pytest.approx([200 / 1024, 1.0, 0.5, 1.0, 0.5, 0.0, 0.0], abs=1e-6)


def test_what_is_unlike_the_training_is_named(known):
    assert unfamiliar(box(15, 20, 0.5, seed=99), known) == []
    assert [text.split(" is ")[0] for text in unfamiliar(box(15, 20, 0.95), known)] == ["mean brightness"]
    assert "width over height of the subject is 0.1, in training 0.5 to 1" in unfamiliar(box(2, 20, 0.5), known)
    noisy = unfamiliar(box(15, 20, 0.5, noise=0.3), known)
    assert any(text.startswith("difference between neighbouring pixels") for text in noisy)


def test_ranges_are_kept_in_the_model_folder_and_may_be_absent(known, tmp_path):
    assert read_ranges(tmp_path) == {}
    write_ranges(tmp_path / FILE, known)
    assert read_ranges(tmp_path) == known
    (tmp_path / FILE).write_text('{"mean brightness": {"low": "a"}}')
    with pytest.raises(InputError, match=FILE):
        read_ranges(tmp_path)
