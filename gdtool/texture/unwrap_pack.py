"""Charts into the unit square: each where it makes the filled part grow least, by raster, turned but never mirrored."""

from __future__ import annotations

import time

import numpy as np

from gdtool.geometry.repair import edges_of
from gdtool.texture.raster import owner_count

_FINE = 3  # cells of the supersampled mask in a cell of the square
_COARSE, _COARSE_OF_MANY = 200, 100  # cells of the square's side in which orders are tried
_FINER, _SETTLED, _ROUNDS = 4, 3, 12  # cells of the fine grid in one of the coarse; layouts that are tightened, by so many rounds
_NEAR = sorted(((dx, dy) for dx in range(-3, 4) for dy in range(-3, 4)), key=lambda d: d[0] ** 2 + d[1] ** 2)
_DENSITY = 0.66  # share of a square of so many cells that the charts would fill
_MOST_BY_SEARCH, _MOST_BY_RASTER = 160, 4000  # charts for which orders are searched, and that go by raster at all
_CLOSE = 0.01  # of the side, to which the square of so many is found
_MANY = 48  # with more charts than these a coarser grid bounds the time
_GAIN, _GAIN_PER_CHART = 0.015, 0.001
WELL_PACKED = 0.64  # of the square, by a draft: charts that fill as much stay as they are
_TRIES = 1000  # charts placed in search of better orders
_LEAST = 0.3  # share of the square that a way to cut has to fill
_FINALISTS, _NEAR_BEST = 2, 1.06  # orders by which ways to cut are told apart, where the square's side comes so near to the best


def upright_box(uv: np.ndarray) -> np.ndarray:
    """uv (v, 2) turned so that its bounding rectangle is smallest, longer side along u, and moved to the origin."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = uv[ConvexHull(uv).vertices]
    except (QhullError, ValueError):
        hull = uv
    edge = np.roll(hull, -1, 0) - hull
    angles = np.unique(np.round(np.arctan2(edge[:, 1], edge[:, 0]) % (np.pi / 2), 4))
    best, turned = np.inf, uv
    for angle in angles.tolist():
        c, s = np.cos(angle), np.sin(angle)
        span = np.ptp(hull @ np.array([[c, -s], [s, c]]), 0)
        if span[0] * span[1] < best * (1 - 1e-9):
            best, turned = span[0] * span[1], uv @ np.array([[c, -s], [s, c]])
    if np.ptp(turned[:, 0]) < np.ptp(turned[:, 1]):
        turned = _turn(turned, 1)
    return turned - turned.min(0)


def _turn(uv: np.ndarray, quarter: int) -> np.ndarray:
    for _ in range(quarter % 4):
        uv = np.stack([-uv[:, 1], uv[:, 0]], -1)
    return uv - uv.min(0)


def _mask(uv: np.ndarray, triangles: np.ndarray, cells_per_unit: float, gap: float) -> np.ndarray:
    """(h, w) bool: cells within `gap` cells of the chart, whose corner lies at cell (gap, gap). Supersampled."""
    span = np.ceil(uv.max(0) * cells_per_unit + 2 * gap).astype(int)
    size = int(span.max())
    width, height = span * _FINE
    covered = owner_count((uv * cells_per_unit + gap) / size, triangles, size * _FINE)[:height, :width] > 0
    # Tips thinner than a fine cell lie between its centres: the rim, walked along in half cells, finds them.
    column, row = np.minimum((_walked((uv * cells_per_unit + gap) * _FINE, triangles)).astype(int), (width - 1, height - 1)).T
    covered[row, column] = True
    # Grown by a disk, row by row. Half a diagonal more: what is covered between the fine cells' centres.
    radius = gap * _FINE + 0.75
    reach = int(radius)
    before = np.zeros((height, width + 2 * reach + 1), np.int32)
    before[:, reach + 1:reach + 1 + width] = np.cumsum(covered, 1)
    before[:, reach + 1 + width:] = before[:, reach + width:reach + width + 1]
    out = np.zeros((height, width), bool)
    for dy in range(-reach, reach + 1):
        dx = int((radius**2 - dy**2) ** 0.5)
        row = before[:, reach + 1 + dx:reach + 1 + dx + width] > before[:, reach - dx:reach - dx + width]
        out[max(dy, 0):height + min(dy, 0)] |= row[max(-dy, 0):height - max(dy, 0)]
    return out.reshape(span[1], _FINE, span[0], _FINE).any((1, 3))


def _walked(uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Points (n, 2) along a chart's rim, at most half a unit apart."""
    edges = edges_of(triangles)
    one, two = uv[edges.ends[edges.count == 1].T]
    steps = np.ceil(2 * np.abs(two - one).max(1)).astype(int) + 1
    along = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps)) / np.repeat(steps, steps)
    return np.repeat(one, steps, 0) + along[:, None] * np.repeat(two - one, steps, 0)


