"""How much of other charts and of the gutter a map shows along the rims of its charts, at a coarse mip level."""

from __future__ import annotations

import numpy as np

from benchmarks.bake.score import bilinear, decibels

POINTS = 40_000


def halved(image: np.ndarray, size: int) -> np.ndarray:
    """(size, size, c) of image (s, s, c): means of squares, as graphics cards make mip levels."""
    step = image.shape[0] // size
    return image.reshape(size, step, size, step, -1).mean((1, 3))


def rim_points(target) -> tuple[np.ndarray, np.ndarray]:
    """uv (n, 2) on the charts' rims, by length, and the chart of each triangle (t,) and of the rim points (n,)."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    from gdtool.geometry.topology import edges_of

    edges = edges_of(target.face_uvs)
    edge_idx, pairs = edges.face_pairs()
    count = len(target.face_uvs)
    chart = connected_components(coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count)), False)[
        1
    ]
    rim = edges.ends[edges.count == 1]
    length = np.linalg.norm(target.uv[rim[:, 0]] - target.uv[rim[:, 1]], axis=1)
    rng = np.random.default_rng(2)
    pick, along = rng.choice(len(rim), POINTS, p=length / length.sum()), rng.random((POINTS, 1))
    of_corner = np.zeros(len(target.uv), np.int64)
    of_corner[target.face_uvs.ravel()] = np.repeat(chart, 3)
    return target.uv[rim[pick, 0]] * (1 - along) + target.uv[rim[pick, 1]] * along, chart, of_corner[rim[pick, 0]]


def rim_error(target, albedo: np.ndarray, level: int) -> float:
    """dB (sRGB) between albedo (s, s, 3) linear read at the charts' rims in its mip level of `level` texels, and the
    same with each chart alone in the map: means of its own texels only, the nearest of them carried on."""
    from gdtool.bake.padding import push_pull
    from gdtool.bake.target import texels_of
    from gdtool.images.color import srgb_from_linear

    size = albedo.shape[0]
    uv, chart, own = rim_points(target)
    texels = texels_of(target, size, rings=0)
    label = texels.image(chart[texels.face_idx], -1)
    shown = bilinear(halved(albedo, level), uv)
    true = np.empty_like(shown)
    for k in np.unique(own):
        inside = label == k
        weight = halved(inside[..., None].astype(np.float32), level)
        mean = halved(np.where(inside[..., None], albedo, 0), level) / np.maximum(weight, 1e-6)
        alone = push_pull(mean.astype(np.float32), weight[..., 0] > 0)
        true[own == k] = bilinear(alone, uv[own == k])
    return decibels(srgb_from_linear(np.clip(shown, 0, 1)), srgb_from_linear(np.clip(true, 0, 1)))
