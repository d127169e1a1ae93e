"""Bake ambient occlusion: the unoccluded share of the cosine-weighted hemisphere over a surface point."""

from __future__ import annotations

import numpy as np

from gdtool.bake.target import TEXELS_AT_ONCE, Target, Texels, surface_at, texels_of
from gdtool.core.threads import mapped
from gdtool.geometry.tangents import dot, unit
from gdtool.shading.sampling import orthonormal_basis


def cosine_directions(count: int) -> np.ndarray:
    """Compute (count, 2) points of the unit square by the R2 low-discrepancy sequence (Roberts 2018)."""
    golden = 1.32471795724474602596
    return (0.5 + np.arange(1, count + 1)[:, None] * np.array([1 / golden, 1 / golden**2])) % 1.0


def ambient_visibility(
    points: np.ndarray,
    normals: np.ndarray,
    caster,
    ray_count: int,
    seed: int,
    reach: float = np.inf,
    lift: float = 1e-4,
) -> np.ndarray:
    """Trace cosine-distributed rays from points (n, 3); return the share of each point's rays that hits nothing, (n,).

    normals (n, 3) unit; caster: a SinglePrecisionCaster; ray_count: rays per point. Rays start `lift` above the surface
    and are `reach` long, both in world units.
    """
    rng = np.random.default_rng(seed)
    normals = normals.astype(np.float32)
    turn, shift = rng.random(len(points), np.float32) * np.float32(2 * np.pi), rng.random(len(points), np.float32)
    # Each point's basis is turned once by a random angle, instead of every ray's direction.
    tangent, bitangent = (np.stack(axis, 1) for axis in orthonormal_basis(*normals.T))
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    tangent, bitangent = cosine * tangent + sine * bitangent, cosine * bitangent - sine * tangent
    origins = points + normals * points.dtype.type(lift)
    blocked = np.zeros(len(points), np.int32)
    for square, angle in cosine_directions(ray_count) * (1, 2 * np.pi):
        radius = (shift + np.float32(square)) % np.float32(1)
        up, radius = np.sqrt(1 - radius)[:, None], np.sqrt(radius)[:, None]
        across = np.float32(np.cos(angle)) * tangent + np.float32(np.sin(angle)) * bitangent
        blocked += caster.occluded_single(origins, radius * across + up * normals, reach)
    return (1 - blocked / ray_count).astype(np.float32)


