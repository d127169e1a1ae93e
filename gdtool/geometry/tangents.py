"""Compute tangent frames by the MikkTSpace algorithm (Mikkelsen 2008, "Simulation of Wrinkled Surfaces Revisited").

This is section 3.7 of that thesis. glTF viewers decode normal maps in this basis whether a file carries tangents or
not, so a baker has to encode in it. The steps follow the algorithm's reference description:

1. Corners with identical position, normal and texture coordinate are one vertex.

2. Around each vertex, triangles that are connected by edges and have the same orientation in texture space form a
group.

3. A group's tangent is the sum of its triangles' texture axes, each projected to the tangent plane, normalised and
weighted by the corner's angle.

Triangles without area in texture space take the frame of a neighbour at the vertex. Unlike in the reference
implementation they never join two groups that touch only through them.
"""

from __future__ import annotations

import numpy as np

from gdtool.geometry.meshes import TriMesh


def number_distinct_rows(*columns: np.ndarray) -> np.ndarray:
    """Return for each row (n,) of columns (n, k_i), side by side, the number of its distinct value, from 0.

    Rows are equal where they are as float32, bit by bit; 0 and -0 are equal.
    """
    rows = np.concatenate([np.ascontiguousarray(c).reshape(len(c), -1).astype(np.float32) + 0.0 for c in columns], 1)
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.dtype.itemsize * rows.shape[1]))).ravel()
    return np.unique(keys, return_inverse=True)[1].ravel()


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return scalar products (...,) of vectors (..., c).

    numpy's sum over a short last axis takes several times as long.
    """
    return np.einsum("...c,...c->...", a, b)


def unit(v: np.ndarray) -> np.ndarray:
    """Scale vectors (..., c) to length 1; those of length 0 stay 0."""
    length = np.sqrt(dot(v, v))[..., None]
    return v / np.where(length > 0, length, 1.0)


def _flatten(v: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Project vectors v to the planes with unit normals n, and scale them to length 1."""
    return unit(v - n * dot(n, v)[..., None])


