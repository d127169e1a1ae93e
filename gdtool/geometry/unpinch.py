"""Sheets of a closed mesh that meet in an edge, parted."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.repair import Edges, components, corner_fans, edges_of, one_vertex_per_fan, without_crumbs


def unpinched(vertices: np.ndarray, faces: np.ndarray, rounds: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """A closed triangle mesh two sheets of which share an edge, with a copy of the edge and its ends for each sheet.

    faces (f, 3). Faces on both sides of one wedge of the inside stay together; crumbs that come off are dropped. Edges of
    an odd number of faces, or of more one way than the other, are left.
    """
    edges = edges_of(faces)
    pinched = np.flatnonzero((edges.count > 2) & (edges.count % 2 == 0))
    if not len(pinched):
        return one_vertex_per_fan(vertices, faces)
    first = np.cumsum(edges.count) - edges.count
    mates = []
    for edge in pinched.tolist():
        half = edges.order[first[edge]:first[edge] + edges.count[edge]]
        a, b = vertices[edges.ends[edge]]
        along = b - a
        x = np.cross(along, [1.0, 0.0, 0.0] if abs(along[0]) < 0.9 * np.linalg.norm(along) else [0.0, 1.0, 0.0])
        y = np.cross(along, x)
        tip = vertices[faces[edges.half_face[half]].sum(1) - edges.ends[edge].sum()] - a
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
    pieces = components(faces)[0]
    out, found = without_crumbs(*one_vertex_per_fan(vertices, faces, corner_fans(faces, pairs)[0]), pieces)
    if rounds and (edges_of(found).count > 2).any():
        # Two sheets with both ends in common besides: a vertex of its own in the middle of each tells them apart.
        return unpinched(*_halved(vertices, faces, edges, pairs), rounds - 1)
    return out, found


def _halved(vertices: np.ndarray, faces: np.ndarray, edges: Edges, mates: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each pair of half edges (k, 2) with a vertex of its own in the middle, its two triangles cut in two."""
    touched, more, points = set(), [], []
    faces = faces.copy()
    for pair in mates.tolist():
        own = edges.half_face[pair].tolist()
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
