"""Make the quads of a patch without an engine, and smooth them on its surface where that helps."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.normals import face_normals
from gdtool.remesh.fallback.pair_and_split import (
    quads_from_input,
    quads_from_isotropic,
    split_count,
    too_few_for_isotropic,
)
from gdtool.remesh.fit.shaping import keep_better_vertices, smoothed
from gdtool.remesh.task import RemeshPatch


def split(patch: RemeshPatch) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and quads of any patch, from isotropic triangles or, where those fail, from its own triangles.

    The quads are smoothed on the surface, each piece and each quad only where that makes it better.
    """
    request = patch.request
    count = len(patch.input_quads[1]) if patch.input_quads is not None else split_count(patch.faces, patch.quads)
    # The features are those for the edge length of these quads, which differs from the patch's.
    edge = (face_normals(patch.vertices, patch.faces)[1].sum() / count) ** 0.5
    ground = RemeshPatch(patch.vertices, patch.faces, count, edge, request, lambda: patch.surface)
    ground.surface = patch.surface
    mesh = patch.input_quads
    if mesh is None and not too_few_for_isotropic(patch.faces, count):
        mesh = quads_from_isotropic(
            patch.vertices,
            patch.faces,
            count,
            request.crease_degrees,
            request.fallback_seconds,
            request.memory_mb,
            lambda: ground.features,
        )
    if mesh is None:
        mesh = quads_from_input(patch.vertices, patch.faces, count, request.fallback_seconds, lambda: ground.features)
    moved, constraints = smoothed(*mesh, ground.surface, ground.features, request)
    vertices = keep_better_vertices(*mesh, moved, constraints, patch.surface, request, patch.full_surface())
    return vertices, mesh[1]