def edge_pairs(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pair the half edges of triangles (t, 3) that run along one edge in opposite directions.

    Returns both half edges (m,) of each pair. Half edge 3 t + k of triangle t runs from its corner k to the next. An
    edge with more than two faces gives one pair at most.
    """
    start, end = faces.ravel(), np.roll(faces, -1, 1).ravel()
    low, high, forward = np.minimum(start, end).astype(np.int64), np.maximum(start, end).astype(np.int64), start < end
    key = (low * (high.max(initial=0) + 1) + high) * 2 + ~forward
    order = np.argsort(key, kind="stable")
    edge = key[order] // 2
    pair = np.flatnonzero((edge[1:] == edge[:-1]) & (forward[order][1:] != forward[order][:-1]))
    return order[pair], order[pair + 1]


def _groups(vertex: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return the group (t, 3) of each corner of triangles.

    A group is the corners at one vertex (vertex (t, 3)) whose triangles are connected by edges and have the same sign
    (t,), which is not 0.
    """
    count = len(vertex)
    first, second = edge_pairs(vertex)
    fits = (sign[first // 3] == sign[second // 3]) & (sign[first // 3] != 0)
    first, second = first[fits], second[fits]
    following = np.arange(count * 3).reshape(count, 3)[:, [1, 2, 0]].ravel()
    a, b = np.concatenate([first, following[first]]), np.concatenate([following[second], second])
    return label_connected(count * 3, a, b).reshape(count, 3)


def label_connected(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Label the connected components of a graph of `count` nodes with edges a, b (m,); (count,) labels from 0.

    Every node takes the smallest label beside it, and then its label's label, until nothing changes. Quicker here than
    importing scipy.sparse, which takes a quarter of a second.
    """
    label = np.arange(count)
    while len(a):
        low, high = np.minimum(label[a], label[b]), np.maximum(label[a], label[b])
        apart = low != high
        if not apart.any():
            break
        a, b = a[apart], b[apart]
        np.minimum.at(label, high[apart], low[apart])
        while not np.array_equal(label, shorter := label[label]):
            label = shorter
    root = label == np.arange(count)
    return (np.cumsum(root) - 1)[label]


def corner_tangents(
    mesh: TriMesh,
    normals: np.ndarray,
    uv: np.ndarray,
    face_uvs: np.ndarray,
    face_normals_idx: np.ndarray | None = None,
) -> np.ndarray:
    """Compute tangents (t, 3, 4) float32 of the corners of triangles, as glTF stores them.

    normals (n, 3) unit, indexed by face_normals_idx (t, 3), or one for each vertex; uv (c, 2) with (0, 0) at the
    image's top left, indexed by face_uvs (t, 3). xyz is unit and orthogonal to the corner's normal; the bitangent
    w · cross(normal, tangent) points up in the image. Corners whose vertex has no triangle with area in texture space
    get some tangent orthogonal to the normal and w = 1.
    """
    faces = mesh.faces
    position = np.asarray(mesh.vertices, np.float64)[faces]
    normal = unit(np.asarray(normals, np.float64)[faces if face_normals_idx is None else face_normals_idx])
    texture = np.asarray(uv, np.float64)[face_uvs] * (1, -1) + (0, 1)
    vertex = number_distinct_rows(position.reshape(-1, 3), normal.reshape(-1, 3), texture.reshape(-1, 2)).reshape(-1, 3)

    e1, e2 = position[:, 1] - position[:, 0], position[:, 2] - position[:, 0]
    t1, t2 = texture[:, 1] - texture[:, 0], texture[:, 2] - texture[:, 0]
    area = t1[:, 0] * t2[:, 1] - t1[:, 1] * t2[:, 0]
    solid = np.linalg.norm(np.cross(e1, e2), axis=1) > 0
    axis = (t2[:, 1:] * e1 - t1[:, 1:] * e2) * np.sign(area)[:, None]
    usable = solid & (np.abs(area) > np.finfo(np.float32).tiny) & ((axis * axis).sum(1) > 0)
    sign = np.where(usable, np.where(area > 0, 1, -1), 0)
    group = _groups(vertex, sign)

    tangent = _flatten(np.repeat(axis[:, None], 3, 1), normal)
    before = _flatten(np.roll(position, 1, 1) - position, normal)
    after = _flatten(np.roll(position, -1, 1) - position, normal)
    angle = np.arccos(np.clip(dot(before, after), -1, 1))
    weighted = (tangent * np.where(usable[:, None], angle, 0)[..., None]).reshape(-1, 3)
    total = np.stack([np.bincount(group.ravel(), weighted[:, k], group.max(initial=-1) + 1) for k in range(3)], 1)
    frame = unit(total)[group]
    handed = np.repeat(sign[:, None], 3, 1).astype(np.float64)

    # Corners of triangles without usable texture coordinates borrow from the first usable corner of their vertex.
    lender = np.full(vertex.max(initial=-1) + 1, -1)
    good = np.flatnonzero(np.repeat(usable, 3))
    lender[vertex.ravel()[good][::-1]] = good[::-1]
    lent = lender[vertex]
    borrow = ~usable[:, None] & (lent >= 0)
    frame = np.where(borrow[..., None], frame.reshape(-1, 3)[lent], frame)
    handed = np.where(borrow, handed.reshape(-1)[lent], handed)

    frame = _flatten(frame, normal)
    lost = np.linalg.norm(frame, axis=-1) < 0.5
    if lost.any():
        helper = np.eye(3)[np.abs(normal[lost]).argmin(1)]
        frame[lost] = _flatten(helper, normal[lost])
    return np.concatenate([frame, np.where(handed < 0, -1.0, 1.0)[..., None]], -1).astype(np.float32)


def tangent_frames(normal: np.ndarray, tangent: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Build frames (n, 3, 3), columns tangent, bitangent, normal, from interpolated normals and tangents (n, 3).

    sign (n,): handedness. Nothing is normalised after interpolation, as MikkTSpace requires, so that encoder and
    decoder use the same basis.
    """
    return np.stack([tangent, np.cross(normal, tangent) * sign[:, None], normal], -1)


def encode_tangent_space(normal: np.ndarray, tangent: np.ndarray, sign: np.ndarray, world: np.ndarray) -> np.ndarray:
    """Return unit tangent-space normals (n, 3), +Y up, that decode to unit world normals (n, 3).

    normal and tangent (n, 3), interpolated, need be neither unit nor orthogonal; the bitangent is
    sign (n,) · cross(normal, tangent).
    """
    across = np.empty_like(normal)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        across[:, k] = normal[:, i] * tangent[:, j] - normal[:, j] * tangent[:, i]
    nn, tt, nt = dot(normal, normal), dot(tangent, tangent), dot(normal, tangent)
    along, up = dot(world, tangent), dot(world, normal)
    # The inverse of the frame, up to a positive factor: the dual of each axis from products of the other two.
    out = np.stack([along * nn - up * nt, sign * dot(world, across), up * tt - along * nt]).T
    lost = nn * tt - nt * nt <= 1e-9
    if lost.any():
        out[lost] = (0.0, 0.0, 1.0)
    return unit(out)


def decode_tangent_space(frames: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Return unit world normals (n, 3) of tangent-space normals (n, 3), +Y up, in frames (n, 3, 3)."""
    return unit(np.einsum("...ck,...k->...c", frames, local))
