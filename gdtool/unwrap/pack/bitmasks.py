"""Charts as sets of cells of a square, at each quarter turn, and where in the square one finds room."""

from __future__ import annotations

import numpy as np

_FINE = 3  # cells of the supersampled mask in a cell of the square
_LOOK = 12  # runs of a chart between two looks whether any place is left


def upright_box(uv: np.ndarray) -> np.ndarray:
    """uv (v, 2) turned so that its bounding rectangle is smallest, longer side along u, and moved to the origin."""
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
    turned = uv @ np.array([[c[best], -s[best]], [s[best], c[best]]])
    if spans[0][best] < spans[1][best]:
        turned = np.stack([-turned[:, 1], turned[:, 0]], -1)
    return turned - turned.min(0)


def _mask(rim: np.ndarray, span: np.ndarray, cells_per_unit: float, gap: float, share: float) -> np.ndarray:
    """(h, w) bool: cells of which more than a share lies within `gap` cells of the chart in [0, span] with the outline
    rim (s, 2, 2), whose corner lies at cell (gap, gap). Supersampled; with a share of 0 no cell that the chart comes so
    near is missed."""
    shape = np.ceil(span * cells_per_unit + 2 * gap).astype(int)
    width, height = shape * _FINE
    outline = (rim * cells_per_unit + gap) * _FINE
    covered = _filled(outline, height, width)
    # Tips thinner than a fine cell lie between its centres: the rim, walked along in half cells, finds them.
    column, row = np.minimum(_walked(outline).astype(int), (width - 1, height - 1)).T
    covered[row, column] = True
    # Grown by a disk, row by row. Half a diagonal more: what is covered between the fine cells' centres.
    radius = gap * _FINE + (0.0 if share else 0.75)
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


def _filled(outline: np.ndarray, height: int, width: int) -> np.ndarray:
    """(height, width) bool: cells whose centre lies within closed outlines (s, 2, 2), in cells, by the even-odd
    rule."""
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


def _walked(outline: np.ndarray) -> np.ndarray:
    """Points (n, 2) along segments (s, 2, 2), at most half a unit apart."""
    one, two = outline[:, 0], outline[:, 1]
    steps = np.ceil(2 * np.abs(two - one).max(1)).astype(int) + 1
    along = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(steps, steps)
    return np.repeat(one, steps, 0) + along[:, None] * np.repeat(two - one, steps, 0)


