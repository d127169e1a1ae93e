"""Let both halves of a symmetric mesh share texels: one half is unwrapped, and the other copies its coordinates."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.meshes import QuadMesh

_TOLERANCE = 1e-4  # of the longest side: how near to a vertex the mirror image of its twin has to lie


def mirror_twins(mesh: QuadMesh, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Match each face of the lower half with its mirror image in the upper half.

    The plane is across `axis`, through the middle of the bounding box. Returns twin (f,): the face of the upper half
    that mirrors a face of the lower half. It is -1 for all others: upper faces, faces across the middle, faces without
    a twin. Also returns corner (f, 4): the corner of the twin that mirrors each corner, -1 where there is none.
    """
    vertices, faces = mesh.vertices, mesh.faces
    from scipy.spatial import cKDTree

    used = np.unique(faces[faces >= 0])
    low, high = vertices[used].min(0), vertices[used].max(0)
    image = vertices[used].copy()
    image[:, axis] = low[axis] + high[axis] - image[:, axis]
    distance, near = cKDTree(vertices[used]).query(image)
    mirror = np.full(len(vertices) + 1, -2)  # the last row is for the corner -1
    mirror[used] = np.where(distance < _TOLERANCE * float((high - low).max()), used[near], -2)
    mirrored = mirror[faces]
    mirrored[faces < 0] = -1
    centre = vertices[np.where(faces < 0, faces[:, :1], faces)][..., axis].mean(1) - (low[axis] + high[axis]) / 2
    key = {tuple(sorted(face)): i for i, face in enumerate(faces.tolist())}
    twin, corner = np.full(len(faces), -1), np.full(faces.shape, -1)
    slack = _TOLERANCE * float((high - low).max())
    for i in np.flatnonzero((centre < -slack) & (mirrored > -2).all(1)).tolist():
        j = key.get(tuple(sorted(mirrored[i].tolist())), -1)
        if j >= 0 and centre[j] > slack:
            twin[i] = j
            corner[i] = [faces[j].tolist().index(vertex) if vertex >= 0 else -1 for vertex in mirrored[i].tolist()]
    return twin, corner


def copy_twin_corners(face_uvs: np.ndarray, kept: np.ndarray, twin: np.ndarray, corner: np.ndarray) -> np.ndarray:
    """Copy texture corners from faces to their twins; return those (f, 4) of all faces.

    face_uvs (k, 4) of the kept faces (k,); each other face gets its twin's.
    """
    out = np.full(corner.shape, -1, face_uvs.dtype)
    out[kept] = face_uvs
    other = np.flatnonzero(twin >= 0)
    twin_corners = np.take_along_axis(out[twin[other]], np.maximum(corner[other], 0), 1)
    out[other] = np.where(corner[other] >= 0, twin_corners, -1)
    return out
