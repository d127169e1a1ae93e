"""Fewer irregular vertices in a quad mesh by local changes of its connections."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.mesh_quality import valences
from gdtool.geometry.topology import compact


def cancel_irregular(vertices: np.ndarray, faces: np.ndarray, rounds: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Quads (q, 4) closed across a diagonal, its ends drawn together, wherever that leaves fewer irregular vertices.

    The merged vertex has two edges fewer than its two had, the other corners lose one each (Daniels et al. 2008,
    quad-vertex merge). Only where the quads around stay a manifold, and no quad next to another that closes.
    """
    for _ in range(rounds):
        valence, inner = valences(faces, len(vertices))
        odd = lambda number: (number != 4).astype(np.int64)  # noqa: E731
        v = valence[faces]
        before = odd(v).sum(1)
        gain = np.stack(
            [before - odd(v[:, i] + v[:, i + 2] - 2) - odd(v[:, 1 - i] - 1) - odd(v[:, 3 - i] - 1) for i in (0, 1)], 1
        )
        usable = inner[faces].all(1) & (v > 2).all(1)
        gain[~usable] = 0
        # The corners that lose an edge keep three.
        gain[:, 0][(v[:, [1, 3]] < 4).any(1)] = 0
        gain[:, 1][(v[:, [0, 2]] < 4).any(1)] = 0
        asked = np.flatnonzero(gain.max(1) > 0)
        if not len(asked):
            break
        around = _rings(faces, len(vertices), faces[asked].ravel())
        used = np.zeros(len(vertices), bool)
        onto, dead = np.arange(len(vertices)), []
        for f in asked[np.argsort(-gain[asked].max(1), kind="stable")].tolist():
            i = int(gain[f].argmax())
            a, b, c, d = faces[f, i], faces[f, (i + 1) % 4], faces[f, i + 2], faces[f, (i + 3) % 4]
            near = around[a] | around[c]
            # Two vertices that share more than this quad would become one with a doubled edge or a pinched fan.
            if used[list(near)].any() or (around[a] & around[c]) - {a, b, c, d}:
                continue
            used[list(near)] = True
            onto[c] = a
            dead.append(f)
        if not dead:
            break
        vertices = vertices.copy()
        merged = np.flatnonzero(onto != np.arange(len(vertices)))
        vertices[onto[merged]] = (vertices[onto[merged]] + vertices[merged]) / 2
        vertices, faces = compact(vertices, onto[np.delete(faces, dead, 0)])
    return vertices, faces


def _rings(faces: np.ndarray, count: int, wanted: np.ndarray) -> dict[int, set[int]]:
    """All vertices of the faces around each wanted vertex, itself included."""
    marked = np.zeros(count, bool)
    marked[wanted] = True
    out: dict[int, set[int]] = {}
    for face in faces[marked[faces].any(1)].tolist():
        for v in face:
            if marked[v]:
                out.setdefault(v, set()).update(face)
    return out
