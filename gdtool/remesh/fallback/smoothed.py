"""Quads where no engine's will do: of even triangles, or, where there are none, of the mesh's own."""

from __future__ import annotations

import numpy as np

from gdtool.geometry.normals import face_normals
from gdtool.remesh.fallback.pair_and_split import few_for_even, of_even, of_own, split_count
from gdtool.remesh.fit.shaping import better, evened
from gdtool.remesh.task import Part


def split(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Quads of any part (quad_split), evened out on its surface where that makes better ones."""
    request, quads = part.request, len(part.cut[1]) if part.cut is not None else split_count(part.faces, part.quads)
    # The surface and its features, those for the edge length of these quads.
    edge = (face_normals(part.vertices, part.faces)[1].sum() / quads) ** 0.5
    ground = Part(part.vertices, part.faces, quads, edge, request, lambda: part.surface)
    ground.surface = part.surface
    found = part.cut
    if found is None and not few_for_even(part.faces, quads):
        found = of_even(
            part.vertices,
            part.faces,
            quads,
            request.crease_degrees,
            request.for_the_rest,
            request.memory_mb,
            lambda: ground.features,
        )
    if found is None:
        found = of_own(part.vertices, part.faces, quads, request.for_the_rest, lambda: ground.features)
    traced, constraints = evened(*found, ground.surface, ground.features, request)
    return better(*found, traced, constraints, part.surface, request, part.fine()), found[1]
