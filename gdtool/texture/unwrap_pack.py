"""Charts into the unit square: each where it makes the filled part grow least, by raster, turned but never mirrored."""

from __future__ import annotations

import numpy as np

from gdtool.texture.raster import owner_count

_SLANTS = (0.0,)  # radians, besides quarter turns
_FINE = 3  # cells of the supersampled mask in a cell of the square
_MOST_BY_RASTER = 160
_MANY = 48  # with more charts than these a coarser grid and fewer tries bound the time
_STARTS = 12  # orders tried on the coarse grid


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


def _turned(uv: np.ndarray, radians: float) -> np.ndarray:
    if not radians:
        return uv
    c, s = np.cos(radians), np.sin(radians)
    uv = uv @ np.array([[c, -s], [s, c]])
    return uv - uv.min(0)


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


class _Shapes:
    """Charts as masks at one resolution, at each turn, with the spectra that correlate them with what is taken.

    cells_per_unit: cells per unit of surface; gap: cells between charts; side: the largest square they are packed in.
    """

    def __init__(self, boxed: list, cells_per_unit: float, gap: float, side: int):
        from scipy.fft import next_fast_len, rfft2

        self.fft_side = next_fast_len(side + 1, real=True)
        self.uv, self.masks, self.spectra = [], [], []
        for uv, triangles in boxed:
            upright = [_turned(uv, turn) for turn in _SLANTS]
            upright = [(at, _mask(at, triangles, cells_per_unit, gap / 2)) for at in upright]
            uvs, masks = [], []
            for at, mask in upright:
                h, w = mask.shape
                at = at * cells_per_unit + gap / 2
                # As np.rot90 turns the mask: its rows are v, its columns u.
                u, v = at.T
                uvs += [at, np.stack([v, w - u], -1), np.stack([w - u, h - v], -1), np.stack([h - v, u], -1)]
                masks += [np.rot90(mask, quarter) for quarter in range(4)]
            padded = np.zeros((len(masks), self.fft_side, self.fft_side), np.float32)
            for at, mask in zip(padded, masks, strict=True):
                if max(mask.shape) <= side:  # place() passes over the others
                    at[:mask.shape[0], :mask.shape[1]] = mask
            self.uv.append(uvs)
            self.masks.append(masks)
            self.spectra.append(np.conj(rfft2(padded, workers=2)))

    def place(self, order: list[int], side: int, contact: float, turns: list[int] | None = None) -> list[tuple[int, int, int]] | None:
        """(turn, x, y) of each chart in a square of so many cells, or None when one finds no place.

        Each goes where it stays low; contact weighs touching others and the walls against that. turns: the only one
        to try for each chart.
        """
        from scipy.fft import irfft2, rfft2

        m = self.fft_side
        taken = np.zeros((m, m), np.float32)
        out: list[tuple[int, int, int] | None] = [None] * len(order)
        both = np.zeros((2, m, m), np.float32)
        for i in order:
            walls = np.pad(taken[:side, :side], 1, constant_values=1) > 0
            both[0] = taken
            both[1, :side, :side] = walls[:-2, 1:-1] | walls[2:, 1:-1] | walls[1:-1, :-2] | walls[1:-1, 2:]
            spectrum = rfft2(both, workers=2)
            # Circular correlation: what wraps around lies beyond the places where the mask fits.
            tried = range(len(self.masks[i])) if turns is None else [turns[i]]
            found = irfft2(spectrum[:, None] * self.spectra[i][tried], (m, m), workers=2)
            best = None
            for at, turn in enumerate(tried):
                mask = self.masks[i][turn]
                h, w = mask.shape
                if max(h, w) > side:
                    continue
                free = found[0, at, :side - h + 1, :side - w + 1] < 0.5
                if not free.any():
                    continue
                touching = np.rint(found[1, at, :side - h + 1, :side - w + 1])
                far = (np.arange(side - h + 1)[:, None] + h + 0.25 * (np.arange(side - w + 1) + w)) / side
                cost = np.where(free, far - contact * touching / (2 * (h + w)), np.inf)
                k = int(cost.argmin())
                if best is None or cost.flat[k] < best[0] - 1e-9:
                    y, x = divmod(k, cost.shape[1])
                    best = float(cost.flat[k]), turn, x, y
            if best is None:
                return None
            _, turn, x, y = best
            mask = self.masks[i][turn]
            taken[y:y + mask.shape[0], x:x + mask.shape[1]] += mask
            out[i] = turn, x, y
        return out


