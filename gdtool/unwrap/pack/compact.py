"""A layout of charts on a coarse grid tightened on a fine one, where none comes too near another."""

from __future__ import annotations

import numpy as np

from gdtool.unwrap.pack.bitmasks import Shapes, bits_of, turned

FINE, ROUGH = 768, 300  # cells of the side of the fine grid, about, and of one that tells whether charts come apart
_SPREADS = (1.0, 1.01, 1.02, 1.03, 1.04, 1.05, 1.07, 1.1)  # by which charts are moved apart until each finds room
# Places tried, in cells.
_NEAR = sorted(((dx, dy) for dx in range(-16, 17) for dy in range(-16, 17)), key=lambda d: d[0] ** 2 + d[1] ** 2)
_ROUNDS = 12  # of moving all of them up, or all of them to the left


class Fine:
    """Charts on a finer grid than their shapes', of about so many cells a side, the gap around them; sides: of the
    layouts that are to be moved there, the best first, in cells of the shapes."""

    def __init__(
        self, boxed: list, shapes: Shapes, cells_per_unit: float, sides: list[int], gap: float, cells: int = FINE
    ):
        self._finer = max(round(cells / sides[0]), 1)
        self._most = int(self._finer * max(sides) * _SPREADS[-1])
        self._shapes, self._cells = shapes, cells_per_unit * self._finer
        self._turned = [turned(rim, uv, self._cells, gap * self._most) for uv, rim in boxed]
        self._bits: dict[tuple[int, int], int] = {}

    def apart(self, layout: list) -> tuple[list[list[int]], int] | None:
        """Places [x, y] of the charts of a layout, (turn, x, y) of each in cells of the shapes, and what they take:
        each at the nearest place where it is clear of the others. None where one finds none."""
        for i, (turn, _, _) in enumerate(layout):
            if (i, turn) not in self._bits:
                self._bits[i, turn] = bits_of(self._turned[i][0][turn], self._most + 1)
        for spread in _SPREADS:
            wanted = []
            for i, (turn, x, y) in enumerate(layout):
                h, w = self._shapes.shapes[i][turn]
                first = self._shapes.uv[i][turn][0] + [x, y] + (spread - 1) * np.array([x + w / 2, y + h / 2])
                wanted.append(np.rint(first * self._finer - self._turned[i][1][turn][0]).astype(int))
            found = _apart(*self._masks(layout), wanted, self._most)
            if found is not None:
                return found
        return None

    def settled(self, layouts: list[list]) -> tuple[list[np.ndarray], float] | None:
        """The best of the layouts, as pack() returns it: the charts apart, then up and to the left as far as they let
        each other, again and again; then the square is cut to what is used. None where in none of them all find a
        place."""
        best, best_used = None, self._most + 1
        for layout in layouts:
            found = self.apart(layout)
            if found is not None:
                place, used = _tightened(*self._masks(layout), *found, self._most + 1)
                if used < best_used:
                    best_used, best = (
                        used,
                        [self._turned[i][1][at[0]] + xy for i, (at, xy) in enumerate(zip(layout, place, strict=True))],
                    )
        return best and ([uv / best_used for uv in best], self._cells / best_used)

    def _masks(self, layout: list) -> tuple[list[int], list[tuple[int, int]]]:
        """Cells of the charts as they are turned, and their sizes (h, w)."""
        return [self._bits[i, at[0]] for i, at in enumerate(layout)], [
            self._turned[i][0][at[0]].shape for i, at in enumerate(layout)
        ]


def _apart(
    own: list[int], size: list[tuple[int, int]], wanted: list[np.ndarray], most: int
) -> tuple[list[list[int]], int] | None:
    """Places [x, y] near the wanted ones for masks, as sets of bits, of sizes (h, w), apart from each other, and what
    they take."""
    taken, place = 0, [[0, 0]] * len(own)
    for i in sorted(range(len(own)), key=lambda k: -own[k].bit_count()):
        (h, w), (x, y) = size[i], np.clip(wanted[i], 0, np.maximum(most - np.array(size[i][::-1]), 0)).tolist()
        for dx, dy in _NEAR:
            if (
                0 <= x + dx <= most - w
                and 0 <= y + dy <= most - h
                and not taken >> (y + dy) * (most + 1) + x + dx & own[i]
            ):
                break
        else:
            return None
        place[i] = [x + dx, y + dy]
        taken |= own[i] << (y + dy) * (most + 1) + x + dx
    return place, taken


def _tightened(
    own: list[int], size: list[tuple[int, int]], place: list[list[int]], taken: int, stride: int
) -> tuple[list[list[int]], int]:
    """Places after all have moved up, then to the left, as far as they can, again and again, and the side of the square
    they use."""
    used = [max(max(x + w, y + h) for (x, y), (h, w) in zip(place, size, strict=True))]
    for turn in range(_ROUNDS):
        axis, still = 1 - turn % 2, True
        for i in sorted(range(len(own)), key=lambda k: place[k][axis]):
            x, y = place[i]
            others = taken ^ own[i] << y * stride + x
            step = 1 << 5
            while step:
                near = [x, y]
                near[axis] -= step
                if near[axis] >= 0 and not others >> near[1] * stride + near[0] & own[i]:
                    x, y = near
                    still = False
                else:
                    step //= 2
            place[i] = [x, y]
            taken = others | own[i] << y * stride + x
        used.append(max(max(x + w, y + h) for (x, y), (h, w) in zip(place, size, strict=True)))
        if still and turn or len(used) > 4 and used[-1] == used[-4]:
            break
    return place, used[-1]