def rim_of(uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(s, 2, 2) the segments of a chart's outline: uv of the edges that one triangle has."""
    following = triangles[:, [1, 2, 0]]
    key = np.sort(
        (np.minimum(triangles, following).astype(np.int64) * len(uv) + np.maximum(triangles, following)).ravel()
    )
    once = np.ones(len(key) + 1, bool)
    once[1:-1] = key[1:] != key[:-1]
    return uv[np.stack(np.divmod(key[once[1:] & once[:-1]], len(uv)), -1)]


def turned(
    rim: np.ndarray, uv: np.ndarray, cells_per_unit: float, gap: float, share: float = 0.0
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A chart's mask with half the gap around it at each quarter turn, and its uv (v, 2) in cells of that mask."""
    mask = _mask(rim, uv.max(0), cells_per_unit, gap / 2, share)
    h, w = mask.shape
    at = uv * cells_per_unit + gap / 2
    # As np.rot90 turns the mask: its rows are v, its columns u.
    u, v = at.T
    return (
        [np.rot90(mask, quarter) for quarter in range(4)],
        [at, np.stack([v, w - u], -1), np.stack([w - u, h - v], -1), np.stack([h - v, u], -1)],
    )


class Shapes:
    """Charts as masks at one resolution, at each quarter turn, as sets of bits to test places with.

    cells_per_unit: cells per unit of surface; gap: cells between charts; side: the largest square they are packed in.
    A set of cells is one integer, the cell (x, y) its bit y * (side + 1) + x: shifting moves it, and all places of a
    chart are tested by one shift per run of its cells, or per chart that is placed.
    """

    def __init__(self, boxed: list, cells_per_unit: float, gap: float, side: int, share: float = 0.0):
        self.stride, self.uv, self.shapes, self.runs, self.bits, self._rim, self._turns = (
            side + 1,
            [],
            [],
            [],
            [],
            [],
            [],
        )
        self._windows: dict[int, tuple[dict, dict]] = {}
        self._meetings: dict[int, int] = {}
        for uv, rim in boxed:
            masks, at = turned(rim, uv, cells_per_unit, gap, share)
            self.uv.append(at)
            self.shapes.append([mask.shape for mask in masks])
            small = max(masks[0].shape) <= side  # placed() passes over the others
            # Of turns 0 and 2 and of 1 and 3 one is the other half a turn on.
            pairs = [_runs(mask, self.stride) if small else ([], []) for mask in masks[:2]]
            self.runs.append([pairs[turn % 2][turn // 2] for turn in range(4)])
            self.bits.append([bits_of(mask, self.stride) if small else 0 for mask in masks])
            seen = list(zip(self.bits[-1], self.shapes[-1], strict=True))
            # Turned onto itself a chart finds what it found.
            self._turns.append([turn for turn in range(4) if seen[turn] not in seen[:turn]])
            own = self.bits[-1][0]
            within = own & own << 1 & own >> 1 & own << self.stride & own >> self.stride
            self._rim.append(own.bit_count() - within.bit_count())  # cells that can touch others

    def border(self, side: int) -> int:
        """The cells along the border of a square of `side` cells."""
        return (
            (1 << side) - 1
            | ((1 << side) - 1) << (side - 1) * self.stride
            | _every(1 | 1 << side - 1, side, self.stride)
        )

    def placed(
        self,
        i: int,
        taken: int,
        border: int,
        side: int,
        contact: float,
        others: list[tuple[int, tuple[int, int, int]]] | None = None,
    ) -> tuple[int, int, int] | None:
        """(turn, x, y) of chart i in a square of `side` cells beside the cells taken, or None where there is no room.

        It goes where it stays low; contact weighs touching others and the walls, border(side), against that. others:
        the charts that take these cells, and where: quicker where the same few charts are placed over and over, as what
        they leave free of each other is kept."""
        stride = self.stride
        walls = taken << 1 | taken >> 1 | taken << stride | taken >> stride | border
        windows = {}, {}
        best = None
        for turn in self._turns[i]:
            h, w = self.shapes[i][turn]
            if max(h, w) > side:
                continue
            if others is None:
                free = _free(self.runs[i][turn], (h, w), taken, windows, side, stride)
            else:
                free = _every((1 << side - w + 1) - 1, side - h + 1, stride)
                free = (free | (hit := self._hit(i, turn, others))) ^ hit
            # Only where it is stopped above and to the left, or above and to the right.
            blocked = free << stride | free << 1 & free >> 1
            corners = (free | blocked) ^ blocked
            most = min(contact, contact * self._rim[i] / (2 * (h + w)))
            if best is not None:  # no farther down than it could still be better
                corners &= (1 << max(int((best[0] + most) * side - h - 0.25 * w) + 1, 0) * stride) - 1
            if not corners:
                continue
            places = _places(corners)
            y, x = np.divmod(places, stride)
            far = (y + h + 0.25 * (x + w)) / side
            own = self.bits[i][turn]
            for k in np.argsort(far, kind="stable").tolist():
                if best is not None and far[k] - most >= best[0] - 1e-9:
                    break
                cost = float(far[k]) - contact * (walls >> int(places[k]) & own).bit_count() / (2 * (h + w))
                if best is None or cost < best[0] - 1e-9:
                    best = cost, turn, int(x[k]), int(y[k])
        return best and best[1:]

    def _hit(self, i: int, turn: int, others: list[tuple[int, tuple[int, int, int]]]) -> int:
        """The places where chart i at this turn meets one of the others, each at (turn, x, y)."""
        h, w = self.shapes[i][turn]
        hit, last, stride, meetings = 0, (h - 1) * self.stride + w - 1, self.stride, self._meetings
        # Where it meets a cell are its own cells mirrored there: as it is half a turn on, its last cell where its first
        # was.
        own = 4 * i + (turn ^ 2)
        first = 4 * len(self.bits) * own
        for j, (other_turn, x, y) in others:
            key = first + 4 * j + other_turn
            meeting = meetings.get(key)
            if meeting is None:
                meeting = meetings[key] = self._sum(own, 4 * j + other_turn)
            shift = y * stride + x - last
            hit |= meeting << shift if shift >= 0 else meeting >> -shift
        return hit

    def _sum(self, one: int, two: int) -> int:
        """The Minkowski sum of two charts' cells, each given as 4 i + turn. Rows longer than the stride go on in the
        next: what comes there does so from left of the square, and no chart whose first cell is there would end within
        it."""
        if len(self.runs[one // 4][one % 4]) > len(self.runs[two // 4][two % 4]):
            one, two = two, one
        windows, cells, out = self._windows.setdefault(two, ({}, {})), self.bits[two // 4][two % 4], 0
        for axis, level, a, b in self.runs[one // 4][one % 4]:
            window = windows[axis].get(level)
            if window is None:
                window = _window(cells, windows[axis], level, self.stride if axis else 1)
            out |= window << a
            if b > a:
                out |= window << b
        return out

    def cells(self, i: int, at: tuple[int, int, int]) -> int:
        """What chart i takes at (turn, x, y)."""
        turn, x, y = at
        return self.bits[i][turn] << y * self.stride + x

    def reach(self, i: int, at: tuple[int, int, int]) -> int:
        """How large a square has to be for chart i at (turn, x, y)."""
        (h, w), (_, x, y) = self.shapes[i][at[0]], at
        return max(x + w, y + h)


def _free(
    runs: list[tuple[int, int, int, int]],
    size: tuple[int, int],
    taken: int,
    windows: tuple[dict, dict],
    side: int,
    stride: int,
) -> int:
    """The places in a square of `side` cells where a chart of size (h, w) that has these runs is clear of what is
    taken.

    windows: by level k the cells from which on 2**k cells of the row, and of the column, have any taken; those that are
    missing are added."""
    free, hit = _every((1 << side - size[1] + 1) - 1, side - size[0] + 1, stride), 0
    for number, (axis, level, one, two) in enumerate(runs, 1):
        window = windows[axis].get(level)
        if window is None:
            window = _window(taken, windows[axis], level, -stride if axis else -1)
        hit |= window >> one
        if two > one:
            hit |= window >> two
        if number % _LOOK == 0 and not (free | hit) ^ hit:
            break
    return (free | hit) ^ hit


def _window(cells: int, known: dict[int, int], level: int, step: int) -> int:
    """Cells spread over 2**level places, `step` bits apart; known: those of lower levels, to which it is added."""
    if level not in known:
        if not level:
            known[level] = cells
        else:
            less, far = _window(cells, known, level - 1, step), step << level - 1
            known[level] = less | (less << far if far > 0 else less >> -far)
    return known[level]


def _every(row: int, count: int, stride: int) -> int:
    """The bits of one row repeated in `count` rows."""
    out, have = row, 1
    while have < count:
        more = min(have, count - have)
        out |= (out & (1 << more * stride) - 1) << have * stride
        have += more
    return out


def bits_of(mask: np.ndarray, stride: int) -> int:
    """A mask (h, w) bool as one integer, rows `stride` bits apart."""
    rows = np.zeros((mask.shape[0], stride), bool)
    rows[:, : mask.shape[1]] = mask
    return int.from_bytes(np.packbits(rows, bitorder="little").tobytes(), "little")


def _places(bits: int) -> np.ndarray:
    """The numbers of the bits that are set."""
    return np.flatnonzero(
        np.unpackbits(
            np.frombuffer(bits.to_bytes(bits.bit_length() // 8 + 1, "little"), np.uint8), bitorder="little"
        ).view(bool)
    )


def _runs(mask: np.ndarray, stride: int) -> tuple[list, list]:
    """Runs of cells in the rows of mask (h, w), or the columns where these are fewer, the longest first, as it is and
    half a turn on: (axis, level, one, two) of each, 2**level cells from one and from two cover it, axis 1 is down a
    column."""
    axis = int(mask.shape[0] > mask.shape[1])
    lines = mask.T if axis else mask
    along, across = (stride, 1) if axis else (1, stride)
    padded = np.zeros((lines.shape[0], lines.shape[1] + 2), np.int8)
    padded[:, 1:-1] = lines
    step = np.diff(padded, axis=1)
    line, start = np.nonzero(step > 0)
    length = np.nonzero(step < 0)[1] - start
    order = np.argsort(-length, kind="stable")
    length, one = length[order], (line * across + start * along)[order]
    level = np.frexp(length)[1] - 1
    rest, last = (length - (1 << level)) * along, (mask.shape[0] - 1) * stride + mask.shape[1] - 1
    levels, axes = level.tolist(), [axis] * len(level)
    return tuple(
        list(zip(axes, levels, first.tolist(), (first + rest).tolist(), strict=True))
        for first in (one, last - one - (length - 1) * along)
    )
