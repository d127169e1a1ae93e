"""Check the warnings of pictures unlike the training data and of results that the model is unsure of."""

import numpy as np
import pytest

from gdtool.core.errors import InputError
from gdtool.diffusion.inference.familiarity import (
    DOUBTS,
    RANGES_FILE,
    PictureRange,
    describe_doubts,
    describe_unfamiliar,
    figure_ranges,
    picture_figures,
    read_ranges,
    result_figures,
    usual_ranges,
    write_ranges,
)


def box(width, height, brightness, noise=0.02, size=32, seed=0):
    """Make a condition (4, size, size) that shows a grey box of width x height pixels."""
    alpha = np.zeros((size, size), np.float32)
    top, left = (size - height) // 2, (size - width) // 2
    alpha[top : top + height, left : left + width] = 1
    grey = brightness + np.random.default_rng(seed).normal(0, noise, (size, size))
    return np.concatenate([np.repeat(((2 * grey - 1) * alpha)[None], 3, 0), 2 * alpha[None] - 1]).astype(np.float32)


@pytest.fixture
def known():
    return figure_ranges(
        box(width, 20, brightness, seed=width) for width in range(10, 21) for brightness in (0.4, 0.5, 0.6)
    )


def test_figures_of_a_box():
    figures = picture_figures(box(10, 20, 0.5, noise=0.0))
    assert list(figures.values()) == pytest.approx([200 / 1024, 1.0, 0.5, 1.0, 0.5, 0.0, 0.0], abs=1e-6)


def test_figures_outside_their_range_in_training_are_described(known):
    assert describe_unfamiliar(box(15, 20, 0.5, seed=99), known) == []
    assert [text.split(" is ")[0] for text in describe_unfamiliar(box(15, 20, 0.95), known)] == ["mean brightness"]
    assert "width over height of the subject is 0.1, in training 0.5 to 1" in describe_unfamiliar(
        box(2, 20, 0.5), known
    )
    noisy = describe_unfamiliar(box(15, 20, 0.5, noise=0.3), known)
    assert any(text.startswith("difference between neighbouring pixels") for text in noisy)


def test_ranges_are_read_from_the_model_folder_if_present(known, tmp_path):
    assert read_ranges(tmp_path) == {}
    write_ranges(tmp_path / RANGES_FILE, known)
    assert read_ranges(tmp_path) == known
    (tmp_path / RANGES_FILE).write_text('{"mean brightness": {"low": "a"}}')
    with pytest.raises(InputError, match=RANGES_FILE):
        read_ranges(tmp_path)


def ramped(width, size=64, top=0):
    """Make the coverage (size, size) of a bar over columns 16 to 48, from the row `top` down.

    Its left and right sides are ramps of `width` pixels.
    """
    column = np.arange(size) + 0.5
    row = np.clip(0.5 + (16 - np.abs(column - size / 2)) / width, 0, 1)
    return np.where(np.arange(size)[:, None] >= top, row, 0.0).astype(np.float32)


@pytest.mark.parametrize("width", [2, 6, 12])
def test_the_blur_of_outlines_is_the_width_of_their_ramps(width):
    assert result_figures(ramped(width)[None].repeat(3, 0))["outline_blur"] == pytest.approx(width, rel=0.15)


def test_the_pictures_view_does_not_count():
    views = np.stack([ramped(12), ramped(2), ramped(2)])
    figures = result_figures(views, 0, ramped(1))
    assert figures["outline_blur"] == pytest.approx(result_figures(views[1:])["outline_blur"])
    assert figures["row_mismatch"] == pytest.approx(0, abs=1e-6)


def test_rows_that_the_other_views_leave_empty_are_counted():
    views = np.stack([ramped(1), ramped(1), ramped(1, top=16)])  # a quarter of the rows, in one of two views
    assert result_figures(views, 0, ramped(1))["row_mismatch"] == pytest.approx(0.125, abs=1e-6)
    assert "row_mismatch" not in result_figures(views)  # no picture, no rows


def test_an_empty_result_has_figures():
    assert result_figures(np.zeros((6, 8, 8), np.float32), 0, ramped(1, 8)) == {
        "outline_blur": 0.0,
        "row_mismatch": 1.0,
    }


def test_usual_ranges_hold_all_but_the_given_share():
    rng = np.random.default_rng(0)
    results = [dict(zip(DOUBTS, rng.exponential(size=len(DOUBTS)), strict=True)) for _ in range(400)]
    known = usual_ranges(results, 0.05)
    descriptions = [describe_doubts(figures, known) for figures in results]
    assert 0.045 < np.mean([bool(texts) for texts in descriptions]) <= 0.05
    # Each figure raises a share of the warnings.
    assert min(np.mean([figures[name] > known[name].high for figures in results]) for name in DOUBTS) > 0.02


def test_a_doubt_is_described_with_its_figure_and_the_usual_one():
    known = {"outline_blur": PictureRange(0.0, 9.0), "row_mismatch": PictureRange(0.0, 0.05)}
    assert describe_doubts({"outline_blur": 9.0, "row_mismatch": 0.05}, known) == []
    assert describe_doubts({"outline_blur": 12.34, "row_mismatch": 0.01}, known) == [
        "their outlines are blurred over 12.3 pixels, 9.0 at most is usual"
    ]
    assert (
        describe_doubts({"outline_blur": 12.34, "row_mismatch": 0.5}, {}) == []
    )  # a model that does not say what is usual
