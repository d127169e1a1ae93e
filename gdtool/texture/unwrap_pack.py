"""Charts into the unit square: each where it makes the filled part grow least, by raster, turned but never mirrored."""

from __future__ import annotations

import numpy as np

from gdtool.texture.raster import owner_count

_TURNS = 4
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


def pack(charts: list[tuple[np.ndarray, np.ndarray]], gap: float, cells: int = 448) -> tuple[list[np.ndarray], float]:
    """Places for charts: their uv (v, 2) in [0, 1], v up, all at one scale, and that scale (uv per unit of surface).

    charts: uv at the scale of the surface and triangles of each. gap: smallest distance between charts, and half of it
    to the border, in uv. Several orders and weights are tried on a coarse grid, the best of them on a fine one.
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
    starts = max(min(_STARTS, 200 // len(charts)), 1)
    ranked = _search(boxed, area, gap, _way(boxed, starts))
    found, share = None, 0.0
    for coarse, order, contact in ranked[:1 if many else 2]:
        # The fine grid wastes less at the rims, so it may take more than the coarse one did.
        for step in (0.03, 0.0, -0.04, -0.1) if many else (0.06, 0.05, 0.042, 0.035, 0.028, 0.02, 0.01, 0.0, -0.02, -0.05, -0.1):
            if coarse + step <= share:
                break
            again = _place(boxed, order, ((coarse + step) / area) ** 0.5, gap, cells, contact)
            if again is not None:
                found, share = again, coarse + step
                break
    if found is None:
        return _shelves(boxed, gap)
    return found, (share / area) ** 0.5


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


def _search(boxed: list, area: float, gap: float, ways: list, cells: int = 160) -> list[tuple[float, list[int], float]]:
    """Ways to pack with the largest share of the square each reached on a coarse grid, best first."""
    best = 0.02
    ranked = []
    for order, contact in ways:
        share, step = best, 0.16 if best < 0.1 else 0.02
        reached = 0.0
        while True:
            if _place(boxed, order, ((share + step) / area) ** 0.5, gap, cells, contact) is not None:
                share = reached = share + step
            elif step > 0.02:
                step /= 2
            else:
                break
        ranked.append((reached or best - 0.02, order, contact))
        best = max(best, reached)
    return sorted(ranked, key=lambda way: -way[0])


def _place(boxed: list, order: list[int], scale: float, gap: float, cells: int, contact: float) -> list[np.ndarray] | None:
    """All charts at one scale, or None when one finds no place. contact weighs touching others against staying low."""
    from scipy.fft import irfft2, rfft2

    taken = np.zeros((cells, cells), np.float32)
    out: list[np.ndarray | None] = [None] * len(boxed)
    half_gap = gap / 2 * cells
    for i in order:
        uv, triangles = boxed[i]
        upright = _mask(uv, triangles, scale * cells, half_gap)
        if max(upright.shape) > cells:
            return None
        walls = np.pad(taken, 1, constant_values=1) > 0
        beside = walls[:-2, 1:-1] | walls[2:, 1:-1] | walls[1:-1, :-2] | walls[1:-1, 2:]
        taken_spectrum, beside_spectrum = rfft2(taken), rfft2(beside.astype(np.float32))
        best = None
        for quarter in range(_TURNS):
            mask = np.rot90(upright, quarter)
            h, w = mask.shape
            # Circular correlation: what wraps around lies beyond the places where the mask fits.
            spectrum = np.conj(rfft2(mask.astype(np.float32), (cells, cells)))
            free = irfft2(taken_spectrum * spectrum, (cells, cells))[:cells - h + 1, :cells - w + 1] < 0.5
            if not free.any():
                continue
            touching = irfft2(beside_spectrum * spectrum, (cells, cells))[:cells - h + 1, :cells - w + 1]
            far = (np.arange(cells - h + 1)[:, None] + h + 0.25 * (np.arange(cells - w + 1) + w)) / cells
            cost = np.where(free, far - contact * np.rint(touching) / (2 * (h + w)), np.inf)
            k = int(cost.argmin())
            if best is None or cost.flat[k] < best[0] - 1e-9:
                best = (float(cost.flat[k]), quarter, mask, *divmod(k, cost.shape[1]))
        if best is None:
            return None
        _, quarter, mask, y, x = best
        taken[y:y + mask.shape[0], x:x + mask.shape[1]] += mask
        at = uv * (scale * cells) + half_gap
        h, w = upright.shape
        # As np.rot90 turns the mask: its rows are v, its columns u.
        at = (at, np.stack([at[:, 1], w - at[:, 0]], -1), np.stack([w - at[:, 0], h - at[:, 1]], -1), np.stack([h - at[:, 1], at[:, 0]], -1))[quarter]
        out[i] = (at + [x, y]) / cells
    return out


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
