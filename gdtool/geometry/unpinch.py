"""Sheets of a closed mesh that meet in an edge, parted."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.geometry.topology import Edges, corner_fans, edges_of


def unpinched(vertices: np.ndarray, faces: np.ndarray, rounds: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed triangle mesh two sheets of which share an edge, with a copy of the edge and its ends for each
    sheet.

    faces (f, 3). Faces on both sides of one wedge of the inside stay together; what comes off is a piece of its own.
    Edges of an odd number of faces, or of more one way than the other, are left."""
    edges = edges_of(faces)
    pinched = np.flatnonzero((edges.count > 2) & (edges.count % 2 == 0))
    if not len(pinched):
        return one_vertex_per_fan(vertices, faces)
    # Only the faces around the ends of these edges are looked at.
    end = np.zeros(len(vertices), bool)
    end[edges.ends[pinched]] = True
    near = np.flatnonzero(end[faces].any(1))
    own = faces[near]
    edges = edges_of(own)
    pinched = np.flatnonzero((edges.count > 2) & (edges.count % 2 == 0))
    first = np.cumsum(edges.count) - edges.count
    mates = []
    for edge in pinched.tolist():
        half = edges.order[first[edge] : first[edge] + edges.count[edge]]
        a, b = vertices[edges.ends[edge]]
        along = b - a
        x = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 * np.linalg.norm(along) else [0.0, 1.0, 0.0])
        y = np.cross(along, x)
        tip = vertices[own[edges.half_face[half]].sum(1) - edges.ends[edge].sum()] - a
        angle = np.arctan2(tip @ y / max(np.linalg.norm(y), 1e-300), tip @ x / max(np.linalg.norm(x), 1e-300))
        half = half[np.argsort(angle, kind="stable")]
        forward = edges.half_ends[half, 0] == edges.ends[edge, 0]
        if 2 * int(forward.sum()) != len(half):
            continue
        # About the edge the inside begins at a backward face and ends at the next forward one.
        depth = np.cumsum(np.where(forward, -1, 1))
        half = np.roll(half, -(int(depth.argmin()) + 1))
        forward = edges.half_ends[half, 0] == edges.ends[edge, 0]
        opened: list[int] = []
        for h, closes in zip(half.tolist(), forward.tolist(), strict=True):
            if closes:
                mates.append((opened.pop(), h))
            else:
                opened.append(h)
    pairs = np.array(mates, np.int64).reshape(-1, 2)
    fans = faces.astype(np.int64)
    fans[near] = np.where(end[own], len(vertices) + corner_fans(own, pairs)[0], own)
    out, found = one_vertex_per_fan(vertices, faces, fans)
    if not rounds:
        return out, found
    if (edges_of(found).count > 2).any():
        # Two sheets with both ends in common besides: a vertex of its own in the middle of each tells them apart.
        out, found = _halved(vertices, faces, near, edges, pairs)
    return unpinched(out, found, rounds - 1)


def _halved(
    vertices: np.ndarray, faces: np.ndarray, near: np.ndarray, edges: Edges, mates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Each pair of half edges (k, 2) of the faces `near` with a vertex of its own in the middle, its two triangles cut
    in two."""
    touched, more, points = set(), [], []
    faces = faces.copy()
    for pair in mates.tolist():
        own = near[edges.half_face[pair]].tolist()
        if touched & set(own) or own[0] == own[1]:
            continue  # the next round
        touched.update(own)
        middle = len(vertices) + len(points)
        points.append(vertices[edges.half_ends[pair[0]]].mean(0))
        for h, f in zip(pair, own, strict=True):
            a, b = edges.half_ends[h]
            more.append(np.where(faces[f] == a, middle, faces[f]))
            faces[f] = np.where(faces[f] == b, middle, faces[f])
    if not points:
        return vertices, faces
    return np.concatenate([vertices, points]), np.concatenate([faces, more])
