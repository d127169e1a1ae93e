"""Features that run across quads instead of along their edges: held to the quads' diagonals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gdtool.geometry.mesh_quality import columns_of
from gdtool.geometry.topology import edges_of
from gdtool.remesh.fit.feature_curves import Constraints, closest_on_segments
from gdtool.remesh.fit.surface_projection import Surface

_FLAT = 1e-3  # a quad whose diagonals pass within this share of its size needs no choice


def crossed(faces: np.ndarray, before: Constraints, after: Constraints) -> tuple[np.ndarray, np.ndarray]:
    """Quads (k,) of faces (q, 4) that a feature now crosses from corner to corner, and its curve (k,).

    before and after are the constraints around features.untied, which lets the corner between two others off their
    curve: from there on the curve runs along the diagonal of the quad."""
    width = len(before.curve) + 1
    path = np.sort(before.path, 1)
    order = np.argsort(path[:, 0] * width + path[:, 1])
    key = (path[:, 0] * width + path[:, 1])[order]
    if not len(key):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    following = np.roll(faces, -1, 1)
    asked = np.minimum(faces, following) * width + np.maximum(faces, following)
    place = np.minimum(np.searchsorted(key, asked), len(key) - 1)
    curve = np.where(key[place] == asked, before.path_curve[order][place], -1)  # of the edge that starts at each corner
    let_off = (before.curve[faces] >= 0) & (after.curve[faces] < 0)
    on = (after.curve >= 0) | after.fixed
    found = (
        let_off
        & (curve >= 0)
        & (curve == np.roll(curve, 1, 1))
        & on[following]
        & on[np.roll(faces, 1, 1)]
        & ~on[np.roll(faces, 2, 1)]
    )
    face_idx, corner = np.nonzero(found)
    once = np.unique(face_idx, return_index=True)[1]
    return face_idx[once], curve[face_idx[once], corner[once]]


def held_at_centres(
    constraints: Constraints, first_centre: int, face_idx: np.ndarray, curve: np.ndarray
) -> Constraints:
    """Constraints of the subdivided mesh, the centres of those quads (k,) held to the curve (k,) that crosses them."""
    held = constraints.curve.copy()
    held[first_centre + face_idx] = curve
    return replace(constraints, curve=held)


def cut_along_features(vertices: np.ndarray, faces: np.ndarray, surface: Surface) -> np.ndarray:
    """Faces (q, 4) whose first corner is chosen such that the diagonal from it, where they are cut in two, is the one
    nearer to the surface. Bent quads across a crease then follow it."""
    p = columns_of(vertices, faces)
    middle = np.stack([(p[:, 0] + p[:, 2]) / 2, (p[:, 1] + p[:, 3]) / 2])
    apart = np.sqrt(((middle[0] - middle[1]) ** 2).sum(0))
    size = np.sqrt(((p[:, 0] - p[:, 2]) ** 2).sum(0))
    bent = np.flatnonzero(apart > _FLAT * size)
    first, second = surface.closest(middle[:, :, bent].transpose(0, 2, 1).reshape(-1, 3))[0].reshape(2, -1)
    turned = bent[second < first]
    out = faces.copy()
    out[turned] = np.roll(faces[turned], -1, 1)
    return out


def to_rim(vertices: np.ndarray, faces: np.ndarray, surface: Surface, reach: float) -> np.ndarray:
    """Vertices (v, 3) with those on the boundary of the quads drawn to the boundary of the surface where it is within
    `reach`."""
    theirs = edges_of(surface.faces)
    segments = theirs.ends[theirs.count == 1]
    if not len(segments):
        return vertices
    mine = edges_of(faces)
    rim = np.unique(mine.ends[mine.count == 1])
    distance, _, point = closest_on_segments(vertices[rim], surface.vertices, segments)
    out = vertices.copy()
    out[rim[distance < reach]] = point[distance < reach]
    return out
