"""Charts into the unit square: each where it makes the filled part grow least, by raster, turned but never mirrored."""

from __future__ import annotations

import numpy as np

from gdtool.texture.raster import owner_count

_TURNS = 4
_FINE = 3  # cells of the supersampled mask in a cell of the square
_MOST_BY_RASTER = 400
# Shares of the square that the charts may cover, tried downward.
_SHARES = (0.85, 0.82, 0.79, 0.76, 0.73, 0.70, 0.66, 0.62, 0.58, 0.53, 0.48, 0.42, 0.36, 0.30, 0.24, 0.18, 0.12, 0.06)


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
    from scipy.ndimage import distance_transform_edt

    span = np.ceil(uv.max(0) * cells_per_unit + 2 * gap).astype(int)
    size = int(span.max())
    grid = size * _FINE
    count = owner_count((uv * cells_per_unit + gap) / size, triangles, grid)[:span[1] * _FINE, :span[0] * _FINE] > 0
    # Half a diagonal more: what is covered between the fine cells' centres.
    near = distance_transform_edt(~count) <= gap * _FINE + 0.75
    return near.reshape(span[1], _FINE, span[0], _FINE).any((1, 3))


def pack(charts: list[tuple[np.ndarray, np.ndarray]], gap: float, cells: int = 512) -> tuple[list[np.ndarray], float]:
    """Places for charts: their uv (v, 2) in [0, 1], v up, all at one scale, and that scale (uv per unit of surface).

    charts: uv at the scale of the surface and triangles of each. gap: smallest distance between charts, and half of it
    to the border, in uv. The largest of a ladder of scales at which all charts find a place, then one between.
    """
    boxed = [(upright_box(uv), triangles) for uv, triangles in charts]
    area = sum(float(np.abs(np.cross(uv[t[:, 1]] - uv[t[:, 0]], uv[t[:, 2]] - uv[t[:, 0]])).sum()) / 2 for uv, t in boxed)
    area = max(area, 1e-300)
    if len(charts) == 1:
        scale = (1 - 2 * gap) / max(float(np.ptp(boxed[0][0], 0).max()), 1e-300)
        return [boxed[0][0] * scale + gap], scale
    if len(charts) > _MOST_BY_RASTER:
        return _shelves(boxed, gap)
    order = sorted(range(len(boxed)), key=lambda i: (-float(np.prod(np.ptp(boxed[i][0], 0) + 1e-12)), i))
    above = None
    for share in _SHARES:
        found = _place(boxed, order, (share / area) ** 0.5, gap, cells)
        if found is not None:
            if above is not None:
                middle = (share + above) / 2
                again = _place(boxed, order, (middle / area) ** 0.5, gap, cells)
                if again is not None:
                    return again, (middle / area) ** 0.5
            return found, (share / area) ** 0.5
        above = share
    return _shelves(boxed, gap)


def _place(boxed: list, order: list[int], scale: float, gap: float, cells: int) -> list[np.ndarray] | None:
    """All charts at one scale, or None when one finds no place."""
    from scipy.fft import irfft2, rfft2

    taken = np.zeros((cells, cells), np.float32)
    out: list[np.ndarray | None] = [None] * len(boxed)
    half_gap = gap / 2 * cells
    for i in order:
        uv, triangles = boxed[i]
        upright = _mask(uv, triangles, scale * cells, half_gap)
        if max(upright.shape) > cells:
            return None
        spectrum = rfft2(taken) if taken.any() else None
        best = None
        for quarter in range(_TURNS):
            mask = np.rot90(upright, quarter)
            h, w = mask.shape
            if spectrum is None:
                y, x = 0, 0
            else:
                # Circular correlation: what wraps around lies beyond the places where the mask fits.
                hits = irfft2(spectrum * np.conj(rfft2(mask.astype(np.float32), (cells, cells))), (cells, cells))
                free = hits[:cells - h + 1, :cells - w + 1] < 0.5
                rows = free.any(1)
                if not rows.any():
                    continue
                y = int(rows.argmax())
                x = int(free[y].argmax())
            cost = y + 1.25 * h + x / cells
            if best is None or cost < best[0]:
                best = (cost, quarter, mask, y, x)
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
