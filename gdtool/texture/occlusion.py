"""Ambient occlusion: the share of the cosine-weighted hemisphere that a surface point sees open."""

from __future__ import annotations

import numpy as np

from gdtool.texture.padding import push_pull
from gdtool.texture.tangents import dot, unit
from gdtool.texture.target import Target, Texels, points_at, texels_of


def cosine_directions(count: int) -> np.ndarray:
    """(count, 2) points of the unit square: an R2 low-discrepancy sequence (Roberts 2018)."""
    golden = 1.32471795724474602596
    return (0.5 + np.arange(1, count + 1)[:, None] * np.array([1 / golden, 1 / golden**2])) % 1.0


def _around(normals: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Unit directions (n, 3), cosine-distributed about normals (n, 3) from points of the unit square (n, 2)."""
    sign = np.where(normals[:, 2] < 0, -1.0, 1.0)  # the frame of Duff et al. 2017
    a = -1.0 / (sign + normals[:, 2])
    b = normals[:, 0] * normals[:, 1] * a
    tangent = np.stack([1 + sign * normals[:, 0] ** 2 * a, sign * b, -sign * normals[:, 0]], 1)
    bitangent = np.stack([b, sign + normals[:, 1] ** 2 * a, -normals[:, 1]], 1)
    radius, angle = np.sqrt(square[:, 0]), 2 * np.pi * square[:, 1]
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return x[:, None] * tangent + y[:, None] * bitangent + np.sqrt(np.maximum(1 - square[:, 0], 0))[:, None] * normals


def openness(points: np.ndarray, normals: np.ndarray, caster, ray_count: int, seed: int, reach: float = np.inf,
             lift: float = 1e-4) -> np.ndarray:
    """(n,) float32 in [0, 1]: share of ray_count cosine-distributed rays from points (n, 3) that leave the surface.

    normals (n, 3) unit, of the surface itself. Each point turns one low-discrepancy set by its own random shift.
    Rays start `lift` above the surface and are blocked within reach only.
    """
    rng = np.random.default_rng(seed)
    shift = rng.random((len(points), 2))
    base = cosine_directions(ray_count)
    origins = points + normals * lift
    blocked = np.zeros(len(points), np.int32)
    for k in range(ray_count):
        blocked += caster.occluded(origins, _around(normals, (shift + base[k]) % 1.0), max_distance=reach)
    return (1 - blocked / ray_count).astype(np.float32)


def bake_occlusion(target: Target, texels: Texels, positions: np.ndarray, normals: np.ndarray, trace, scale: int = 4) -> np.ndarray:
    """Occlusion (n,) float32 for texels, traced at 1/scale of the map's size and upsampled along the surface.

    positions and normals (n, 3) of the texels. trace(face_idx, barycentric) -> (m,) gives the occlusion at places on the
    target. A coarse texel helps a fine one only when it lies near it in space and its surface looks the same way, so
    nothing leaks from one chart, or one side of an edge, to another. Fine texels that no coarse one helps are traced.
    """
    size = texels.size
    coarse = texels_of(target, max(1, -(-size // scale)), rings=0)
    traced = trace(coarse.face_idx, coarse.barycentric)
    at, frames = points_at(target, coarse.face_idx, coarse.barycentric)
    slot = np.full(coarse.size * coarse.size, -1, np.int32)
    slot[coarse.texel] = np.arange(len(coarse))
    # What a coarse texel spans in space, from the distances between neighbours of one chart.
    spacing = _spacing(at, slot.reshape(coarse.size, coarse.size))
    facing = unit(frames[..., 2])
    at, facing = at.astype(np.float32), facing.astype(np.float32)
    traced = _smoothed(traced, slot.reshape(coarse.size, coarse.size), at, facing, spacing)
    out = np.empty(len(texels), np.float32)
    helped = np.zeros(len(texels), bool)
    for start in range(0, texels.inside, 500_000):
        part = slice(start, min(start + 500_000, texels.inside))
        row, column = texels.texel[part] // size, texels.texel[part] % size
        u = (column + 0.5) * coarse.size / size - 0.5
        v = (row + 0.5) * coarse.size / size - 0.5
        c0, r0 = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        total, value = np.zeros(len(row)), np.zeros(len(row))
        for dc, dr in ((0, 0), (1, 0), (0, 1), (1, 1)):
            c, r = np.clip(c0 + dc, 0, coarse.size - 1), np.clip(r0 + dr, 0, coarse.size - 1)
            k = slot[r * coarse.size + c]
            there = k >= 0
            share = np.abs(1 - dc - (u - c0)) * np.abs(1 - dr - (v - r0)) + 1e-3
            weight = np.where(there, share * _kinship(at[k], facing[k], positions[part], normals[part], spacing), 0)
            total += weight
            value += weight * traced[k]
        helped[part] = total > 1e-5
        out[part] = np.where(total > 1e-5, value / np.maximum(total, 1e-12), 1)
    alone = np.flatnonzero(~helped[:texels.inside])
    if len(alone):
        out[alone] = trace(texels.face_idx[alone], texels.barycentric[alone])
    # Beyond a crease the surface goes on in another direction: around charts the inside is continued instead.
    image = texels.image(np.where(np.arange(len(texels)) < texels.inside, out, 0))
    out[texels.inside:] = push_pull(image, texels.mask(inside_only=True)).ravel()[texels.texel[texels.inside:]]
    return out


def _kinship(at: np.ndarray, facing: np.ndarray, to: np.ndarray, normal: np.ndarray, spacing: float, reach: float = 3.0) -> np.ndarray:
    """(n,) in [0, 1]: how much a place (n, 3) facing (n, 3) says about another one; 0 beyond reach spacings."""
    offset = at - to
    apart = dot(offset, offset) / spacing**2
    alike = np.clip(dot(facing, normal), 0, 1)
    return np.where(apart < reach**2, alike**4 * np.exp(-0.5 * apart), 0)


def _smoothed(traced: np.ndarray, slot: np.ndarray, at: np.ndarray, facing: np.ndarray, spacing: float) -> np.ndarray:
    """traced (m,) averaged over the 5 x 5 coarse texels around each, as far as they are of one piece of surface.

    slot (s, s) is the index of each coarse texel, -1 where there is none. Takes out most of the noise of few rays.
    """
    row, column = np.nonzero(slot >= 0)
    own = slot[row, column]
    padded = np.pad(slot, 2, constant_values=-1)
    total, value = np.ones(len(own), np.float32), traced[own].copy()
    for dr in range(-2, 3):
        for dc in range(-2, 3):
            k = padded[row + 2 + dr, column + 2 + dc]
            both = np.flatnonzero((k >= 0) & ((dr != 0) | (dc != 0)))
            near, here = k[both], own[both]
            # Wider than for interpolation: noise is to be averaged, and occlusion varies slowly.
            weight = _kinship(at[near], facing[near], at[here], facing[here], 2 * spacing)
            total[both] += weight
            value[both] += weight * traced[near]
    out = traced.copy()
    out[own] = value / total
    return out


def _spacing(at: np.ndarray, slot: np.ndarray) -> float:
    """Typical distance in space between neighbouring coarse texels."""
    left, right = slot[:, :-1], slot[:, 1:]
    both = (left >= 0) & (right >= 0)
    if not both.any():
        return 1.0
    return float(np.median(np.linalg.norm(at[left[both]] - at[right[both]], axis=1))) + 1e-12
