"""Charts into the unit square: each where it makes the filled part grow least, by raster, turned but never mirrored."""

from __future__ import annotations

import time
from collections.abc import Iterable
from itertools import islice
from typing import NamedTuple

import numpy as np

from gdtool.unwrap.pack.bitmasks import Shapes, rim_of, upright_box
from gdtool.unwrap.pack.compact import ROUGH, Fine

# For up to so many charts: cells of the square's side in which orders are tried.
_COARSE = ((48, 144), (160, 160), (4000, 320))
_DENSITY = 0.66  # share of a square of so many cells that the charts would fill
# Of a cell, that a chart has to take of it for the cell to count as its own: on the fine grid the rest finds room,
# mostly; else the next.
_OWN = 0.2, 0.1
_LEAST = (0.45, 0.12)  # shares of the square that charts have to fill, first and at the very least
_GROWS = 0.02  # of its side, that a square grows by where a chart finds no room
_SETTLED = 4  # layouts that are tightened
_GAIN, _GAIN_PER_CHART = 0.006, 0.0012
WELL_PACKED = 0.67  # of the square, by a draft: charts that fill as much stay as they are
_NEXT_GAINS = 0.09  # of the square, that cutting one step further gains at most, mostly
_TRIES, _TRIES_OF_DRAFT = 3600, 150  # charts placed in search of better orders, at last and to tell ways to cut apart
_CHAINS = 4  # of changes of orders
_MOVES = 0.25  # by which some charts change their place in the order, typically, in units of its length
_OFTEN = 20  # tries of a chain, from which on it is kept where two charts meet
_MOST_BY_SEARCH = 160  # charts for which orders are searched


class Layout(NamedTuple):
    """Charts in a square of `side` cells: (turn, x, y) of each, the order they were placed in, the weight of
    contact."""

    side: int
    at: list[tuple[int, int, int]]
    order: list[int]
    contact: float


def best_packed(
    variants: Iterable[list[tuple[np.ndarray, np.ndarray]]], gap: float
) -> tuple[int, float, list[tuple[list[int], float]], int]:
    """Which of several ways to cut one surface into charts packs best, by a short search, the share of the square that
    it fills (0, 0 where none can be told), the orders and weights of contact to pack it in, and how many ways it leapt
    over.

    variants: each cut a step further than the one before. The first that fills WELL_PACKED of the square will do, and
    where one lacks several times _NEXT_GAINS of that, the next ones are leapt over. Else each later one has to gain
    more than the seams it adds are worth, _GAIN of the square and _GAIN_PER_CHART for each chart."""
    best, best_share, best_count, best_ways, leapt, leap = 0, 0.0, 0, [], 0, 0
    known: dict[tuple[int, int], list] = {}
    numbered = enumerate(variants)
    while ahead := list(islice(numbered, 1 + leap)):
        i, charts = ahead[-1]
        leapt, leap = leapt + len(ahead) - 1, 0
        if not 1 < len(charts) <= _MOST_BY_SEARCH:
            continue
        boxed, area = _boxed(charts, known)
        cells, shapes, found = _drafted(boxed, area, gap, _OWN[0], [])
        found = _improved(shapes, found, _TRIES_OF_DRAFT, np.inf)
        share = _DENSITY * (cells / found[0].side) ** 2 if found else 0.0
        leap = int((WELL_PACKED - share) / _NEXT_GAINS) if WELL_PACKED > share > 0 else 0
        if share > best_share + (_GAIN + _GAIN_PER_CHART * (len(charts) - best_count) if best_share else 0.0):
            best, best_share, best_count, best_ways = (
                i,
                share,
                len(charts),
                [(layout.order, layout.contact) for layout in found[:2]],
            )
        if best_share > WELL_PACKED:
            break
    return best, best_share, best_ways, leapt