def _turned(uv: np.ndarray, triangles: np.ndarray, cells_per_unit: float, gap: float) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A chart's mask with half the gap around it at each quarter turn, and its uv (v, 2) in cells of that mask."""
    mask = _mask(uv, triangles, cells_per_unit, gap / 2)
    h, w = mask.shape
    at = uv * cells_per_unit + gap / 2
    # As np.rot90 turns the mask: its rows are v, its columns u.
    u, v = at.T
    return ([np.rot90(mask, quarter) for quarter in range(4)],
            [at, np.stack([v, w - u], -1), np.stack([w - u, h - v], -1), np.stack([h - v, u], -1)])


class _Shapes:
    """Charts as masks at one resolution, at each quarter turn, as sets of bits to test places with.

    cells_per_unit: cells per unit of surface; gap: cells between charts; side: the largest square they are packed in; until: when, on the
    clock time.monotonic, no place is found any more.
    A set of cells is one integer, the cell (x, y) its bit y * (side + 1) + x: shifting moves it, and all places of a
    chart are tested by one shift per run of its cells.
    """

    def __init__(self, boxed: list, cells_per_unit: float, gap: float, side: int, until: float = np.inf):
        self.until = until
        self.stride, self.uv, self.shapes, self.runs, self.bits = side + 1, [], [], [], []
        for uv, triangles in boxed:
            masks, at = _turned(uv, triangles, cells_per_unit, gap)
            self.uv.append(at)
            self.shapes.append([turned.shape for turned in masks])
            small = max(masks[0].shape) <= side  # place() passes over the others
            self.runs.append([_runs(turned, self.stride) if small else [] for turned in masks])
            self.bits.append([_bits(turned, self.stride) if small else 0 for turned in masks])

    def place(self, order: list[int], side: int, contact: float) -> list[tuple[int, int, int]] | None:
        """(turn, x, y) of each chart in a square of so many cells, or None when one finds no place.

        Each goes where it stays low; contact weighs touching others and the walls against that.
        """
        stride, taken = self.stride, 0
        out: list[tuple[int, int, int] | None] = [None] * len(order)
        line = (1 << side) - 1
        border = line | line << (side - 1) * stride | _every(1 | 1 << side - 1, side, stride)
        for i in order:
            if time.monotonic() > self.until:
                return None
            walls = taken << 1 | taken >> 1 | taken << stride | taken >> stride | border
            windows = [taken]  # of level k: from here on 2**k cells of the row, any taken
            best = None
            for turn in range(4):
                h, w = self.shapes[i][turn]
                if max(h, w) > side:
                    continue
                hit = 0
                for level, one, two in self.runs[i][turn]:
                    while len(windows) <= level:
                        windows.append(windows[-1] | windows[-1] >> (1 << len(windows) - 1))
                    hit |= windows[level] >> one
                    if two > one:
                        hit |= windows[level] >> two
                free = _every((1 << side - w + 1) - 1, side - h + 1, stride) & ~hit
                # Only where it is stopped above and to the left, or above and to the right.
                corners = free & ~(free << stride) & ~(free << 1 & free >> 1)
                if not corners:
                    continue
                places = _places(corners)
                y, x = np.divmod(places, stride)
                far = (y + h + 0.25 * (x + w)) / side
                most = contact * self.bits[i][turn].bit_count() / (2 * (h + w))
                for k in np.argsort(far, kind="stable").tolist():
                    if best is not None and far[k] - min(contact, most) >= best[0] - 1e-9:
                        break
                    touching = (self.bits[i][turn] << int(places[k]) & walls).bit_count()
                    cost = float(far[k]) - contact * touching / (2 * (h + w))
                    if best is None or cost < best[0] - 1e-9:
                        best = cost, turn, int(x[k]), int(y[k])
            if best is None:
                return None
            _, turn, x, y = best
            taken |= self.bits[i][turn] << y * stride + x
            out[i] = turn, x, y
        return out


