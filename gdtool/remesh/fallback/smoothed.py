"""Make the quads of a patch without an engine, and smooth them on its surface where that helps."""

from __future__ import annotations

from gdtool.geometry.meshes import QuadMesh
from gdtool.remesh.fallback.pair_and_split import (
    quads_from_input,
    quads_from_isotropic,
    split_count,
    too_few_for_isotropic,
)
from gdtool.remesh.fit.shaping import keep_better_vertices, smoothed
from gdtool.remesh.task import RemeshPatch


def split(patch: RemeshPatch) -> QuadMesh:
    """Make quads of any patch, from isotropic triangles or, where those fail, from the patch's own triangles.

    The quads are then smoothed on the surface. Each piece and each quad keeps its smoothed vertices only where they are
    better.
    """
    request = patch.request
    mesh = patch.input_quads
    count = len(mesh.faces) if mesh is not None else split_count(patch.mesh.faces, patch.quads)
    # The features are those for the edge length of these quads, which differs from the patch's.
    edge = (patch.mesh.area / count) ** 0.5
    ground = RemeshPatch(patch.mesh, count, edge, request, lambda: patch.surface)
    ground.surface = patch.surface
    if mesh is None and not too_few_for_isotropic(patch.mesh.faces, count):
        mesh = quads_from_isotropic(
            patch.mesh,
            count,
            request.crease_degrees,
            request.fallback_seconds,
            request.memory_mb,
            lambda: ground.features,
        )
    if mesh is None:
        mesh = quads_from_input(patch.mesh, count, request.fallback_seconds, lambda: ground.features)
    moved, constraints = smoothed(mesh, ground.surface, ground.features, request)
    vertices = keep_better_vertices(mesh, moved, constraints, patch.surface, request, patch.full_surface())
    return QuadMesh(vertices, mesh.faces)