def pack(
    charts: list[tuple[np.ndarray, np.ndarray]],
    gap: float,
    ways: list[tuple[list[int], float]] | None = None,
    until: float = np.inf,
) -> tuple[list[np.ndarray], float]:
    """Places for charts: their uv (v, 2) in [0, 1], v up, all at one scale, and that scale (uv per unit of surface).

    charts: uv at the scale of the surface and triangles of each. gap: smallest distance between charts, and half of it
    to the border, in uv. Several orders and weights are tried on a coarse grid, the best of them tightened on a fine
    one; the charts keep their resolution, what is sought is the smallest square that holds them. ways: best_packed's,
    to start from. until: when to seek no longer, on the clock time.monotonic; where nothing is found by then the charts
    stand in rows."""
    if time.monotonic() > until:
        return _shelves([uv - uv.min(0) for uv, _ in charts], gap)
    boxed, area = _boxed(charts)
    if len(charts) == 1:
        scale = (1 - 2 * gap) / max(float(np.ptp(boxed[0][0], 0).max()), 1e-300)
        return [boxed[0][0] * scale + gap], scale
    if len(charts) > _COARSE[-1][0]:
        return _shelves([uv for uv, _ in boxed], gap)
    searched = len(charts) <= _MOST_BY_SEARCH
    for share in (*_OWN, 0.0) if searched else (0.0,):
        cells, shapes, found = _drafted(boxed, area, gap, share, (ways or []) if share == _OWN[0] else [], until)
        cells_per_unit = cells * (_DENSITY / area) ** 0.5
        if found and searched:
            if (
                share == _OWN[0]
                and Fine(boxed, shapes, cells_per_unit, [found[0].side], gap, ROUGH).apart(found[0].at) is None
            ):
                continue  # one in the other, as arcs of rings are
            found = _improved(shapes, found, _TRIES, until)
            best = found[:_SETTLED]
            packed = Fine(boxed, shapes, cells_per_unit, [one.side for one in best], gap).settled(
                [one.at for one in best]
            )
            if packed:
                return packed
        if found and not share:  # nowhere too near another as it is
            return [
                (shapes.uv[i][turn] + [x, y]) / found[0].side for i, (turn, x, y) in enumerate(found[0].at)
            ], cells_per_unit / found[0].side
    return _shelves([uv for uv, _ in boxed], gap)


def _boxed(charts: list, known: dict[tuple[int, int], list] | None = None) -> tuple[list, float]:
    """Charts set upright, with their outlines, and their area. known: of charts that come again, by the ids of their
    arrays."""
    known, found = {} if known is None else known, []
    for chart in charts:
        one = known.setdefault((id(chart[0]), id(chart[1])), [chart])
        if len(one) == 1:
            one += _upright(*chart)
        found.append(one)
    return [(uv, rim) for _, uv, rim, _ in found], max(sum(area for *_, area in found), 1e-300)