def bake_occlusion(target: Target, texels: Texels, trace, scale: int = 4, threads: int = 1) -> np.ndarray:
    """Bake ambient visibility (n,) float32 of texels: traced at 1/scale of the map's size, and upsampled.

    trace(face_idx, barycentric) -> (m,) gives the ambient visibility at points of the target. The upsampling is joint
    bilateral: a coarse texel contributes to a fine one only where it is near in space and faces the same way. So
    nothing leaks between charts or across an edge. Fine texels without a similar coarse one are traced.
    """
    size = texels.size
    coarse = texels_of(target, max(1, -(-size // scale)), rings=0)
    slot = np.full(coarse.size * coarse.size, -1, np.int32)
    slot[coarse.texel] = np.arange(len(coarse), dtype=np.int32)
    at, facing, _, _ = surface_at(target, coarse.face_idx, coarse.barycentric)
    spacing = np.float32(_spacing(at, slot.reshape(coarse.size, coarse.size)))
    # For each coarse texel its position in units of the spacing, normal and visibility: one gather reads all seven.
    known = np.concatenate([at / spacing, unit(facing), trace(coarse.face_idx, coarse.barycentric)[:, None]], 1)
    known[:, 6] = _smoothed(known, slot.reshape(coarse.size, coarse.size))
    out = np.zeros(len(texels), np.float32)
    has_similar = np.zeros(len(texels), bool)

    def run(part: slice) -> None:
        at, facing, _, _ = surface_at(target, texels.face_idx[part], texels.barycentric[part])
        fine = np.concatenate([at / spacing, unit(facing)], 1)
        row, column = np.divmod(texels.texel[part], size)
        u = (column.astype(np.float32) + np.float32(0.5)) * np.float32(coarse.size / size) - np.float32(0.5)
        v = (row.astype(np.float32) + np.float32(0.5)) * np.float32(coarse.size / size) - np.float32(0.5)
        c0, r0 = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
        u, v = u - c0, v - r0
        total, value = np.zeros(len(u), np.float32), np.zeros(len(u), np.float32)
        for dc, dr in ((0, 0), (1, 0), (0, 1), (1, 1)):
            k = slot[np.clip(r0 + dr, 0, coarse.size - 1) * coarse.size + np.clip(c0 + dc, 0, coarse.size - 1)]
            share = (u if dc else 1 - u) * (v if dr else 1 - v) + np.float32(1e-3)
            near = np.take(known, k, axis=0)
            weight = np.where(k >= 0, share * _similarity(near, fine), np.float32(0))
            total += weight
            value += weight * near[:, 6]
        has_similar[part] = total > 1e-5
        out[part] = value / np.maximum(total, np.float32(1e-12))

    parts = [slice(s, min(s + TEXELS_AT_ONCE, texels.inside)) for s in range(0, texels.inside, TEXELS_AT_ONCE)]
    for _ in mapped(run, parts, threads):
        pass
    unmatched = np.flatnonzero(~has_similar[: texels.inside])
    if len(unmatched):
        out[unmatched] = trace(texels.face_idx[unmatched], texels.barycentric[unmatched])
    # Beyond a crease the surface faces elsewhere: the rings around charts are filled from within the charts instead.
    continue_into_rings(texels, out)
    return out


def continue_into_rings(texels: Texels, values: np.ndarray) -> None:
    """Fill the rings of texels around the charts with the mean of their known neighbours, innermost ring first.

    values (n,), by texel, are changed in place.
    """
    size, ring = texels.size, texels.texel[texels.inside :]
    slot = np.full((size + 2) * (size + 2), -1, np.int32)
    place = (texels.texel // size + 1) * (size + 2) + texels.texel % size + 1
    slot[place[: texels.inside]] = np.arange(texels.inside, dtype=np.int32)
    waiting = np.arange(texels.inside, texels.inside + len(ring))
    while len(waiting):
        near = slot[place[waiting][:, None] + [o + d for o in (-size - 2, 0, size + 2) for d in (-1, 0, 1)]]
        is_known = near >= 0
        reached = is_known.any(1)
        if not reached.any():
            break
        mean = np.where(is_known, values[near], 0).sum(1) / np.maximum(is_known.sum(1), 1)
        done = waiting[reached]
        values[done] = mean[reached]
        slot[place[done]] = done
        waiting = waiting[~reached]


def _similarity(near: np.ndarray, other: np.ndarray, wider: float = 1.0, reach: float = 3.0) -> np.ndarray:
    """Compute bilateral weights (n,) in [0, 1] of pairs of surface points, by distance and normal.

    near and other (n, 6 or more): position in units of the texel spacing, then unit normal. The weight of distance is a
    Gaussian of `wider` spacings, cut off at `reach` times that.
    """
    offset = near[:, :3] - other[:, :3]
    apart = dot(offset, offset) * np.float32(1 / wider**2)
    alike = np.clip(dot(near[:, 3:6], other[:, 3:6]), 0, 1)
    alike *= alike
    return np.where(apart < np.float32(reach**2), alike * alike * np.exp(np.float32(-0.5) * apart), np.float32(0))


def _smoothed(known: np.ndarray, slot: np.ndarray) -> np.ndarray:
    """Denoise the visibility of coarse texels (m,) by a joint bilateral filter over 5 x 5 texels.

    known (m, 7): position in units of the texel spacing, unit normal, visibility. slot (s, s): the index of each coarse
    texel, -1 where there is none. This removes most of the noise that few rays leave.
    """
    row, column = np.nonzero(slot >= 0)
    texel = slot[row, column]
    padded = np.pad(slot, 2, constant_values=-1)
    out = known[:, 6].copy()
    for start in range(0, len(texel), TEXELS_AT_ONCE):
        centre_idx = texel[start : start + TEXELS_AT_ONCE]
        r, c, centre = row[start : start + TEXELS_AT_ONCE], column[start : start + TEXELS_AT_ONCE], known[centre_idx]
        total, value = np.ones(len(centre_idx), np.float32), centre[:, 6].copy()
        for dr in range(-2, 3):
            for dc in range(-2, 3):
                if not dr and not dc:
                    continue
                k = padded[r + 2 + dr, c + 2 + dc]
                near = np.take(known, k, axis=0)
                # Wider than for upsampling: occlusion varies slowly, and more neighbours take out more noise.
                weight = np.where(k >= 0, _similarity(near, centre, wider=2.0), np.float32(0))
                total += weight
                value += weight * near[:, 6]
        out[centre_idx] = value / total
    return out


def _spacing(at: np.ndarray, slot: np.ndarray) -> float:
    """Estimate the width of a coarse texel in space: the median distance between horizontal neighbours.

    at (m, 3): positions; slot (s, s): the index of each texel, -1 where there is none.
    """
    left, right = slot[:, :-1], slot[:, 1:]
    both = (left >= 0) & (right >= 0)
    if not both.any():
        return 1.0
    return float(np.median(np.linalg.norm(at[left[both]] - at[right[both]], axis=1))) + 1e-12
