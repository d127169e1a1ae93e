"""Represent charts as bit masks on a grid, at each quarter turn, and find free places for them in a square."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

_FINE = 3  # supersampling: fine cells along the side of a cell
_FINE_HALF_DIAGONAL = 0.75  # fine cells, rounded up: what is covered between the centres of fine cells
_CHECK_EVERY = 12  # runs of a chart between two checks whether any place is left
_RIGHTWARD_COST = 0.25  # cost of a cell to the right, in units of a cell up


class OrientedChart(NamedTuple):
    """A chart to pack: uv (v, 2) upright from the origin on, and its outline (s, 2, 2)."""

    uv: np.ndarray
    outline: np.ndarray


class Placement(NamedTuple):
    """The place of a chart: its number of quarter turns, and the cell of its mask's corner."""

    turn: int
    x: int
    y: int


class Run(NamedTuple):
    """A run of 2**level or more cells in a row (axis 0) or a column (axis 1) of a mask.

    It is covered by 2**level cells from `first` on and as many from `second` on, which may overlap.
    """

    axis: int
    level: int
    first: int
    second: int


def orient_upright(uv: np.ndarray) -> np.ndarray:
    """Rotate uv (v, 2) so that its bounding rectangle is smallest, longer side along u, and move it to the origin."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = uv[ConvexHull(uv).vertices]
    except (QhullError, ValueError):
        hull = uv
    edge = np.roll(hull, -1, 0) - hull
    angles = np.unique(np.round(np.arctan2(edge[:, 1], edge[:, 0]) % (np.pi / 2), 4))
    c, s = np.cos(angles), np.sin(angles)
    spans = np.ptp(hull @ np.stack([c, s]), 0), np.ptp(hull @ np.stack([-s, c]), 0)
    best = int(np.argmin(spans[0] * spans[1]))
    rotated = uv @ np.array([[c[best], -s[best]], [s[best], c[best]]])
    if spans[0][best] < spans[1][best]:
        rotated = np.stack([-rotated[:, 1], rotated[:, 0]], -1)
    return rotated - rotated.min(0)


def _mask(rim: np.ndarray, span: np.ndarray, cells_per_unit: float, gap: float, share: float) -> np.ndarray:
    """Rasterise a chart grown by `gap` cells: (h, w) bool, the cells of which more than a share is covered.

    rim (s, 2, 2): segments of the chart's outline, in [0, span]; (0, 0) goes to the corner of cell (gap, gap). Cells
    are supersampled. With a share of 0 no cell within `gap` of the chart is missed.
    """
    shape = np.ceil(span * cells_per_unit + 2 * gap).astype(int)
    width, height = shape * _FINE
    outline = (rim * cells_per_unit + gap) * _FINE
    covered = _fill_outline(outline, height, width)
    # Tips thinner than a fine cell lie between cell centres: samples along the outline, half a cell apart, find them.
    column, row = np.minimum(_sample_segments(outline).astype(int), (width - 1, height - 1)).T
    covered[row, column] = True
    # Grow by a disk, row by row.
    radius = gap * _FINE + (0.0 if share else _FINE_HALF_DIAGONAL)
    reach = int(radius)
    before = np.zeros((height, width + 2 * reach + 1), np.int32)
    np.cumsum(covered, 1, out=before[:, reach + 1 : reach + 1 + width])
    before[:, reach + 1 + width :] = before[:, reach + width : reach + width + 1]
    out = np.zeros((height, width), bool)
    for dy in range(-reach, reach + 1):
        dx = int((radius**2 - dy**2) ** 0.5)
        row = before[:, reach + 1 + dx : reach + 1 + dx + width] > before[:, reach - dx : reach - dx + width]
        out[max(dy, 0) : height + min(dy, 0)] |= row[max(-dy, 0) : height - max(dy, 0)]
    cells = out.reshape(shape[1], _FINE, shape[0], _FINE)
    return cells.sum((1, 3)) > share * _FINE**2 if share else cells.any((1, 3))


def _fill_outline(outline: np.ndarray, height: int, width: int) -> np.ndarray:
    """Fill closed outlines (s, 2, 2), in cells, by the even-odd rule: (height, width) bool for cell centres."""
    (xa, ya), (xb, yb) = outline[:, 0].T, outline[:, 1].T
    low = np.ceil(np.minimum(ya, yb) - 0.5).astype(int)
    count = np.ceil(np.maximum(ya, yb) - 0.5).astype(int) - low
    each = np.repeat(np.arange(len(outline)), count)
    row = low[each] + np.arange(len(each)) - np.repeat(np.cumsum(count) - count, count)
    x = xa[each] + (row + 0.5 - ya[each]) / (yb - ya)[each] * (xb - xa)[each]
    column = np.clip(np.ceil(x - 0.5).astype(int), 0, width)
    crossed = (
        np.bincount(row * (width + 1) + column, minlength=height * (width + 1))
        .astype(np.uint8)
        .reshape(height, width + 1)
    )
    return (np.cumsum(crossed[:, :-1], 1, dtype=np.uint8) & 1).view(bool)


def _sample_segments(outline: np.ndarray) -> np.ndarray:
    """Sample points (n, 2) along segments (s, 2, 2), at most half a unit apart."""
    starts, ends = outline[:, 0], outline[:, 1]
    steps = np.ceil(2 * np.abs(ends - starts).max(1)).astype(int) + 1
    along = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(steps, steps)
    return np.repeat(starts, steps, 0) + along[:, None] * np.repeat(ends - starts, steps, 0)


def outline_of(uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Find the outline (s, 2, 2) of a chart: the uv of the edges that belong to one triangle only."""
    following = triangles[:, [1, 2, 0]]
    key = np.sort(
        (np.minimum(triangles, following).astype(np.int64) * len(uv) + np.maximum(triangles, following)).ravel()
    )
    once = np.ones(len(key) + 1, bool)
    once[1:-1] = key[1:] != key[:-1]
    return uv[np.stack(np.divmod(key[once[1:] & once[:-1]], len(uv)), -1)]


