"""Depth from normals: what a view's normals say about shape where there is no depth view.

Normals give the slope of the surface at every pixel; the silhouettes of all views bound how near it can be. One robust
least squares joins both. Whatever stays open (steps inside a silhouette, an offset) the alignment of views settles.
"""

from __future__ import annotations

import numpy as np

from gdtool.cameras import Camera, rays
from gdtool.fields.sights import Sight, hull_distance

MIN_FACING = 0.15  # normals turned farther away say little about depth
_PULL = 2e-3  # weight of the hull's depth against one pixel's slope


def hull_depth(sights: list[Sight], camera: Camera, chosen: np.ndarray, samples: int = 160) -> np.ndarray:
    """Depth (n,) along the viewing axis at which the rays of the chosen pixels (h, w) enter the silhouettes' common cone.

    NaN where a ray never does. Marched in equal steps, the last refined linearly.
    """
    origins, directions = (x[chosen] for x in rays(camera))
    t = np.linspace(camera.near, camera.far, samples)
    depth = np.full(len(origins), np.nan)
    before = np.full(len(origins), np.inf)
    open_rays = np.arange(len(origins))
    for k in range(samples):
        value = np.max([hull_distance(s, origins[open_rays] + t[k] * directions[open_rays]) for s in sights], 0)
        enters = value < 0
        if k == 0:
            hit = np.full(len(value), t[0])
        else:
            share = before[open_rays] / np.maximum(before[open_rays] - value, 1e-12)
            hit = t[k - 1] + (t[k] - t[k - 1]) * np.clip(share, 0, 1)
        depth[open_rays[enters]] = hit[enters]
        before[open_rays] = value
        open_rays = open_rays[~enters]
        if len(open_rays) == 0:
            break
    return depth * -(directions @ camera.backward)


def integrate_normals(camera: Camera, mask: np.ndarray, normal: np.ndarray, bound: np.ndarray, rounds: int = 6) -> np.ndarray:
    """Depth (h, w), 0 outside the mask, from world normals (h, w, 3) and the hull's depth bound (h, w); orthographic only.

    Minimises the differences of neighbouring depths against the slopes, each counted less the worse it fits (a step
    between two surfaces fits badly), a weak pull to the bound, a firm one at the silhouette, where the surface touches
    it, and a firm one back behind it.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import cg

    inside = (mask > 0.5) & np.isfinite(bound) & (bound > 0)
    count = int(inside.sum())
    if count == 0:
        return np.zeros(mask.shape, np.float32)
    index = np.full(mask.shape, -1)
    index[inside] = np.arange(count)
    local = normal @ camera.world_from_camera[:3, :3]
    facing = np.maximum(local[..., 2], MIN_FACING)
    # Depth grows away from the camera: over a pixel to the right by n_x / n_z pixels, over a pixel down by -n_y / n_z.
    slopes = {1: local[..., 0] / facing * camera.pixel_size, 0: -local[..., 1] / facing * camera.pixel_size}
    rows, columns, values, targets, trust = [], [], [], [], []
    size = 0
    for axis, slope in slopes.items():
        ahead = np.roll(index, -1, axis)
        last = [slice(None), slice(None)]
        last[axis] = -1
        ahead[tuple(last)] = -1
        pair = inside & (ahead >= 0)
        a, b = index[pair], ahead[pair]
        place = np.arange(size, size + len(a))
        rows += [place, place]
        columns += [a, b]
        values += [-np.ones(len(a)), np.ones(len(a))]
        targets.append(((slope + np.roll(slope, -1, axis)) / 2)[pair])
        least = np.minimum(local[..., 2], np.roll(local[..., 2], -1, axis))[pair]
        trust.append(np.clip(least, 0.02, 1.0) ** 2)
        size += len(a)
    differences = coo_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(size, count)).tocsr()
    target, trust = np.concatenate(targets), np.concatenate(trust)
    start = bound[inside]
    degree = np.asarray(abs(differences).sum(0)).ravel()
    pull = np.where(degree < 4, 0.05, _PULL)
    depth = start.copy()
    for k in range(rounds):
        gap = (differences @ depth - target) / (2.0 * camera.pixel_size)
        weight = trust / (1 + gap ** 2) ** 2 if k else trust
        hold = np.where(depth < start, 1.0, pull)
        system = differences.T @ diags(weight) @ differences + diags(hold)
        right = differences.T @ (weight * target) + hold * start
        depth = cg(system, right, x0=depth, rtol=1e-6, maxiter=300, M=diags(1 / system.diagonal()))[0]
    out = np.zeros(mask.shape, np.float32)
    out[inside] = depth
    return out


def depth_from_normals(cameras: list[Camera], mask: np.ndarray, normal: np.ndarray, sights: list[Sight]) -> np.ndarray | None:
    """Depth (k, h, w) of all views from their normals and the silhouettes; None for perspective cameras."""
    if any(camera.projection != "orthographic" for camera in cameras):
        return None
    out = np.zeros(mask.shape, np.float32)
    for k, camera in enumerate(cameras):
        chosen = mask[k] > 0.5
        if chosen.any():
            bound = np.full(mask[k].shape, np.nan)
            bound[chosen] = hull_depth(sights, camera, chosen)
            out[k] = integrate_normals(camera, mask[k], normal[k], bound)
    return out
