"""Carve prepared views into a grid of signed distances: the first half of the grid method.

Space that any view sees in front of its surface or beside its silhouette is outside; the rest is inside. Unseen parts
(tops, bottoms, hollows) are therefore closed at the largest extent that the views allow.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from gdtool.cameras import project
from gdtool.fields.views.prepared_view import WEAK, PreparedView, hull_distance, pixel_footprint, tangent_distance
from gdtool.geometry.grids import Grid, band_cells, dilate, fine_points, grid_over

COARSE = 2  # fine grid steps in a coarse one
UNSEEN, ROUGHLY, SMOOTHLY = 0, 1, 2  # how a sample of the grid is known
SLACK = 0.5  # grid steps by which noisy silhouettes may carve too much
_CHUNK = 1 << 16  # samples at a time: their arrays stay in the cache


def combined_distance(
    views: list[PreparedView], points: np.ndarray, step: float, limit: float, noise: float = 0.0, outvoted: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Combine all views to a signed distance (n,) float32 of points (n, 3), clipped to +-limit, and its kind (n,)
    uint8.

    A point is outside where any view sees free space. The magnitude is that of the nearest surface among the views that
    agree with the sign; estimates within about a third of a step of it are averaged by weight. With noise (world units
    by which the views disagree) the mean of all views that see the surface decides instead. The silhouettes bound the
    distance from below. outvoted: how many silhouettes may miss a point of the object.

    The kind is SMOOTHLY where a view sees one smooth surface or where the silhouettes of most views end (flat tops and
    bottoms), ROUGHLY where only an edge pixel tells, and UNSEEN elsewhere.
    """
    out, measured = np.empty(len(points), np.float32), np.zeros(len(points), np.uint8)
    deep = [s for s in views if s.planes is not None]

    def measure(start: int) -> None:
        """Fill one chunk of `out` and `measured`."""
        part = points[start : start + _CHUNK]
        hull = np.stack([hull_distance(view, part) for view in views]).astype(np.float32)
        ending = (np.abs(hull) < step).sum(0)
        value = _vote(hull, outvoted)
        seen = np.where(2 * ending > len(views), SMOOTHLY, UNSEEN)
        if deep:
            measurements = [tangent_distance(view, part) for view in deep]
            free = np.clip(np.stack([f[0] for f in measurements]), -limit, limit).astype(np.float32)
            weight = np.stack([f[1] for f in measurements]).astype(np.float32)
            smooth = np.stack([f[3] for f in measurements])
            fused = _mean_surface(free, weight, limit) if noise else _nearest_surface(free, weight, step / 3, limit)
            # Noisy views have noisy masks, even after their edges were brought together.
            value = np.maximum(value - (SLACK * step if noise else 0.0), fused)
            close = (np.abs(free - value) < step + noise) & (weight > WEAK) & (free > -limit)
            seen = np.maximum(
                seen, np.where((close & smooth).any(0), SMOOTHLY, np.where(close.any(0), ROUGHLY, UNSEEN))
            )
        out[start : start + _CHUNK] = np.clip(value, -limit, limit)
        measured[start : start + _CHUNK] = seen

    # numpy lets go of the interpreter lock; each chunk writes its own part.
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        list(pool.map(measure, range(0, len(points), _CHUNK)))
    return out, measured


def _nearest_surface(value: np.ndarray, weight: np.ndarray, blend: float, limit: float) -> np.ndarray:
    """Fuse distances value (k, n), unknown at -limit with weight 0, to (n,).

    A weak distance (beside a jump in depth, where the pixel grid decides what is seen) carves only where no reliable
    one finds the surface close by.
    """
    reliable = weight > WEAK
    free, near = value > 0, reliable & (value > -limit / 2)
    nearest_free = np.where(free & reliable, value, np.inf).min(0)
    nearest_reliable = np.where(near, value, -np.inf).max(0)
    nearest_weak = np.where(free, value, np.inf).min(0)
    reference = np.where(
        np.isfinite(nearest_free),
        nearest_free,
        np.where(
            np.isfinite(nearest_reliable),
            nearest_reliable,
            np.where(np.isfinite(nearest_weak), nearest_weak, value.max(0)),
        ),
    )
    share = weight * np.exp(-(((value - reference) / blend) ** 2)) + 1e-12
    return (share * value).sum(0) / share.sum(0)


def _vote(hull: np.ndarray, outvoted: int) -> np.ndarray:
    """Return the largest distance (n,) of hull (k, n) after dropping the `outvoted` largest ones."""
    return hull.max(0) if outvoted == 0 else -np.partition(-hull, outvoted, axis=0)[outvoted]


