"""Integrate normals to depth for views without a depth image.

Normals give the slope at every pixel. Matching the views (multiview_stereo) tells roughly where the surface lies and
where it breaks off. One robust least squares joins both.
"""

from __future__ import annotations

import numpy as np

from gdtool.cameras import Camera, rays
from gdtool.fields.views.multiview_stereo import Matched, match_views, pixel_steps, slopes, stretched, unstretched
from gdtool.fields.views.prepared_view import PreparedView

MIN_FACING = 0.15  # cosine between normal and ray; normals turned farther away say little about depth
MATCH_WEIGHT, LEAST_MATCH_WEIGHT = (
    0.02,
    1e-5,
)  # weight of a trusted matched depth relative to a slope, and of any matched depth
# Pixels by which a step in depth may miss the slope before it loses three quarters of its weight: first round, others.
_FIRST_STEP, _STEP = 6.0, 2.0
_MISMATCH = 4.0  # pixels: the same for a matched depth


def integrate_normals(
    camera: Camera, mask: np.ndarray, normal: np.ndarray, matched: Matched, rounds: int = 6
) -> np.ndarray:
    """Compute depth (h, w), 0 outside the mask (h, w), from world normals (h, w, 3) and a matched depth.

    Minimises the differences of neighbouring depths against the slopes, and a pull to the matched depth. Terms that fit
    badly lose weight: a step between two surfaces fits badly, and so does a mismatch.
    """
    from scipy.sparse import coo_matrix, diags
    from scipy.sparse.linalg import cg

    inside = (mask > 0.5) & (matched.depth > 0)
    count = int(inside.sum())
    if count == 0:
        return np.zeros(mask.shape, np.float32)
    index = np.full(mask.shape, -1)
    index[inside] = np.arange(count)
    right, down, facing = slopes(camera, normal, MIN_FACING, rays(camera)[1])
    pixel = pixel_steps(camera)[1]  # its height
    rows, columns, values, targets, trust = [], [], [], [], []
    size = 0
    for axis, slope in ((1, right), (0, down)):
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
        trust.append(np.clip(np.minimum(facing, np.roll(facing, -1, axis))[pair], 0.02, 1.0) ** 2)
        size += len(a)
    differences = coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(size, count)
    ).tocsr()
    target, trust = np.concatenate(targets), np.concatenate(trust)
    start, held = stretched(camera, matched.depth[inside]), MATCH_WEIGHT * matched.trust[inside] + LEAST_MATCH_WEIGHT
    depth = start.copy()
    for k in range(rounds):
        gap = (differences @ depth - target) / ((_STEP if k else _FIRST_STEP) * pixel)
        weight = trust / (1 + gap**2) ** 2
        hold = held / (1 + ((depth - start) / (_MISMATCH * pixel)) ** 2) ** 2
        system = differences.T @ diags(weight) @ differences + diags(hold)
        depth = cg(
            system,
            differences.T @ (weight * target) + hold * start,
            x0=depth,
            rtol=1e-6,
            maxiter=300,
            M=diags(1 / system.diagonal()),
        )[0]
    out = np.zeros(mask.shape, np.float32)
    out[inside] = unstretched(camera, depth)
    return out


def depth_from_normals(
    cameras: list[Camera],
    mask: np.ndarray,
    normal: np.ndarray,
    alike: dict[str, np.ndarray],
    silhouettes: list[PreparedView],
    box: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Compute the depth (k, h, w) of all views from normals, silhouettes and direction-independent images.

    See match_views for the arguments.
    """
    matched = match_views(cameras, mask, normal, alike, silhouettes, box)
    return np.stack([integrate_normals(*view) for view in zip(cameras, mask, normal, matched, strict=True)])
