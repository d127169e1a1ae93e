"""Pack charts into the unit square: search for the order that gives the smallest square.

Charts are turned by quarters, but never mirrored.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from itertools import islice
from typing import NamedTuple

import numpy as np

from gdtool.unwrap.pack.bitmasks import ChartMasks, OrientedChart, Placement, orient_upright, outline_of
from gdtool.unwrap.pack.compact import ROUGH, FineGridCompactor

# (up to this many charts, cells along the square's side): the resolution at which orders are tried.
_COARSE_CELLS = ((48, 144), (160, 160), (4000, 320))
_DENSITY = 0.66  # share of a square of that many cells that the charts would fill
# Shares of a cell that a chart has to cover for the cell to count, tried in turn: the fine grid mostly finds room for
# the rest.
_CELL_SHARES = 0.2, 0.1
_MIN_FILLED = (0.45, 0.12)  # shares of the square that charts have to fill, at first and at the very least
_GROWTH = 0.02  # of its side, by which a square grows where a chart finds no room
_COMPACTED = 4  # layouts that are compacted on the fine grid
# Shares of the square that another way to cut has to gain, and more for each chart that it adds: seams cost that much.
_MIN_GAIN, _MIN_GAIN_PER_CHART = 0.006, 0.0012
WELL_PACKED = 0.67  # of the square, by a draft: charts that fill as much are not cut further
_MAX_STEP_GAIN = 0.09  # of the square, that cutting one step further mostly gains at most
# Charts placed while searching for better orders: for the result, and to compare ways to cut.
_MAX_PLACED, _MAX_PLACED_DRAFT = 3600, 150
_CHAINS = 4  # independent sequences of changes to an order
_MOVE_SIGMA = 0.25  # standard deviation of a chart's move in the order, in units of its length
_CACHE_AFTER = 20  # tries of a chain, from which on it pays to cache where two charts meet
_CONTACT_FACTORS = [0.6, 1.0, 1.0, 1.6]  # by which the weight of contact changes at random
_MIN_CONTACT, _MAX_CONTACT = 0.15, 2.0
_MAX_SEARCHED = 160  # charts for which orders are searched


class PlacementOrder(NamedTuple):
    """The order to place charts in, and the weight of contact between charts against a low place.

    contact: see ChartMasks.find_place.
    """

    order: list[int]
    contact: float


class Layout(NamedTuple):
    """Charts placed in a square of `side` cells: their placements, the order of placing, and the weight of contact."""

    side: int
    at: list[Placement]
    order: list[int]
    contact: float


class BestCut(NamedTuple):
    """The set of charts that packs best, of several that each cut the surface further.

    number: which of the sets, from 0 on. share: of the square that the set fills; 0 (with number 0) where no set could
    be packed. orders: the best orders to pack it in. skipped: the number of sets that were passed over.
    """

    number: int
    share: float
    orders: list[PlacementOrder]
    skipped: int


def choose_cut(variants: Iterable[list[tuple[np.ndarray, np.ndarray]]], gap: float) -> BestCut:
    """Choose the set of charts that packs best, by a short search for each.

    variants: sets of charts (uv, triangles) of one surface, each cut a step further than the one before. The first that
    fills WELL_PACKED of the square is taken. Where a set falls short of that by n times _MAX_STEP_GAIN, the next n sets
    are passed over. A later set is better only if it gains more than the seams it adds are worth.
    """
    best, best_count, skipped, skip = BestCut(0, 0.0, [], 0), 0, 0, 0
    known: dict[tuple[int, int], _KnownChart] = {}
    numbered = enumerate(variants)
    while ahead := list(islice(numbered, 1 + skip)):
        i, charts = ahead[-1]
        skipped, skip = skipped + len(ahead) - 1, 0
        if not 1 < len(charts) <= _MAX_SEARCHED:
            continue
        oriented, area = _orient_charts(charts, known)
        cells, masks, layouts = _draft_layouts(oriented, area, gap, _CELL_SHARES[0], [])
        layouts = _improve_layouts(masks, layouts, _MAX_PLACED_DRAFT, np.inf)
        share = _DENSITY * (cells / layouts[0].side) ** 2 if layouts else 0.0
        skip = int((WELL_PACKED - share) / _MAX_STEP_GAIN) if WELL_PACKED > share > 0 else 0
        needed = _MIN_GAIN + _MIN_GAIN_PER_CHART * (len(charts) - best_count) if best.share else 0.0
        if share > best.share + needed:
            orders = [PlacementOrder(layout.order, layout.contact) for layout in layouts[:2]]
            best, best_count = BestCut(i, share, orders, 0), len(charts)
        if best.share > WELL_PACKED:
            break
    return best._replace(skipped=skipped)


def pack(
    charts: list[tuple[np.ndarray, np.ndarray]],
    gap: float,
    orders: list[PlacementOrder] | None = None,
    until: float = np.inf,
) -> tuple[list[np.ndarray], float]:
    """Pack charts into the smallest square.

    charts: uv at the scale of the surface, and triangles. gap: smallest distance between charts, and half of it to the
    border, in uv. Orders and weights are tried on a coarse grid, and the best layouts are compacted on a fine one.
    orders: those of choose_cut(), to start from. until: when the search stops, on the clock time.monotonic. If it has
    found nothing by then, the charts are placed in rows. Returns the uv (v, 2) of each chart in [0, 1], v up, and their
    scale (uv per unit of surface).
    """
    if time.monotonic() > until:
        return _shelf_pack([uv - uv.min(0) for uv, _ in charts], gap)
    oriented, area = _orient_charts(charts)
    if len(charts) == 1:
        scale = (1 - 2 * gap) / max(float(np.ptp(oriented[0].uv, 0).max()), 1e-300)
        return [oriented[0].uv * scale + gap], scale
    if len(charts) > _COARSE_CELLS[-1][0]:
        return _shelf_pack([chart.uv for chart in oriented], gap)
    is_searched = len(charts) <= _MAX_SEARCHED
    for share in (*_CELL_SHARES, 0.0) if is_searched else (0.0,):
        start_orders = (orders or []) if share == _CELL_SHARES[0] else []
        cells, masks, layouts = _draft_layouts(oriented, area, gap, share, start_orders, until)
        cells_per_unit = cells * (_DENSITY / area) ** 0.5
        if layouts and is_searched:
            if share == _CELL_SHARES[0]:
                rough = FineGridCompactor(oriented, masks, cells_per_unit, [layouts[0].side], gap, ROUGH)
                if rough.separate(layouts[0].at) is None:
                    continue  # charts lie inside each other, as arcs of rings do
            layouts = _improve_layouts(masks, layouts, _MAX_PLACED, until)
            best = layouts[:_COMPACTED]
            sides = [layout.side for layout in best]
            packed = FineGridCompactor(oriented, masks, cells_per_unit, sides, gap).compact(
                [layout.at for layout in best]
            )
            if packed:
                return packed
        if layouts and not share:  # no chart is too near another as it is
            layout = layouts[0]
            uv = [(masks.uv[i][at.turn] + [at.x, at.y]) / layout.side for i, at in enumerate(layout.at)]
            return uv, cells_per_unit / layout.side
    return _shelf_pack([chart.uv for chart in oriented], gap)


class _KnownChart(NamedTuple):
    """An oriented chart, its area, and the uv and triangles it was made of.

    These are kept so that no other array gets their id(), which is the key of the cache.
    """

    source: tuple[np.ndarray, np.ndarray]
    chart: OrientedChart
    area: float


def _orient_charts(
    charts: list[tuple[np.ndarray, np.ndarray]], known: dict[tuple[int, int], _KnownChart] | None = None
) -> tuple[list[OrientedChart], float]:
    """Orient charts (uv, triangles) upright; return them with their total area.

    known: caches charts that occur again, by the ids of their arrays.
    """
    known, oriented = {} if known is None else known, []
    for uv, triangles in charts:
        key = id(uv), id(triangles)
        if key not in known:
            known[key] = _KnownChart((uv, triangles), *_oriented(uv, triangles))
        oriented.append(known[key])
    return [entry.chart for entry in oriented], max(sum(entry.area for entry in oriented), 1e-300)


def _oriented(uv: np.ndarray, triangles: np.ndarray) -> tuple[OrientedChart, float]:
    """Set a chart with triangles (t, 3) upright; return it and its area."""
    uv = orient_upright(uv)
    (a, b) = (uv[triangles[:, 1]] - uv[triangles[:, 0]]).T
    (c, d) = (uv[triangles[:, 2]] - uv[triangles[:, 0]]).T
    return OrientedChart(uv, outline_of(uv, triangles)), float(np.abs(a * d - b * c).sum()) / 2


def _draft_layouts(
    charts: list[OrientedChart],
    area: float,
    gap: float,
    share: float,
    orders: list[PlacementOrder],
    until: float = np.inf,
) -> tuple[int, ChartMasks | None, list[Layout]]:
    """Place the charts on a coarse grid in a few orders, or in the given orders.

    area: of all charts, in units of surface. gap: between charts, in uv. share: of a cell that a chart has to cover for
    the cell to count. Returns the cells along the side of a square that the charts fill to _DENSITY, their masks on
    that grid, and the layouts, best first.
    """
    cells = next(cells for most, cells in _COARSE_CELLS if len(charts) <= most)
    masks = None
    for least in _MIN_FILLED:
        most = int(cells * (_DENSITY / least) ** 0.5)
        masks = ChartMasks(charts, cells * (_DENSITY / area) ** 0.5, gap * (cells if share else most), most, share)
        layouts: list[Layout] = []
        for order in orders or _initial_orders(masks)[: 6 if len(charts) <= _MAX_SEARCHED else 1]:
            # Later orders have to do better, so their square does not grow; the first starts small.
            side, max_side = (layouts[0].side - 1,) * 2 if layouts else (int(0.9 * cells), most)
            layout = _place_in_order(masks, order, side, max_side, until)
            if layout is not None:
                layouts.insert(0, layout)
        if layouts:
            return cells, masks, layouts
    return cells, masks, []


def _improve_layouts(masks: ChartMasks, layouts: list[Layout], max_placed: int, until: float) -> list[Layout]:
    """Add better layouts, found by small changes of the best order; return all, best first.

    Several chains of changes are followed, because each soon ends where no small change helps. max_placed: charts
    placed in all.
    """
    if not layouts or max_placed < _CHAINS * len(layouts[0].order):
        return layouts
    tries = max_placed // len(layouts[0].order) // _CHAINS
    seeds = sorted(
        range(_CHAINS), key=lambda seed: seed % 2
    )  # where layouts are equally large, the first chain's is taken
    more = [layout for seed in seeds for layout in _improvement_chain(masks, layouts[0], tries, seed, until)]
    return sorted(layouts + more, key=lambda layout: layout.side)


def _improvement_chain(masks: ChartMasks, best: Layout, tries: int, seed: int, until: float) -> list[Layout]:
    """Find ever smaller layouts: move a few charts in the best order so far, and place all again.

    tries: the number of changed orders. until: when the search stops, on the clock time.monotonic.
    """
    rng, layouts = np.random.default_rng(seed), []  # fixed seeds: equal input gives equal output
    known: dict[tuple[int, float], dict] = {}
    for _ in range(tries):
        if time.monotonic() > until:
            break
        rank = np.argsort(best.order).astype(float)
        moved = rng.integers(len(rank), size=int(rng.integers(1, 4)))
        rank[moved] += rng.normal(0, _MOVE_SIGMA * len(rank), len(moved))
        contact = float(np.clip(best.contact * rng.choice(_CONTACT_FACTORS), _MIN_CONTACT, _MAX_CONTACT))
        layout = _place_in_order(
            masks,
            PlacementOrder(np.argsort(rank, kind="stable").tolist(), contact),
            best.side - 1,
            best.side - 1,
            until,
            known.setdefault((best.side, contact), {}),
            tries >= _CACHE_AFTER,
        )
        if layout is not None:
            best = layout
            layouts.append(layout)
    return layouts


def _place_in_order(
    masks: ChartMasks,
    order: PlacementOrder,
    side: int,
    max_side: int,
    until: float,
    known: dict | None = None,
    caches_meetings: bool = False,
) -> Layout | None:
    """Place charts one by one in a square of `side` cells, which grows up to max_side where a chart finds no room.

    known: {chart: (its placement, known of the charts placed after it)}, kept between orders for one side and weight of
    contact. caches_meetings: whether charts are placed so often that it pays to cache where two of them overlap.
    Returns None where the square would grow too large, or the time is over.
    """
    taken, at = 0, [Placement(0, 0, 0)] * len(order.order)
    others: list[tuple[int, Placement]] = []
    border, after = masks.border(side), {} if known is None else known
    for i in order.order:
        neighbours = others if caches_meetings else None
        if i not in after:
            after[i] = masks.find_place(i, taken, border, side, order.contact, neighbours), {}
        place, after = after[i]
        while place is None:
            side += max(int(_GROWTH * side), 1)
            if side > max_side:
                return None
            border = masks.border(side)
            place = masks.find_place(i, taken, border, side, order.contact, neighbours)
        if time.monotonic() > until:
            return None
        at[i] = place
        others.append((i, place))
        taken |= masks.cells_at(i, place)
    used = max(masks.extent_at(i, place) for i, place in enumerate(at))
    return Layout(used, at, order.order, order.contact)


def _initial_orders(masks: ChartMasks) -> list[PlacementOrder]:
    """Make orders to place the charts in, largest first by area and by side, with several weights of contact."""
    shape = np.array([of_turn[0] for of_turn in masks.shapes])
    return [
        PlacementOrder(np.argsort(-rank, kind="stable").tolist(), contact)
        for contact in (0.5, 1.0, 0.3)
        for rank in (shape.prod(1), shape.max(1))
    ]


def _shelf_pack(charts: list[np.ndarray], gap: float) -> tuple[list[np.ndarray], float]:
    """Place the bounding rectangles of charts in rows; return the charts' uv (v, 2), from the origin on.

    This serves any number of charts.
    """
    span = np.array([uv.max(0) for uv in charts])
    order = np.argsort(-span[:, 1], kind="stable")
    gap = min(gap, 0.2 / len(charts) ** 0.5)
    scale = (1.0 / max(float((span[:, 0] * span[:, 1]).sum()), 1e-300)) ** 0.5
    while True:
        x = y = row = 0.0
        out: list[np.ndarray | None] = [None] * len(charts)
        for i in order.tolist():
            w, h = span[i] * scale + gap
            if x + w > 1:
                x, y, row = 0.0, y + row, 0.0
            if x + w > 1 or y + h > 1:
                break
            out[i] = charts[i] * scale + np.array([x, y]) + gap / 2
            x, row = x + w, max(row, h)
        else:
            return out, scale
        scale *= 0.95
