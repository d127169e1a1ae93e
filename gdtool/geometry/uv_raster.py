"""Rasterise texture coordinates exactly: find the triangle that owns each texel.

Texture coordinates are snapped to 1/4096 of a texel and everything after that is integer arithmetic, with the top-left
rule of the graphics interfaces (Direct3D 11 functional specification, section 3.4.1.2): triangles that share an edge or
a vertex share no texel and leave none between them. Rays through texel centres, the usual other way, can miss an edge.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

SUBTEXEL_BITS = 12
_ONE = 1 << SUBTEXEL_BITS  # one texel in the integer coordinates
_MAX_UV = 64.0  # keeps edge functions far below 2**63 for every size up to 65536
# Rows of triangles, and texels, that are worked on at a time, so that intermediate arrays stay in the cache.
_SPANS_AT_ONCE = 65_536
_TEXELS_AT_ONCE = 131_072


def _snapped(uv: np.ndarray, faces: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners' x and y (t, 3) in 1/4096 texel, from the image's top-left corner."""
    if not 1 <= size <= 65536:
        raise ValueError(f"size {size} is not in 1..65536")
    if len(uv) and not (np.abs(uv) <= _MAX_UV).all():  # catches NaN as well
        raise ValueError(f"texture coordinates must be finite and within ±{_MAX_UV:g}")
    fixed = np.rint(np.asarray(uv, np.float64) * (size * _ONE)).astype(np.int64)
    return fixed[:, 0][faces], fixed[:, 1][faces]