def silhouettes_outvoted(views: list[PreparedView], samples: int = 56, reach: float = 0.75) -> int:
    """Find how many silhouettes must be ignored at a point, at most, so that the common volume fills the masks.

    0 for views of one object. Views that contradict one another leave a volume that is empty or too thin. Then a point
    is kept that all but one, two, … of them allow, until nine tenths of the median mask are filled.
    """
    axis = np.linspace(-reach, reach, samples)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    hull = np.stack([hull_distance(s, points) for s in views]).astype(np.float32)
    half_cell = 0.87 * 2 * reach / (samples - 1)
    for outvoted in range(max(len(views) // 2, 1)):
        inside = points[_vote(hull, outvoted) < half_cell]
        if len(inside) and np.median([_filled(s, inside, half_cell) for s in views]) > 0.9:
            return outvoted
    return max(len(views) // 2 - 1, 0)


def _filled(view: PreparedView, points: np.ndarray, radius: float) -> float:
    """Measure the share of a view's mask that points, each of the given world radius, cover."""
    pixels, depth = project(view.camera, points)
    h, w = view.mask.shape
    hit = np.zeros((h, w), bool)
    inside = (pixels >= 0).all(1) & (pixels[:, 0] < w) & (pixels[:, 1] < h)
    hit[pixels[inside, 1].astype(int), pixels[inside, 0].astype(int)] = True
    grown = dilate(hit, int(np.ceil(radius / float(np.median(pixel_footprint(view.camera, depth))))))
    shown = view.mask > 0.5
    return float(grown[shown].mean())


def _mean_surface(value: np.ndarray, weight: np.ndarray, limit: float) -> np.ndarray:
    """Average (n,) the truncated distances value (k, n) of the views that do not see a nearer surface."""
    share = np.where(value > -limit, weight, 0.0)
    total = share.sum(0)
    return np.where(total > 1e-3, (share * value).sum(0) / np.maximum(total, 1e-3), value.max(0))


def hull_bounds(
    views: list[PreparedView], outvoted: int = 0, reach: float = 0.75, samples: int = 48
) -> tuple[np.ndarray, np.ndarray]:
    """Find the box (low, high) around the common cone of the silhouettes, on a coarse grid over [-reach, reach]^3."""
    step = 2 * reach / (samples - 1)
    axis = np.linspace(-reach, reach, samples)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    value = _vote(np.stack([hull_distance(s, points) for s in views]), outvoted)
    near = points[value < step]
    if len(near) == 0:
        return np.full(3, -0.5), np.full(3, 0.5)
    return near.min(0) - step, near.max(0) + step


def carve(
    views: list[PreparedView], step: float, noise: float = 0.0, outvoted: int = 0
) -> tuple[Grid, np.ndarray, np.ndarray]:
    """Carve a grid; returns it, its signed distances (a, b, c) float32 and their kind (a, b, c) uint8.

    Distances are exact in a band around the surface and +-limit (3 steps, more with noise) elsewhere.
    """
    limit = max(3.0 * step, 3.0 * noise)
    low, high = hull_bounds(views, outvoted)
    grid = grid_over(low, high, step, margin=2 * COARSE, multiple=COARSE)
    coarse_shape = tuple((n - 1) // COARSE + 1 for n in grid.shape)
    index = np.stack(np.meshgrid(*(np.arange(n) * COARSE for n in coarse_shape), indexing="ij"), -1).reshape(-1, 3)
    coarse = combined_distance(views, grid.points(index), step, limit, noise, outvoted)[0].reshape(coarse_shape)

    touched = np.zeros(tuple(n - 1 for n in coarse_shape), bool)
    for view in views:
        if view.points is not None:
            seen = np.floor(grid.locate(view.points[view.weight > 0]) / COARSE).astype(int)
            seen = seen[((seen >= 0) & (seen < touched.shape)).all(1)]
            touched[tuple(seen.T)] = True
    fine = fine_points(dilate(band_cells(coarse < 0, touched), int(round(noise / step))), COARSE)
    values = np.repeat(np.repeat(np.repeat(np.where(coarse < 0, -limit, limit), COARSE, 0), COARSE, 1), COARSE, 2)
    values = np.ascontiguousarray(values[: grid.shape[0], : grid.shape[1], : grid.shape[2]], np.float32)
    measured = np.zeros(grid.shape, np.uint8)
    values[fine], measured[fine] = combined_distance(
        views, grid.points(np.argwhere(fine)), step, limit, noise, outvoted
    )
    return grid, values, measured


def smooth_unseen(values: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Smooth the unseen part of the signed distances, which removes fins and ridges at the edges of the seen part.

    Parts known from edge pixels alone are smoothed by one step, because the pixel grid decides them at random. Smooth
    surfaces stay. Nothing is filled that a view saw to be free, such as a slit that smoothing would close.
    """
    from scipy.ndimage import gaussian_filter

    def loose(known: np.ndarray) -> np.ndarray:
        """Return 1 far from known samples, falling to 0 beside them."""
        return np.clip(1.0 - 4.0 * gaussian_filter(known.astype(np.float32), 1.0, truncate=2.0), 0.0, 1.0)

    out = values + loose(measured == SMOOTHLY) * (gaussian_filter(values, 1.0, mode="nearest", truncate=2.5) - values)
    unseen = loose(measured > UNSEEN)
    for _ in range(3):
        out = out + unseen * (gaussian_filter(out, 1.5, mode="nearest", truncate=2.5) - out)
    return np.maximum(out, values)