def _upright(uv: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """A chart, triangles (t, 3), set upright, its outline and its area."""
    uv = upright_box(uv)
    (a, b), (c, d) = (uv[t[:, 1]] - uv[t[:, 0]]).T, (uv[t[:, 2]] - uv[t[:, 0]]).T
    return uv, rim_of(uv, t), float(np.abs(a * d - b * c).sum()) / 2


def _drafted(
    boxed: list, area: float, gap: float, share: float, ways: list[tuple[list[int], float]], until: float = np.inf
) -> tuple[int, Shapes | None, list[Layout]]:
    """Cells of the side of a square that the charts fill to _DENSITY, the charts on that grid, and layouts of them,
    best first: of a few orders, or of ways, orders with their weights of contact."""
    cells = next(cells for most, cells in _COARSE if len(boxed) <= most)
    shapes = None
    for least in _LEAST:
        most = int(cells * (_DENSITY / least) ** 0.5)
        shapes = Shapes(boxed, cells * (_DENSITY / area) ** 0.5, gap * (cells if share else most), most, share)
        found: list[Layout] = []
        for order, contact in ways or _first_ways(shapes)[: 6 if len(boxed) <= _MOST_BY_SEARCH else 1]:
            # Later ones have to do better, and the first has no room to grow beyond what it is asked for.
            side, largest = (found[0].side - 1,) * 2 if found else (int(0.9 * cells), most)
            layout = _placed(shapes, order, side, largest, contact, until)
            if layout is not None:
                found.insert(0, layout)
        if found:
            return cells, shapes, found
    return cells, shapes, []


def _improved(shapes: Shapes, found: list[Layout], tries: int, until: float) -> list[Layout]:
    """The layouts, and better ones, best first: of small changes of the best order, in several chains: each soon ends
    where no small change helps. tries: charts placed."""
    if not found or tries < _CHAINS * len(found[0].order):
        return found
    each = tries // len(found[0].order) // _CHAINS
    numbers = sorted(range(_CHAINS), key=lambda number: number % 2)  # of layouts of one size the first chain's is taken
    more = [layout for number in numbers for layout in _chain(shapes, found[0], each, number, until)]
    return sorted(found + more, key=lambda layout: layout.side)


def _chain(shapes: Shapes, best: Layout, tries: int, number: int, until: float) -> list[Layout]:
    """Ever smaller layouts, found by changing the place of a few charts in the order of the best so far, again and
    again."""
    rng, found = np.random.default_rng(number), []  # the same for each mesh: results do not depend on chance
    known: dict[tuple[int, float], dict] = {}
    for _ in range(tries):
        if time.monotonic() > until:
            break
        place = np.argsort(best.order).astype(float)
        moved = rng.integers(len(place), size=int(rng.integers(1, 4)))
        place[moved] += rng.normal(0, _MOVES * len(place), len(moved))
        contact = float(np.clip(best.contact * rng.choice([0.6, 1.0, 1.0, 1.6]), 0.15, 2.0))
        layout = _placed(
            shapes,
            np.argsort(place, kind="stable").tolist(),
            best.side - 1,
            best.side - 1,
            contact,
            until,
            known.setdefault((best.side, contact), {}),
            tries >= _OFTEN,
        )
        if layout is not None:
            best = layout
            found.append(layout)
    return found


def _placed(
    shapes: Shapes,
    order: list[int],
    side: int,
    most: int,
    contact: float,
    until: float,
    known: dict | None = None,
    often: bool = False,
) -> Layout | None:
    """Charts placed one by one in a square of `side` cells, which grows up to `most` where one finds no room; None
    where that is not enough, or the time is over. known: {chart: (its place, known of those placed behind it)}, kept
    between orders for one side and contact; often: these charts are placed so often that it is worth keeping where two
    of them meet."""
    taken, at, others = 0, [(0, 0, 0)] * len(order), []
    border, after = shapes.border(side), {} if known is None else known
    for i in order:
        if i not in after:
            after[i] = shapes.placed(i, taken, border, side, contact, others if often else None), {}
        place, after = after[i]
        while place is None:
            side += max(int(_GROWS * side), 1)
            if side > most:
                return None
            border = shapes.border(side)
            place = shapes.placed(i, taken, border, side, contact, others if often else None)
        if time.monotonic() > until:
            return None
        at[i] = place
        others.append((i, place))
        taken |= shapes.cells(i, place)
    return Layout(max(shapes.reach(i, place) for i, place in enumerate(at)), at, order, contact)


def _first_ways(shapes: Shapes) -> list[tuple[list[int], float]]:
    """Orders to place the charts in, largest first, each with a weight of contact against height."""
    shape = np.array([of_turn[0] for of_turn in shapes.shapes])
    return [
        (np.argsort(-rank, kind="stable").tolist(), contact)
        for contact in (0.5, 1.0, 0.3)
        for rank in (shape.prod(1), shape.max(1))
    ]


def _shelves(boxed: list[np.ndarray], gap: float) -> tuple[list[np.ndarray], float]:
    """Rows of bounding rectangles, for any number of charts, uv (v, 2) from the origin on."""
    span = np.array([uv.max(0) for uv in boxed])
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
            out[i] = boxed[i] * scale + np.array([x, y]) + gap / 2
            x, row = x + w, max(row, h)
        else:
            return out, scale
        scale *= 0.95
