"""Compact a layout of charts, found on a coarse grid, on a fine grid; the gap between charts is kept."""

from __future__ import annotations

import numpy as np

from gdtool.unwrap.pack.bitmasks import ChartMasks, OrientedChart, Placement, bits_of, rotated_masks

# Cells along the side of the fine grid, about, and of a rougher one that tells whether charts can be separated at all.
FINE, ROUGH = 768, 300
_SPREADS = (1.0, 1.01, 1.02, 1.03, 1.04, 1.05, 1.07, 1.1)  # scales of the distances between charts, until each fits
# Offsets from the wanted place that are tried, in cells, nearest first.
_NEAR_OFFSETS = sorted(
    ((dx, dy) for dx in range(-16, 17) for dy in range(-16, 17)), key=lambda d: d[0] ** 2 + d[1] ** 2
)
_ROUNDS = 12  # of moving all charts up, or all charts to the left
_FIRST_STEP = 1 << 5  # cells of the first move; halved where it is blocked


class FineGridCompactor:
    """Charts on a grid of about `cells` cells a side, finer than that of their masks, each with the gap around it.

    sides: of the layouts that will be moved to this grid, the best first, in cells of the masks. gap: between charts,
    in uv.
    """

    def __init__(
        self,
        charts: list[OrientedChart],
        masks: ChartMasks,
        cells_per_unit: float,
        sides: list[int],
        gap: float,
        cells: int = FINE,
    ):
        self._finer = max(round(cells / sides[0]), 1)
        self._max_side = int(self._finer * max(sides) * _SPREADS[-1])
        self._chart_masks, self._cells_per_unit = masks, cells_per_unit * self._finer
        self._turned = [rotated_masks(rim, uv, self._cells_per_unit, gap * self._max_side) for uv, rim in charts]
        self._bits: dict[tuple[int, int], int] = {}

    def separate(self, layout: list[Placement]) -> tuple[list[list[int]], int] | None:
        """Move the charts of a layout to the nearest places where they are clear of each other.

        Returns places [x, y] and the cells taken, or None where a chart finds no place.
        """
        for i, (turn, _, _) in enumerate(layout):
            if (i, turn) not in self._bits:
                self._bits[i, turn] = bits_of(self._turned[i][0][turn], self._max_side + 1)
        for spread in _SPREADS:
            wanted = []
            for i, (turn, x, y) in enumerate(layout):
                h, w = self._chart_masks.shapes[i][turn]
                first = self._chart_masks.uv[i][turn][0] + [x, y] + (spread - 1) * np.array([x + w / 2, y + h / 2])
                wanted.append(np.rint(first * self._finer - self._turned[i][1][turn][0]).astype(int))
            separated = _separate_masks(*self._masks(layout), wanted, self._max_side)
            if separated is not None:
                return separated
        return None

    def compact(self, layouts: list[list[Placement]]) -> tuple[list[np.ndarray], float] | None:
        """Separate the charts of each layout and push them together; return the layout with the smallest square.

        Charts move up, then left, as far as they can, again and again. Returns uv of each chart in the unit square and
        their scale, as pack() does; None where no layout can be separated.
        """
        best, best_used = None, self._max_side + 1
        for layout in layouts:
            separated = self.separate(layout)
            if separated is not None:
                place, used = _push_together(*self._masks(layout), *separated, self._max_side + 1)
                if used < best_used:
                    best_used, best = (
                        used,
                        [
                            self._turned[i][1][at.turn] + xy
                            for i, (at, xy) in enumerate(zip(layout, place, strict=True))
                        ],
                    )
        return best and ([uv / best_used for uv in best], self._cells_per_unit / best_used)

    def _masks(self, layout: list[Placement]) -> tuple[list[int], list[tuple[int, int]]]:
        """Return the bits of the charts at their quarter turns in a layout, and their sizes (h, w)."""
        return [self._bits[i, at.turn] for i, at in enumerate(layout)], [
            self._turned[i][0][at.turn].shape for i, at in enumerate(layout)
        ]


def _separate_masks(
    masks: list[int], sizes: list[tuple[int, int]], wanted: list[np.ndarray], most: int
) -> tuple[list[list[int]], int] | None:
    """Find places [x, y] near the wanted ones where masks of sizes (h, w) are clear of each other.

    Returns the places and the cells taken, or None where a mask finds no place.
    """
    taken, place = 0, [[0, 0]] * len(masks)
    for i in sorted(range(len(masks)), key=lambda k: -masks[k].bit_count()):
        (h, w), (x, y) = sizes[i], np.clip(wanted[i], 0, np.maximum(most - np.array(sizes[i][::-1]), 0)).tolist()
        for dx, dy in _NEAR_OFFSETS:
            if (
                0 <= x + dx <= most - w
                and 0 <= y + dy <= most - h
                and not taken >> (y + dy) * (most + 1) + x + dx & masks[i]
            ):
                break
        else:
            return None
        place[i] = [x + dx, y + dy]
        taken |= masks[i] << (y + dy) * (most + 1) + x + dx
    return place, taken


def _push_together(
    masks: list[int], sizes: list[tuple[int, int]], place: list[list[int]], taken: int, stride: int
) -> tuple[list[list[int]], int]:
    """Move masks up, then left, as far as they can, again and again.

    Returns their places and the side of the square they use.
    """
    sides = [max(max(x + w, y + h) for (x, y), (h, w) in zip(place, sizes, strict=True))]
    for turn in range(_ROUNDS):
        axis, still = 1 - turn % 2, True
        for i in sorted(range(len(masks)), key=lambda k: place[k][axis]):
            x, y = place[i]
            others = taken ^ masks[i] << y * stride + x
            step = _FIRST_STEP
            while step:
                moved = [x, y]
                moved[axis] -= step
                if moved[axis] >= 0 and not others >> moved[1] * stride + moved[0] & masks[i]:
                    x, y = moved
                    still = False
                else:
                    step //= 2
            place[i] = [x, y]
            taken = others | masks[i] << y * stride + x
        sides.append(max(max(x + w, y + h) for (x, y), (h, w) in zip(place, sizes, strict=True)))
        if still and turn or len(sides) > 4 and sides[-1] == sides[-4]:
            break
    return place, sides[-1]
