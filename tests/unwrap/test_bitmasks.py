"""Charts as bit masks: no cell that a chart touches is missed, and the places found are free."""

import numpy as np
import pytest

from gdtool.geometry.uv_raster import owner_count
from gdtool.unwrap.pack.bitmasks import ChartMasks, Placement, orient_upright, outline_of, rotated_masks
from gdtool.unwrap.pack.compact import FineGridCompactor

RING = np.array([[0, 0], [9, 0], [9, 7], [0, 7], [2, 2], [7, 2], [7, 5], [2, 5.0]])
RING_TRIANGLES = np.array([[0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])


@pytest.mark.parametrize("gap", [0.0, 1.7])
def test_a_mask_covers_the_chart_and_the_gap_but_not_its_hole(gap):
    rim = outline_of(RING, RING_TRIANGLES)
    assert len(rim) == 8
    masks, at = rotated_masks(rim, RING, 4.0, gap)
    for mask, uv in zip(masks, at, strict=True):
        size = max(mask.shape)
        covered = owner_count(uv / size, RING_TRIANGLES, size)[: mask.shape[0], : mask.shape[1]] > 0
        assert (mask | ~covered).all()
        # The mask has half a gap around the chart, and at most a cell and a half more.
        assert mask.sum() <= (4 * 9 + gap + 3) * (4 * 7 + gap + 3) - (4 * 5 - gap - 3) * (4 * 3 - gap - 3)
        assert not mask[tuple(np.array(mask.shape) // 2)]
    # Cells that are half covered: their area is about that of the chart.
    half = rotated_masks(rim, RING, 4.0, 0.0, 0.5)[0][0]
    assert half.sum() == pytest.approx(16 * (63 - 15), rel=0.02)


def test_places_found_are_free_and_a_full_square_has_none():
    rim = outline_of(RING, RING_TRIANGLES)
    shapes = ChartMasks([(RING, rim)] * 4, 2.0, 0.0, 40)
    border, taken = shapes.border(40), 0
    for i in range(4):
        place = shapes.find_place(i, taken, border, 40, 0.5)
        cells = shapes.cells_at(i, place)
        assert not cells & taken
        assert shapes.extent_at(i, place) <= 40
        taken |= cells
    assert shapes.find_place(0, (1 << 41 * 40) - 1, border, 40, 0.5) is None


def test_turns_that_map_a_chart_onto_itself_are_skipped():
    square, oblong = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 0], [3, 0], [3, 1], [0, 1.0]])
    wedge, triangles = np.array([[0, 0], [3, 0], [3, 1], [0, 2.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    shapes = ChartMasks([(uv, outline_of(uv, triangles)) for uv in (square, oblong, wedge)], 8.0, 1.5, 60)
    assert shapes._turns == [[0], [0, 1], [0, 1, 2, 3]]
    taken = shapes.cells_at(2, shapes.find_place(2, 0, shapes.border(60), 60, 0.5))
    less = [shapes.find_place(i, taken, shapes.border(60), 60, 0.5) for i in range(2)]
    shapes._turns = [[0, 1, 2, 3]] * 3
    assert less == [shapes.find_place(i, taken, shapes.border(60), 60, 0.5) for i in range(2)]


def test_places_blocked_by_charts_are_those_where_cells_are_taken():
    ring, sides = outline_of(RING, RING_TRIANGLES), np.random.default_rng(5).uniform(1, 9, (6, 2))
    square, triangles = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), np.array([[0, 1, 2], [0, 2, 3]])
    boxed = [(RING, ring)] * 2 + [(square * side, outline_of(square * side, triangles)) for side in sides]
    shapes = ChartMasks(boxed, 2.0, 1.5, 44)
    border, taken, others = shapes.border(40), 0, []  # a smaller square than the masks' side
    for i in range(8):
        place = shapes.find_place(i, taken, border, 40, 0.5)
        assert shapes.find_place(i, taken, border, 40, 0.5, others) == place is not None
        free = [
            not shapes.cells_at(i, Placement(turn, x, y)) & taken
            for turn in range(4)
            for x in range(41 - shapes.shapes[i][turn][1])
            for y in range(41 - shapes.shapes[i][turn][0])
        ]
        hit = [
            not shapes._blocked_places(i, turn, others) >> y * shapes.stride + x & 1
            for turn in range(4)
            for x in range(41 - shapes.shapes[i][turn][1])
            for y in range(41 - shapes.shapes[i][turn][0])
        ]
        assert hit == free
        others.append((i, place))
        taken |= shapes.cells_at(i, place)


def test_a_layout_whose_charts_touch_is_moved_apart():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    boxed = [(square, outline_of(square, triangles))] * 4
    gap, cells = 1 / 50, 10.4  # squares of 10.4 cells, at places 10 cells apart
    shapes = ChartMasks(boxed, cells, 0.0, 40, 0.5)
    places, scale = FineGridCompactor(boxed, shapes, cells, [22], gap).compact(
        [[Placement(0, 0, 0), Placement(0, 10, 0), Placement(0, 0, 10), Placement(0, 10, 10)]]
    )
    low, high = np.array([uv.min(0) for uv in places]), np.array([uv.max(0) for uv in places])
    assert low.min() >= 0.4 * gap
    assert high.max() <= 1 - 0.4 * gap
    assert high - low == pytest.approx(np.full((4, 2), scale))
    apart = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(-1)
    assert apart[~np.eye(4, dtype=bool)].min() >= 0.99 * gap
    assert 4 * scale**2 > 0.85


def test_upright_is_the_smallest_rectangle_with_its_longer_side_along_u():
    turn = np.array([[np.cos(1.1), -np.sin(1.1)], [np.sin(1.1), np.cos(1.1)]])
    assert np.ptp(orient_upright(RING @ turn), 0) == pytest.approx([9, 7], rel=1e-3)


def test_orders_are_not_searched_where_charts_cannot_be_separated(monkeypatch):
    """Charts cannot be separated here: the first share of a cell is skipped, the other two are searched for orders."""
    from gdtool.unwrap.pack import search

    sides = np.random.default_rng(3).uniform(1, 5, (14, 2))
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    charts = [(np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]) * side, triangles) for side in sides]
    calls, improved = [], search._improve_layouts
    monkeypatch.setattr(
        search,
        "_improve_layouts",
        lambda *arguments, **options: calls.append(arguments) or improved(*arguments, **options),
    )
    monkeypatch.setattr(FineGridCompactor, "separate", lambda *arguments: None)
    places, _ = search.pack(charts, 0.002)
    shares = [arguments[0].shapes for arguments in calls]
    assert len(calls) == 2
    assert shares[0] != shares[1]
    assert (
        owner_count(np.concatenate(places), np.concatenate([triangles + 4 * i for i in range(14)]), 2048) <= 1
    ).all()
