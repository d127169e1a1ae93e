"""Separate sheets of a closed mesh that share an edge."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.repair import one_vertex_per_fan
from gdtool.geometry.topology import Edges, corner_fans, edges_of


def separate_sheets(mesh: TriMesh, rounds: int = 3) -> TriMesh:
    """Give each sheet of a closed mesh its own copy of the edges where several sheets meet.

    Faces on both sides of one wedge of the inside stay connected. A sheet that is connected nowhere else becomes a
    piece of its own. Edges with an odd number of faces, or with more faces in one direction than in the other, are
    left. rounds: how often the pass is repeated on edges that it could not separate at once.
    """
    vertices, faces = mesh.vertices, mesh.faces
    edges = edges_of(faces)
    shared = _shared_edges(edges)
    if not len(shared):
        return one_vertex_per_fan(mesh)
    # Only the faces around the ends of these edges are looked at.
    is_end = np.zeros(len(vertices), bool)
    is_end[edges.ends[shared]] = True
    near = np.flatnonzero(is_end[faces].any(1))
    near_faces = faces[near]
    edges = edges_of(near_faces)
    pairs = _wedge_pairs(TriMesh(vertices, near_faces), edges)
    fans = faces.astype(np.int64)
    fans[near] = np.where(is_end[near_faces], len(vertices) + corner_fans(near_faces, pairs)[0], near_faces)
    separated = one_vertex_per_fan(mesh, fans)
    if not rounds:
        return separated
    if (edges_of(separated.faces).count > 2).any():
        # Two sheets that share both ends of another edge too: a vertex in the middle of each side tells them apart.
        separated = _split_pairs(mesh, near, edges, pairs)
    return separate_sheets(separated, rounds - 1)


def _shared_edges(edges: Edges) -> np.ndarray:
    """Return the edges (k,) with an even number of faces greater than two."""
    return np.flatnonzero((edges.count > 2) & (edges.count % 2 == 0))


def _wedge_pairs(mesh: TriMesh, edges: Edges) -> np.ndarray:
    """Pair the half edges at each shared edge whose faces bound one wedge of the inside; (k, 2) indices."""
    vertices, faces = mesh.vertices, mesh.faces
    first = np.cumsum(edges.count) - edges.count
    pairs = []
    for edge in _shared_edges(edges).tolist():
        half = edges.order[first[edge] : first[edge] + edges.count[edge]]
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
        # Around the edge the inside begins at a backward face and ends at the next forward one.
        depth = np.cumsum(np.where(forward, -1, 1))
        half = np.roll(half, -(int(depth.argmin()) + 1))
        forward = edges.half_ends[half, 0] == edges.ends[edge, 0]
        opened: list[int] = []
        for h, closes in zip(half.tolist(), forward.tolist(), strict=True):
            if closes:
                pairs.append((opened.pop(), h))
            else:
                opened.append(h)
    return np.array(pairs, np.int64).reshape(-1, 2)


def _split_pairs(mesh: TriMesh, near: np.ndarray, edges: Edges, pairs: np.ndarray) -> TriMesh:
    """Add a vertex in the middle of each pair of half edges (k, 2), and cut its two triangles there.

    edges: of the faces `near` (n,) of the mesh only; pairs index into its half edges.
    """
    vertices, faces = mesh.vertices, mesh.faces.copy()
    touched: set[int] = set()
    new_faces: list[np.ndarray] = []
    new_vertices: list[np.ndarray] = []
    for pair in pairs.tolist():
        pair_faces = near[edges.half_face[pair]].tolist()
        if touched & set(pair_faces) or pair_faces[0] == pair_faces[1]:
            continue  # left for the next round
        touched.update(pair_faces)
        middle = len(vertices) + len(new_vertices)
        new_vertices.append(vertices[edges.half_ends[pair[0]]].mean(0))
        for h, f in zip(pair, pair_faces, strict=True):
            a, b = edges.half_ends[h]
            new_faces.append(np.where(faces[f] == a, middle, faces[f]))
            faces[f] = np.where(faces[f] == b, middle, faces[f])
    if not new_vertices:
        return TriMesh(vertices, faces)
    return TriMesh(np.concatenate([vertices, new_vertices]), np.concatenate([faces, new_faces]))
