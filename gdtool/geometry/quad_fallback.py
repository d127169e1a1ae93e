"""Quads where no engine's will do: of even triangles, or, made beside them in case that there are none, of the mesh's own."""

from __future__ import annotations

import numpy as np

from gdtool.core.child import Running, begin
from gdtool.core.threads import cores
from gdtool.geometry.features import Constraints
from gdtool.geometry.quad_fit import better, evened
from gdtool.geometry.quad_shape import Surface
from gdtool.geometry.quad_split import of_even, of_own, split_count
from gdtool.geometry.quad_task import Part, Request

_WORTH_A_CHILD = 20000  # triangles

Evened = tuple[np.ndarray, np.ndarray, np.ndarray, Constraints]  # quads as they were split, vertices and faces; the vertices evened out, held to these


def split(part: Part, ahead: Running | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Quads of any part (quad_split), evened out on its surface where that makes better ones; ahead: as begun() gave it."""
    request = part.request
    done = ahead and ahead.if_done() or split_evened(part.vertices, part.faces, part.quads, request, part.surface)
    return better(*done, part.surface, request, part.fine()), done[1]


def begun(part: Part) -> Running | None:
    """A child that splits and evens out what has fewer triangles than it is to have quads, as an engine often fails on it, which is soon done;
    None for others, and where there is no core to spare."""
    if cores() == 1 or len(part.faces) >= part.quads:
        return None
    return _begin("split_evened", part.vertices, part.faces, part.quads, part.request)


def split_evened(vertices: np.ndarray, faces: np.ndarray, quads: int, request: Request, surface: Surface | None = None) -> Evened:
    """About so many quads of even triangles, else of the mesh's own."""
    quads = split_count(faces, quads)
    ahead = _begin("own_evened", vertices, faces, quads, request) if cores() > 1 and len(faces) >= _WORTH_A_CHILD else None
    surface = Surface(vertices, faces) if surface is None else surface
    try:
        found = of_even(vertices, faces, quads, request.crease_degrees, request.for_the_rest, request.memory_mb)
        if found is not None:
            return *found, *evened(*found, surface, request)
        return ahead and ahead.if_done() or own_evened(vertices, faces, quads, request, surface)
    finally:
        if ahead is not None:
            ahead.kill()


def own_evened(vertices: np.ndarray, faces: np.ndarray, quads: int, request: Request, surface: Surface | None = None) -> Evened:
    """So many quads of the mesh's own triangles."""
    found = of_own(vertices, faces, quads, request.for_the_rest)
    return *found, *evened(*found, Surface(vertices, faces) if surface is None else surface, request)


def _begin(name: str, vertices: np.ndarray, faces: np.ndarray, quads: int, request: Request) -> Running:
    return begin(f"gdtool.geometry.quad_child:{name}", vertices, faces, quads, request, seconds=request.for_the_rest, memory_mb=request.memory_mb,
                 in_case=True)
