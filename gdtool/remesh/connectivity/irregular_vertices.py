"""Collapse quads along a diagonal where that leaves fewer irregular vertices (those without exactly four edges)."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import valences
from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import compact


def cancel_irregular(mesh: QuadMesh, rounds: int = 4) -> QuadMesh:
    """Collapse quads along a diagonal wherever that leaves fewer irregular vertices.

    The merged vertex has two edges fewer than its two ends together, and the quad's other two corners lose one each
    (Daniels et al. 2008, quad-vertex merge). A quad is collapsed only where the mesh around it stays a manifold, and
    not beside another that collapses in the same round.
    """
    vertices, faces = mesh.vertices, mesh.faces
    for _ in range(rounds):
        valence, inner = valences(faces, len(vertices))
        valence_of_corner = valence[faces]
        before = _is_irregular(valence_of_corner).sum(1)
        gain = np.stack(
            [
                before
                - _is_irregular(valence_of_corner[:, i] + valence_of_corner[:, i + 2] - 2)
                - _is_irregular(valence_of_corner[:, 1 - i] - 1)
                - _is_irregular(valence_of_corner[:, 3 - i] - 1)
                for i in (0, 1)
            ],
            1,
        )
        usable = inner[faces].all(1) & (valence_of_corner > 2).all(1)
        gain[~usable] = 0
        # The corners that lose an edge keep three.
        gain[:, 0][(valence_of_corner[:, [1, 3]] < 4).any(1)] = 0
        gain[:, 1][(valence_of_corner[:, [0, 2]] < 4).any(1)] = 0
        candidates = np.flatnonzero(gain.max(1) > 0)
        if not len(candidates):
            break
        around = _rings(faces, len(vertices), faces[candidates].ravel())
        used = np.zeros(len(vertices), bool)
        merged_into, dead = np.arange(len(vertices)), []
        for f in candidates[np.argsort(-gain[candidates].max(1), kind="stable")].tolist():
            i = int(gain[f].argmax())
            a, b, c, d = faces[f, i], faces[f, (i + 1) % 4], faces[f, i + 2], faces[f, (i + 3) % 4]
            near = around[a] | around[c]
            # Two vertices that share more than this quad would merge into a doubled edge or a pinched fan.
            if used[list(near)].any() or (around[a] & around[c]) - {a, b, c, d}:
                continue
            used[list(near)] = True
            merged_into[c] = a
            dead.append(f)
        if not dead:
            break
        vertices = vertices.copy()
        merged = np.flatnonzero(merged_into != np.arange(len(vertices)))
        vertices[merged_into[merged]] = (vertices[merged_into[merged]] + vertices[merged]) / 2
        mesh = compact(QuadMesh(vertices, merged_into[np.delete(faces, dead, 0)]))
        vertices, faces = mesh.vertices, mesh.faces
    return mesh


def _is_irregular(valence: np.ndarray) -> np.ndarray:
    """Return 1 where a valence is not four, else 0."""
    return (valence != 4).astype(np.int64)


def _rings(faces: np.ndarray, count: int, wanted: np.ndarray) -> dict[int, set[int]]:
    """Gather for each wanted vertex all vertices of the faces around it, itself included.

    count: the number of vertices of the mesh.
    """
    marked = np.zeros(count, bool)
    marked[wanted] = True
    rings: dict[int, set[int]] = {}
    for face in faces[marked[faces].any(1)].tolist():
        for v in face:
            if marked[v]:
                rings.setdefault(v, set()).update(face)
    return rings