def _chunks(cost: np.ndarray, limit: int) -> Iterator[slice]:
    """Yield consecutive slices of cost (n,) whose sums stay near limit; each holds at least one element."""
    total = np.cumsum(cost)
    start = 0
    while start < len(cost):
        base = total[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(total, base + limit, "right")))
        yield slice(start, stop)
        start = stop


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Enumerate the elements of groups of counts (n,): the group of each element, and its index in the group."""
    group = np.repeat(np.arange(len(counts)), counts)
    first = np.cumsum(counts) - counts
    return group, np.arange(len(group)) - first[group]


def owned_texels(uv: np.ndarray, faces: np.ndarray, size: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield batches of face_idx (n,), row (n,), column (n,): all texels whose centre a triangle owns, by triangle.

    uv (v, 2), (0, 0) at the image's top left; faces (t, 3) into uv. Triangles may turn either way; those without area
    own nothing. A texel appears once for each triangle that covers it: more than once only where triangles overlap.
    """
    x, y = _snapped(uv, faces, size)
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    turned = area < 0
    x[turned] = x[turned][:, [0, 2, 1]]
    y[turned] = y[turned][:, [0, 2, 1]]
    half = _ONE // 2
    # Rows whose centre line y = row + 1/2 lies within the triangle's height.
    top = np.clip(-((half - y.min(1)) // _ONE), 0, size)
    bottom = np.clip((y.max(1) - half) // _ONE + 1, 0, size)
    rows = np.where(area == 0, 0, np.maximum(bottom - top, 0))
    for part in _chunks(rows, _SPANS_AT_ONCE):
        group, step = _expand(rows[part])
        face = group + part.start
        row = top[face] + step
        centre = row * _ONE + half
        left, right = np.zeros(len(face), np.int64), np.full(len(face), size, np.int64)
        for i in range(3):
            xa, ya = x[face, i], y[face, i]
            dx, dy = x[face, (i + 1) % 3] - xa, y[face, (i + 1) % 3] - ya
            # Inside where dx (Y - ya) - dy (X - xa) >= 0, or > 0 on edges that are neither top nor left (y is down).
            bias = np.where((dy < 0) | ((dy == 0) & (dx > 0)), 0, -1)
            constant = dx * (centre - ya) - dy * (half - xa) + bias
            slope = -dy * _ONE
            safe = np.where(slope == 0, 1, np.abs(slope))
            left = np.where(slope > 0, np.maximum(left, -(constant // safe)), left)
            right = np.where(slope < 0, np.minimum(right, constant // safe + 1), right)
            right = np.where((slope == 0) & (constant < 0), 0, right)
        counts = np.maximum(right - left, 0)
        for piece in _chunks(counts, _TEXELS_AT_ONCE):
            span, offset = _expand(counts[piece])
            span = span + piece.start
            yield face[span].astype(np.int32), row[span].astype(np.int32), (left[span] + offset).astype(np.int32)


class Barycentrics:
    """Compute barycentric coordinates of texture points in triangles; coefficients of each triangle are kept.

    uv (v, 2), faces (t, 3) into uv. Triangles without area give their first corner.
    """

    def __init__(self, uv: np.ndarray, faces: np.ndarray):
        a, b, c = (np.asarray(uv, np.float64)[faces[:, i]] for i in range(3))
        e1, e2 = b - a, c - a
        det = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
        inverse = np.where(det == 0, 0.0, 1.0 / np.where(det == 0, 1.0, det))
        self._of_face = np.stack(
            [a[:, 0], a[:, 1], e2[:, 1] * inverse, -e2[:, 0] * inverse, -e1[:, 1] * inverse, e1[:, 0] * inverse], 1
        )

    def at(self, face_idx: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return (n, 3) float64 for texture points u, v (n,) in triangles face_idx (n,); linear outside them."""
        face = np.take(self._of_face, face_idx, axis=0)
        u, v = u - face[:, 0], v - face[:, 1]
        out = np.empty((len(face), 3))
        out[:, 1] = u * face[:, 2] + v * face[:, 3]
        out[:, 2] = u * face[:, 4] + v * face[:, 5]
        out[:, 0] = 1 - out[:, 1] - out[:, 2]
        return out

    def at_centres(self, face_idx: np.ndarray, texel: np.ndarray, size: int) -> np.ndarray:
        """Return (n, 3) float64 for the centres of texels (n,), row-major indices into a size x size map."""
        row, column = np.divmod(texel, size)
        return self.at(face_idx, (column + 0.5) / size, (row + 0.5) / size)


def owners_of(uv: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """Return the triangle that owns each texel, (size * size,) int32; -1 where none covers its centre.

    Where several do, the first owns it. uv (v, 2) with (0, 0) at the image's top left, faces (t, 3). Raises ValueError
    for coordinates that are not finite or beyond ±64.
    """
    owner = np.full(size * size, -1, np.int32)
    for face, row, column in owned_texels(uv, faces, size):
        texel = row.astype(np.int64) * size + column
        free = owner[texel] < 0
        # Reversed: of several assignments to one element the last one stays.
        owner[texel[free][::-1]] = face[free][::-1]
    return owner


def rasterize_uv(uv: np.ndarray, faces: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the owner of each texel and the barycentric coordinates of the texel's centre in it.

    Returns face_idx (size, size) int32, as owners_of() does, and barycentric (size, size, 3) float32, 0 without owner.
    """
    owner = owners_of(uv, faces, size)
    covered = np.flatnonzero(owner >= 0)
    barycentric = np.zeros((size * size, 3), np.float32)
    barycentric[covered] = centres_in(Barycentrics(uv, faces), owner[covered], covered, size)
    return owner.reshape(size, size), barycentric.reshape(size, size, 3)


def centres_in(barycentrics: Barycentrics, owner: np.ndarray, texel: np.ndarray, size: int) -> np.ndarray:
    """Return barycentric coordinates (n, 3) float32 of the centres of texels (n,) in their owners (n,)."""
    out = np.empty((len(texel), 3), np.float32)
    for start in range(0, len(texel), _TEXELS_AT_ONCE):
        part = slice(start, start + _TEXELS_AT_ONCE)
        # Snapping moves corners by up to 1/8192 of a texel.
        inside = np.clip(barycentrics.at_centres(owner[part], texel[part], size), 0, 1)
        out[part] = inside / (inside[:, 0] + inside[:, 1] + inside[:, 2])[:, None]
    return out


def owner_count(uv: np.ndarray, faces: np.ndarray, size: int) -> np.ndarray:
    """Count the triangles that cover each texel centre, (size, size) int32; above 1 where charts overlap."""
    count = np.zeros(size * size, np.int32)
    for _, row, column in owned_texels(uv, faces, size):
        count += np.bincount(row.astype(np.int64) * size + column, minlength=size * size).astype(np.int32)
    return count.reshape(size, size)


def between_centres(uv: np.ndarray, faces: np.ndarray, owner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the texels that a chart's outline passes through where no texel nearby has an owner.

    Charts smaller than a texel, and the ends of slivers, cover no texel's centre. Lookups there would read what lies
    around neighbouring charts. Texels next to owned ones are left out, since extend_owners() fills them. owner (size,
    size) as from owners_of(). Returns texel (n,), row-major indices, and the triangle (n,) there.
    """
    from gdtool.geometry.topology import edges_of

    size, wide = owner.shape[0], owner.shape[0] + 2
    edges = edges_of(faces)
    rim = np.flatnonzero(edges.count[edges.half_edge_idx] == 1)
    start, end = (np.asarray(uv, np.float64)[edges.half_ends[rim, i]] * size for i in (0, 1))
    # Every half texel along the charts' outlines.
    counts = np.ceil(2 * np.linalg.norm(end - start, axis=1)).astype(np.int64) + 1
    edge, step = _expand(counts)
    at = start[edge] + (end - start)[edge] * (step / np.maximum(counts - 1, 1)[edge])[:, None]
    inside = ((at >= 0) & (at < size)).all(1)
    column, row = at[inside].astype(np.int64).T
    covered = np.pad(owner >= 0, 1).ravel()
    padded_idx = (row + 1) * wide + column + 1
    lone = ~np.any([covered[padded_idx + down + along] for down in (-wide, 0, wide) for along in (-1, 0, 1)], 0)
    texel, first = np.unique((row * size + column)[lone], return_index=True)
    return texel, edges.half_face[rim[edge[inside][lone][first]]].astype(np.int32)


def extend_owners(
    barycentrics: Barycentrics, face_idx: np.ndarray, rings: int, farthest: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Extend the charts' triangles to texels just outside, which lookups at a chart's border read.

    face_idx (size, size) as from rasterize_uv(). rings: how many texels wide the extension is; each ring is one texel
    around the one before. Returns texel (n,), row-major indices of the texels around all charts; owner (n,), the face
    of the nearest texel of the ring before; and barycentric (n, 3) float64, linearly extrapolated and clamped to
    `farthest` outside [0, 1].
    """
    size = face_idx.shape[0]
    owner = np.pad(face_idx, 1, constant_values=-1)
    flat, wide = owner.ravel(), size + 2
    texels, owners = [np.empty(0, np.int64)], [np.empty(0, np.int32)]
    covered = owner >= 0
    for _ in range(rings):
        rows = covered.copy()
        rows[1:] |= covered[:-1]
        rows[:-1] |= covered[1:]
        near = rows.copy()
        near[:, 1:] |= rows[:, :-1]
        near[:, :-1] |= rows[:, 1:]
        near &= ~covered
        near[[0, -1]], near[:, [0, -1]] = False, False
        new = np.flatnonzero(near)
        new_owner = np.full(len(new), -1, np.int32)
        # Straight neighbours come last, so that they win over diagonal ones.
        for step in (-wide - 1, -wide + 1, wide - 1, wide + 1, -1, 1, -wide, wide):
            beside = flat[new + step]
            new_owner = np.where(beside >= 0, beside, new_owner)
        flat[new] = new_owner
        covered |= near
        texels.append((new // wide - 1) * size + new % wide - 1)
        owners.append(new_owner)
    texel, owned_by = np.concatenate(texels), np.concatenate(owners)
    barycentric = barycentrics.at_centres(owned_by, texel, size)
    within = np.clip(barycentric, 0, 1)
    within /= within.sum(1, keepdims=True)
    # Coordinates far outside a sliver reach many times its width: clamp their distance, not their direction.
    beyond = np.abs(barycentric - within).max(1, keepdims=True)
    return texel, owned_by, within + (barycentric - within) * np.minimum(1, farthest / np.maximum(beyond, 1e-12))