def pack(charts: list[tuple[np.ndarray, np.ndarray]], gap: float, cells: int = 512) -> tuple[list[np.ndarray], float]:
    """Places for charts: their uv (v, 2) in [0, 1], v up, all at one scale, and that scale (uv per unit of surface).

    charts: uv at the scale of the surface and triangles of each. gap: smallest distance between charts, and half of it
    to the border, in uv. Several orders and weights are tried on a coarse grid, the best of them on a fine one; the
    charts keep their resolution, what is sought is the smallest square that holds them.
    """
    boxed = [(upright_box(uv), triangles) for uv, triangles in charts]
    area = sum(float(np.abs(np.cross(uv[t[:, 1]] - uv[t[:, 0]], uv[t[:, 2]] - uv[t[:, 0]])).sum()) / 2 for uv, t in boxed)
    area = max(area, 1e-300)
    if len(charts) == 1:
        scale = (1 - 2 * gap) / max(float(np.ptp(boxed[0][0], 0).max()), 1e-300)
        return [boxed[0][0] * scale + gap], scale
    if len(charts) > _MOST_BY_RASTER:
        return _shelves(boxed, gap)
    many = len(charts) > _MANY
    cells = min(cells, 288) if many else cells
    ways = _way(boxed, max(min(_STARTS, 300 // len(charts)), 2))
    for lowest, tried in ((0.45, ways), (0.15, ways[:3])):
        ranked = _search(boxed, area, gap, tried, cells * 5 // 16, lowest)
        if ranked:
            break
    else:
        return _shelves(boxed, gap)
    share = ranked[0][0]
    # At this resolution the square that the coarse grid found has `cells` cells a side.
    side_most = int(cells * 1.06)
    shapes = _Shapes(boxed, cells * (share / area) ** 0.5, gap * side_most, side_most)
    best, best_side = None, side_most + 1
    for _, order, contact, turns in ranked[:2 if many else 4]:
        side = min(best_side - 1, side_most) if best is not None else int(cells * 0.98)
        failed = 0
        while side <= side_most and side < best_side:
            found = shapes.place(order, side, contact, turns)
            if found is not None:
                best, best_side, side = found, side, side - max(cells // 128, 1)
                if failed:
                    break
            elif best is not None:
                break
            else:
                failed += 1
                side += max(cells // 100, 1)
    if best is None:
        return _shelves(boxed, gap)
    places = [(shapes.uv[i][turn] + [x, y]) / best_side for i, (turn, x, y) in enumerate(best)]
    return places, (share / area) ** 0.5 * cells / best_side


def _way(boxed: list, starts: int) -> list[tuple[list[int], float]]:
    """Orders to place the charts in, largest first and shuffled near that, each with a weight of contact against height."""
    rng = np.random.default_rng(0)  # the same for each mesh: results do not depend on chance
    size = np.array([float(np.prod(np.ptp(uv, 0) + 1e-12)) for uv, _ in boxed])
    longest = np.array([float(np.ptp(uv, 0).max()) for uv, _ in boxed])
    out = []
    for i in range(starts):
        rank = (size, longest)[i % 2] * np.exp((0.0 if i < 2 else 0.4) * rng.standard_normal(len(boxed)))
        out.append((np.argsort(-rank, kind="stable").tolist(), (0.5, 1.0, 0.3)[i % 3]))
    return out


def _search(boxed: list, area: float, gap: float, ways: list, cells: int,
            lowest: float) -> list[tuple[float, list[int], float, list[int]]]:
    """Ways to pack on a coarse grid, best first: share of the square, order, weight of contact, turn of each chart.

    None that stays below the share `lowest`.
    """
    side_most = int(cells * (0.66 / lowest) ** 0.5)
    shapes = _Shapes(boxed, cells * (0.66 / area) ** 0.5, gap * cells, side_most)
    ranked = []
    best_side = side_most
    for turn, (order, contact) in enumerate(ways):
        if turn == 2 and not ranked:
            break  # ill-shaped charts: the others would not do either
        side, reached = min(best_side, cells), None
        step = max(int(0.03 * cells if lowest > 0.4 else 0.12 * cells), 1)
        while side <= side_most and not (ranked and side > 1.04 * best_side):
            reached = shapes.place(order, side, contact)
            if reached is not None:
                break
            side += step
        step = max(step // 2, 2)
        while reached is not None and step >= 2:
            smaller = shapes.place(order, side - step, contact)
            if smaller is None:
                step //= 2
            else:
                side, reached = side - step, smaller
        if reached is not None:
            ranked.append((0.66 * (cells / side) ** 2, order, contact, [placed[0] for placed in reached]))
            best_side = min(best_side, side)
    return sorted(ranked, key=lambda way: -way[0])


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