def rotated_masks(
    rim: np.ndarray, uv: np.ndarray, cells_per_unit: float, gap: float, share: float = 0.0
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rasterise a chart, with half the gap around it, at each quarter turn.

    rim (s, 2, 2): the chart's outline. Returns the four masks, and for each of them the chart's uv (v, 2) in its cells.
    """
    mask = _mask(rim, uv.max(0), cells_per_unit, gap / 2, share)
    h, w = mask.shape
    at = uv * cells_per_unit + gap / 2
    # The same rotation as np.rot90 does for the mask, whose rows are v and columns u.
    u, v = at.T
    return (
        [np.rot90(mask, quarter) for quarter in range(4)],
        [at, np.stack([v, w - u], -1), np.stack([w - u, h - v], -1), np.stack([h - v, u], -1)],
    )


class ChartMasks:
    """Masks of all charts at one resolution and at each quarter turn, stored as integers of bits.

    The cell (x, y) is bit y * (side + 1) + x, so that shifting an integer moves the chart. All places of a chart are
    tested by one shift per run of its cells, or per chart already placed. charts: oriented charts; cells_per_unit:
    cells per unit of surface; gap: cells between charts; side: of the largest square to pack into, in cells; share: of
    a cell that has to be covered, see _mask().
    """

    def __init__(self, charts: list[OrientedChart], cells_per_unit: float, gap: float, side: int, share: float = 0.0):
        self.stride = side + 1
        # For each chart and quarter turn: uv in cells, mask shape (h, w), runs, and the mask as bits.
        self.uv: list[list[np.ndarray]] = []
        self.shapes: list[list[tuple[int, int]]] = []
        self.runs: list[list[list[Run]]] = []
        self.bits: list[list[int]] = []
        self._rim: list[int] = []  # cells of each chart that can touch others
        self._turns: list[list[int]] = []  # the quarter turns of each chart that look different
        self._windows: dict[int, tuple[dict, dict]] = {}
        self._meetings: dict[int, int] = {}
        for uv, rim in charts:
            masks, at = rotated_masks(rim, uv, cells_per_unit, gap, share)
            self.uv.append(at)
            self.shapes.append([mask.shape for mask in masks])
            small = max(masks[0].shape) <= side  # find_place() passes over the others
            # Turns 0 and 2, and 1 and 3, are half a turn apart.
            pairs = [_runs(mask, self.stride) if small else ([], []) for mask in masks[:2]]
            self.runs.append([pairs[turn % 2][turn // 2] for turn in range(4)])
            self.bits.append([bits_of(mask, self.stride) if small else 0 for mask in masks])
            seen = list(zip(self.bits[-1], self.shapes[-1], strict=True))
            # A turn that maps the chart onto itself would find the same places.
            self._turns.append([turn for turn in range(4) if seen[turn] not in seen[:turn]])
            cells = self.bits[-1][0]
            inner = cells & cells << 1 & cells >> 1 & cells << self.stride & cells >> self.stride
            self._rim.append(cells.bit_count() - inner.bit_count())

    def border(self, side: int) -> int:
        """Return the cells along the border of a square of `side` cells, as bits."""
        return (
            (1 << side) - 1
            | ((1 << side) - 1) << (side - 1) * self.stride
            | _repeat_row(1 | 1 << side - 1, side, self.stride)
        )

    def find_place(
        self,
        i: int,
        taken: int,
        border: int,
        side: int,
        contact: float,
        others: list[tuple[int, Placement]] | None = None,
    ) -> Placement | None:
        """Find the best free place of chart i in a square of `side` cells, None where there is none.

        taken: the occupied cells, as bits. The best place is low; `contact` weighs how much the chart touches others
        and the walls, border(side), against that. others: the charts that occupy these cells and their placements. They
        make the test quicker where the same few charts are placed over and over, because the places that one chart
        blocks for another are cached.
        """
        stride = self.stride
        touching = taken << 1 | taken >> 1 | taken << stride | taken >> stride | border
        windows: tuple[dict[int, int], dict[int, int]] = {}, {}
        best = None
        for turn in self._turns[i]:
            h, w = self.shapes[i][turn]
            if max(h, w) > side:
                continue
            if others is None:
                free = _free_places(self.runs[i][turn], (h, w), taken, windows, side, stride)
            else:
                free = _repeat_row((1 << side - w + 1) - 1, side - h + 1, stride)
                free = (free | (hit := self._blocked_places(i, turn, others))) ^ hit
            # Only corners: places blocked above and to the left, or above and to the right.
            blocked = free << stride | free << 1 & free >> 1
            corners = (free | blocked) ^ blocked
            most = min(contact, contact * self._rim[i] / (2 * (h + w)))
            if best is not None:  # no farther down than could still be better
                corners &= (1 << max(int((best[0] + most) * side - h - _RIGHTWARD_COST * w) + 1, 0) * stride) - 1
            if not corners:
                continue
            places = _set_bits(corners)
            y, x = np.divmod(places, stride)
            height_cost = (y + h + _RIGHTWARD_COST * (x + w)) / side
            mask_bits = self.bits[i][turn]
            for k in np.argsort(height_cost, kind="stable").tolist():
                if best is not None and height_cost[k] - most >= best[0] - 1e-9:
                    break
                cost = float(height_cost[k]) - contact * (touching >> int(places[k]) & mask_bits).bit_count() / (
                    2 * (h + w)
                )
                if best is None or cost < best[0] - 1e-9:
                    best = cost, turn, int(x[k]), int(y[k])
        return best and Placement(*best[1:])

    def _blocked_places(self, i: int, turn: int, others: list[tuple[int, Placement]]) -> int:
        """Return the places where chart i at this turn overlaps one of the others, as bits."""
        h, w = self.shapes[i][turn]
        hit, last, stride, meetings = 0, (h - 1) * self.stride + w - 1, self.stride, self._meetings
        # The places where it meets a cell are its cells mirrored there: its half turn, last cell in place of the first.
        half_turn = 4 * i + (turn ^ 2)
        first = 4 * len(self.bits) * half_turn
        for j, (other_turn, x, y) in others:
            key = first + 4 * j + other_turn
            meeting = meetings.get(key)
            if meeting is None:
                meeting = meetings[key] = self._minkowski_sum(half_turn, 4 * j + other_turn)
            shift = y * stride + x - last
            hit |= meeting << shift if shift >= 0 else meeting >> -shift
        return hit

    def _minkowski_sum(self, first: int, second: int) -> int:
        """Compute the Minkowski sum of two charts' cells, as bits; each chart is given as 4 i + turn.

        Rows longer than the stride continue in the next row. The cells that come to lie there are left of the square,
        where no chart that fits into the square has its first cell.
        """
        if len(self.runs[first // 4][first % 4]) > len(self.runs[second // 4][second % 4]):
            first, second = second, first
        windows, cells, out = self._windows.setdefault(second, ({}, {})), self.bits[second // 4][second % 4], 0
        for axis, level, a, b in self.runs[first // 4][first % 4]:
            window = windows[axis].get(level)
            if window is None:
                window = _spread_bits(cells, windows[axis], level, self.stride if axis else 1)
            out |= window << a
            if b > a:
                out |= window << b
        return out

    def cells_at(self, i: int, at: Placement) -> int:
        """Return the cells that chart i takes at a placement, as bits."""
        turn, x, y = at
        return self.bits[i][turn] << y * self.stride + x

    def extent_at(self, i: int, at: Placement) -> int:
        """Compute the side in cells of the smallest square that holds chart i at a placement."""
        (h, w), (_, x, y) = self.shapes[i][at[0]], at
        return max(x + w, y + h)


def _free_places(
    runs: list[Run],
    size: tuple[int, int],
    taken: int,
    windows: tuple[dict, dict],
    side: int,
    stride: int,
) -> int:
    """Return the places in a square of `side` cells where a chart is clear of the taken cells, as bits.

    runs and size (h, w) of the chart. windows: a cache for rows and for columns. By level k it holds the cells from
    which on at least one of 2**k cells is taken.
    """
    free, hit = _repeat_row((1 << side - size[1] + 1) - 1, side - size[0] + 1, stride), 0
    for number, (axis, level, first_start, second_start) in enumerate(runs, 1):
        window = windows[axis].get(level)
        if window is None:
            window = _spread_bits(taken, windows[axis], level, -stride if axis else -1)
        hit |= window >> first_start
        if second_start > first_start:
            hit |= window >> second_start
        if number % _CHECK_EVERY == 0 and not (free | hit) ^ hit:
            break
    return (free | hit) ^ hit


def _spread_bits(cells: int, known: dict[int, int], level: int, step: int) -> int:
    """Set the bits of `cells` at 2**level places, `step` bits apart; `known` caches lower levels."""
    if level not in known:
        if not level:
            known[level] = cells
        else:
            less, far = _spread_bits(cells, known, level - 1, step), step << level - 1
            known[level] = less | (less << far if far > 0 else less >> -far)
    return known[level]


def _repeat_row(row: int, count: int, stride: int) -> int:
    """Repeat the bits of one row in `count` rows."""
    out, have = row, 1
    while have < count:
        more = min(have, count - have)
        out |= (out & (1 << more * stride) - 1) << have * stride
        have += more
    return out


def bits_of(mask: np.ndarray, stride: int) -> int:
    """Pack a mask (h, w) bool into one integer, rows `stride` bits apart."""
    rows = np.zeros((mask.shape[0], stride), bool)
    rows[:, : mask.shape[1]] = mask
    return int.from_bytes(np.packbits(rows, bitorder="little").tobytes(), "little")


def _set_bits(bits: int) -> np.ndarray:
    """List the numbers of the bits that are set."""
    return np.flatnonzero(
        np.unpackbits(
            np.frombuffer(bits.to_bytes(bits.bit_length() // 8 + 1, "little"), np.uint8), bitorder="little"
        ).view(bool)
    )


def _runs(mask: np.ndarray, stride: int) -> tuple[list[Run], list[Run]]:
    """Find the runs of cells in a mask (h, w), longest first, for the mask and for its half turn.

    Runs go along rows, or along columns where these are fewer.
    """
    axis = int(mask.shape[0] > mask.shape[1])
    lines = mask.T if axis else mask
    along, across = (stride, 1) if axis else (1, stride)
    padded = np.zeros((lines.shape[0], lines.shape[1] + 2), np.int8)
    padded[:, 1:-1] = lines
    step = np.diff(padded, axis=1)
    line, start = np.nonzero(step > 0)
    length = np.nonzero(step < 0)[1] - start
    order = np.argsort(-length, kind="stable")
    length, start = length[order], (line * across + start * along)[order]
    level = np.frexp(length)[1] - 1
    rest, last = (length - (1 << level)) * along, (mask.shape[0] - 1) * stride + mask.shape[1] - 1
    levels, axes = level.tolist(), [axis] * len(level)
    return tuple(
        list(map(Run._make, zip(axes, levels, first.tolist(), (first + rest).tolist(), strict=True)))
        for first in (start, last - start - (length - 1) * along)
    )
