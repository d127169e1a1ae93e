"""Both halves of a symmetric mesh on the same texels: half of it is unwrapped, the other half takes its twins'
corners."""

from __future__ import annotations

import numpy as np

_NEAR = 1e-4  # of the longest side: how near its twin's mirror image a vertex has to lie


def mirror_twins(vertices: np.ndarray, faces: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """For faces (f, 4), -1 as a triangle's fourth corner, mirrored in the middle of vertices (v, 3) along axis.

    Returns twin (f,): for a face of the lower half the face of the upper half that mirrors it, -1 for all others (upper
    faces, faces across the middle, and those without a twin); and corner (f, 4): which of its twin's corners each of
    its corners is, -1 where there is none."""
    from scipy.spatial import cKDTree

    used = np.unique(faces[faces >= 0])
    low, high = vertices[used].min(0), vertices[used].max(0)
    image = vertices[used].copy()
    image[:, axis] = low[axis] + high[axis] - image[:, axis]
    far, near = cKDTree(vertices[used]).query(image)
    mirror = np.full(len(vertices) + 1, -2)  # the last one is for the corner -1
    mirror[used] = np.where(far < _NEAR * float((high - low).max()), used[near], -2)
    mirrored = mirror[faces]
    mirrored[faces < 0] = -1
    centre = vertices[np.where(faces < 0, faces[:, :1], faces)][..., axis].mean(1) - (low[axis] + high[axis]) / 2
    key = {tuple(sorted(face)): i for i, face in enumerate(faces.tolist())}
    twin, corner = np.full(len(faces), -1), np.full(faces.shape, -1)
    slack = _NEAR * float((high - low).max())
    for i in np.flatnonzero((centre < -slack) & (mirrored > -2).all(1)).tolist():
        j = key.get(tuple(sorted(mirrored[i].tolist())), -1)
        if j >= 0 and centre[j] > slack:
            twin[i] = j
            corner[i] = [faces[j].tolist().index(vertex) if vertex >= 0 else -1 for vertex in mirrored[i].tolist()]
    return twin, corner


def with_twins(face_uvs: np.ndarray, kept: np.ndarray, twin: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Texture corners (f, 4) of all faces from those (k, 4) of the kept ones (k,): each other face has its twin's."""
    out = np.full(corner.shape, -1, face_uvs.dtype)
    out[kept] = face_uvs
    other = np.flatnonzero(twin >= 0)
    taken = np.take_along_axis(out[twin[other]], np.maximum(corner[other], 0), 1)
    out[other] = np.where(corner[other] >= 0, taken, -1)
    return out