def _every(row: int, count: int, stride: int) -> int:
    """The bits of one row repeated in `count` rows."""
    out, have = row, 1
    while have < count:
        more = min(have, count - have)
        out |= (out & (1 << more * stride) - 1) << have * stride
        have += more
    return out


def _bits(mask: np.ndarray, stride: int) -> int:
    """A mask (h, w) bool as one integer, rows `stride` bits apart."""
    rows = np.zeros((mask.shape[0], stride), bool)
    rows[:, :mask.shape[1]] = mask
    return int.from_bytes(np.packbits(rows, bitorder="little").tobytes(), "little")


def _places(bits: int) -> np.ndarray:
    """The numbers of the bits that are set."""
    return np.flatnonzero(np.unpackbits(np.frombuffer(bits.to_bytes(bits.bit_length() // 8 + 1, "little"), np.uint8), bitorder="little"))


def _runs(mask: np.ndarray, stride: int) -> list[tuple[int, int, int]]:
    """(level, one, two) of each run of cells in the rows of mask (h, w): 2**level cells from one and from two cover it."""
    padded = np.zeros((mask.shape[0], mask.shape[1] + 2), np.int8)
    padded[:, 1:-1] = mask
    step = np.diff(padded, axis=1)
    row, start = np.nonzero(step > 0)
    length = np.nonzero(step < 0)[1] - start
    level = np.frexp(length)[1] - 1
    one = row * stride + start
    return list(zip(level.tolist(), one.tolist(), (one + length - (1 << level)).tolist(), strict=True))


def best_packed(variants: list[list[tuple[np.ndarray, np.ndarray]]], gap: float) -> tuple[int, float, list[tuple[list[int], float]]]:
    """Which of several ways to cut one surface into charts packs best, by a short search, the share of the square that it
    fills (0, 0 where none can be told), and the orders and weights of contact to pack it in.

    The first that fills WELL_PACKED of the square will do. Else each later one has to gain more than the seams it adds are
    worth, _GAIN of the square and _GAIN_PER_CHART for each chart.
    """
    best, best_side, best_share, best_ways = 0, 0, 0.0, []
    for i, charts in enumerate(variants):
        if not 1 < len(charts) <= _MOST_BY_SEARCH:
            continue
        boxed, area = _boxed(charts)
        ranked = _search(boxed, area, gap, _COARSE_OF_MANY, 0, _LEAST)
        # So coarse a grid takes more room the more charts there are: what comes near is told apart on the finer one.
        if not ranked or best_side and ranked[0][0] > _NEAR_BEST * best_side:
            continue
        side, ways = ranked[0][0], [(order, contact) for _, order, contact, _ in ranked[:_FINALISTS]]
        ranked = _search(boxed, area, gap, _COARSE, 0, _LEAST, ways)
        share = _DENSITY * (_COARSE / ranked[0][0]) ** 2 if ranked else 0.0
        more = len(charts) - len(variants[best])
        if share > best_share + (_GAIN + _GAIN_PER_CHART * more if best_share else 0.0):
            best, best_side, best_share, best_ways = i, side, share, ways
        if best_share > WELL_PACKED:
            break
    return best, best_share, best_ways


def _boxed(charts: list) -> tuple[list, float]:
    """Charts set upright, and their area."""
    boxed = [(upright_box(uv), triangles) for uv, triangles in charts]
    area = sum(float(np.abs(np.cross(uv[t[:, 1]] - uv[t[:, 0]], uv[t[:, 2]] - uv[t[:, 0]])).sum()) / 2 for uv, t in boxed)
    return boxed, max(area, 1e-300)


def pack(charts: list[tuple[np.ndarray, np.ndarray]], gap: float, ways: list[tuple[list[int], float]] | None = None,
         until: float = np.inf) -> tuple[list[np.ndarray], float]:
    """Places for charts: their uv (v, 2) in [0, 1], v up, all at one scale, and that scale (uv per unit of surface).

    charts: uv at the scale of the surface and triangles of each. gap: smallest distance between charts, and half of it
    to the border, in uv. Several orders and weights are tried on a coarse grid, the best of them tightened on a fine one; the
    charts keep their resolution, what is sought is the smallest square that holds them. ways: best_packed's, to start from. until: when to seek no longer, on the clock
    time.monotonic; where nothing is found by then the charts stand in rows.
    """
    if time.monotonic() > until:
        return _shelves([(uv - uv.min(0), triangles) for uv, triangles in charts], gap)
    boxed, area = _boxed(charts)
    if len(charts) == 1:
        scale = (1 - 2 * gap) / max(float(np.ptp(boxed[0][0], 0).max()), 1e-300)
        return [boxed[0][0] * scale + gap], scale
    if len(charts) > _MOST_BY_RASTER:
        return _shelves(boxed, gap)
    coarse = _COARSE_OF_MANY if _MANY < len(charts) <= _MOST_BY_SEARCH else _COARSE
    tries = max(_TRIES // len(charts), 8)
    if len(charts) > _MOST_BY_SEARCH:
        ranked = _bisected(boxed, area, gap, coarse, until=until)
    else:
        ranked = next(filter(None, (_search(boxed, area, gap, coarse, tried, lowest, ways, until)
                                    for lowest, tried in ((0.45, tries), (0.3, tries), (0.12, 0)))), [])
    if not ranked:
        return _shelves(boxed, gap)
    best, best_scale, cells = None, 0.0, (_DENSITY / area) ** 0.5 * coarse
    most = _FINER * max(side for side, *_ in ranked[:_SETTLED])
    fine = [_turned(uv, triangles, _FINER * cells, gap * most) for uv, triangles in boxed]
    for side, _, _, layout in ranked[:_SETTLED]:
        places, scale = _settled(boxed, cells, side, layout, fine, most)
        if scale > best_scale:
            best, best_scale = places, scale
    return best, best_scale


def _settled(boxed: list, cells_per_unit: float, side: int, layout: list[tuple[int, np.ndarray]], fine: list,
             most: int) -> tuple[list[np.ndarray], float]:
    """A layout of a coarse grid (turn, and where its first vertex is, of each chart) tightened on a grid _FINER times as fine:
    every chart goes up and to the left as far as the others let it, again and again, then the square is cut to what is
    used. As pack() returns it. fine: the charts _turned() on that grid, for a square of at most so many of its cells."""
    stride = most + 1
    bits, shapes, uvs, place = [], [], [], []
    taken = 0
    for (masks, at), (turn, first) in zip(fine, layout, strict=True):
        own, (h, w) = _bits(masks[turn], stride), masks[turn].shape
        x, y = np.rint(first * _FINER - at[turn][0]).astype(int).tolist()
        # Rounded to cells it may touch another or the square's border: then it stands beside.
        for dx, dy in _NEAR:
            if 0 <= x + dx <= most - w and 0 <= y + dy <= most - h and not own << (y + dy) * stride + x + dx & taken:
                break
        else:
            laid = [_turned(uv, triangles, cells_per_unit, 0)[1][turn] for (uv, triangles), (turn, _) in zip(boxed, layout, strict=True)]
            return [(uv - uv[0] + first) / side for uv, (_, first) in zip(laid, layout, strict=True)], cells_per_unit / side
        place.append([x + dx, y + dy])
        taken |= own << (y + dy) * stride + x + dx
        bits.append(own)
        shapes.append((h, w))
        uvs.append(at[turn])
    for turn in range(_ROUNDS):
        axis, still = 1 - turn % 2, True
        for i in sorted(range(len(bits)), key=lambda k: place[k][axis]):
            x, y = place[i]
            others = taken ^ bits[i] << y * stride + x
            step = 1 << 5
            while step:
                near = [x, y]
                near[axis] -= step
                if near[axis] >= 0 and not bits[i] << near[1] * stride + near[0] & others:
                    x, y = near
                    still = False
                else:
                    step //= 2
            place[i] = [x, y]
            taken = others | bits[i] << y * stride + x
        if still and turn:
            break
    used = max(max(x + w, y + h) for (x, y), (h, w) in zip(place, shapes, strict=True))
    return [(uv + at) / used for uv, at in zip(uvs, place, strict=True)], cells_per_unit * _FINER / used


def _first_ways(boxed: list) -> list[tuple[list[int], float]]:
    """Orders to place the charts in, largest first, each with a weight of contact against height."""
    size = [float(np.prod(np.ptp(uv, 0) + 1e-12)) for uv, _ in boxed]
    longest = [float(np.ptp(uv, 0).max()) for uv, _ in boxed]
    return [(np.argsort(-np.array(rank), kind="stable").tolist(), contact) for contact in (0.5, 1.0, 0.3) for rank in (size, longest)]


def _search(boxed: list, area: float, gap: float, cells: int, tries: int, lowest: float,
            ways: list[tuple[list[int], float]] | None = None, until: float = np.inf) -> list[tuple[int, list[int], float, list]]:
    """Ways to pack on a coarse grid, best first: side of the square, order, weight of contact, turn and place (x, y) of the first
    vertex of each chart, in cells.

    None that stays below the share `lowest`. From the best of a few orders on (ways, with their weights of contact), small
    changes of the best are tried.
    """
    side_most = int(cells * (_DENSITY / lowest) ** 0.5)
    shapes = _Shapes(boxed, cells * (_DENSITY / area) ** 0.5, gap * side_most, side_most, until)
    ranked: list[tuple[int, list[int], float, list]] = []

    def shrunk(order: list[int], contact: float, side: int, found: list) -> None:
        step = max(int(0.03 * cells), 2)
        while step:
            smaller = shapes.place(order, side - step, contact)
            if smaller is None:
                step //= 2
            else:
                side, found = side - step, smaller
        ranked.append((side, order, contact, found))
        ranked.sort(key=lambda way: way[0])

    for turn, (order, contact) in enumerate(ways or _first_ways(boxed)):
        if turn == 2 and not ranked:
            return []  # ill-shaped charts: the others would not do either
        side, found = (int(0.9 * cells), None) if not ranked else (ranked[0][0] - 1, None)
        while found is None and side <= (side_most if not ranked else ranked[0][0]):
            found = shapes.place(order, side, contact)
            side += 0 if found is not None else max(int((0.04 if lowest > 0.2 else 0.12) * cells), 1)
        if found is not None:
            shrunk(order, contact, side, found)
    if not ranked:
        return []
    rng = np.random.default_rng(0)  # the same for each mesh: results do not depend on chance
    for _ in range(tries):
        if time.monotonic() > until:
            break
        side, order, contact, _ = ranked[0]
        order = list(order)
        for _ in range(int(rng.integers(1, 4))):
            one, two = int(rng.integers(len(order))), int(rng.integers(len(order)))
            order.insert(two, order.pop(one))
        contact = float(np.clip(contact * rng.choice([0.6, 1.0, 1.0, 1.6]), 0.15, 2.0))
        found = shapes.place(order, side - 1, contact)
        if found is not None:
            shrunk(order, contact, side - 1, found)
    return [(side, order, contact, [(turn, shapes.uv[i][turn][0] + [x, y]) for i, (turn, x, y) in enumerate(found)])
            for side, order, contact, found in ranked]


def _bisected(boxed: list, area: float, gap: float, cells: int, lowest: float = 0.25, highest: float = 0.8,
              until: float = np.inf) -> list[tuple[int, list[int], float, list]]:
    """As _search(), of one order only, the largest first, in squares that are filled to a share between lowest and highest."""
    least, most = (int(cells * (_DENSITY / share) ** 0.5) for share in (highest, lowest))
    shapes = _Shapes(boxed, cells * (_DENSITY / area) ** 0.5, gap * most, most, until)
    (order, contact), layout = _first_ways(boxed)[0], None
    while layout is None or most - least > _CLOSE * cells:
        side = (least + most) // 2
        found = shapes.place(order, side, contact)
        if found is not None:
            most, layout = side, found
        elif side < most:
            least = side + 1
        else:
            return []
    return [(most, order, contact, [(turn, shapes.uv[i][turn][0] + [x, y]) for i, (turn, x, y) in enumerate(layout)])]


def _shelves(boxed: list, gap: float) -> tuple[list[np.ndarray], float]:
    """Rows of bounding rectangles, for any number of charts."""
    span = np.array([np.ptp(uv, 0) for uv, _ in boxed])
    order = np.argsort(-span[:, 1], kind="stable")
    gap = min(gap, 0.2 / len(boxed) ** 0.5)
    scale = (1.0 / max(float((span[:, 0] * span[:, 1]).sum()), 1e-300)) ** 0.5
    while True:
        x = y = row = 0.0
        out: list[np.ndarray | None] = [None] * len(boxed)
        for i in order.tolist():
            w, h = span[i] * scale + gap
            if x + w > 1:
                x, y, row = 0.0, y + row, 0.0
            if x + w > 1 or y + h > 1:
                break
            out[i] = boxed[i][0] * scale + np.array([x, y]) + gap / 2
            x, row = x + w, max(row, h)
        else:
            return out, scale
        scale *= 0.95
