"""Quads where no engine's will do: of even triangles, or, made beside them in case that there are none, of the mesh's own."""

from __future__ import annotations

import contextlib
import os

import numpy as np

from gdtool.core.child import ChildFailed, Running, begin
from gdtool.core.threads import cores
from gdtool.geometry.features import Constraints
from gdtool.geometry.quad_fit import better, evened
from gdtool.geometry.quad_shape import Surface
from gdtool.geometry.quad_split import of_even, of_own, split_count
from gdtool.geometry.quad_task import NICE, Part, Request

_WORTH_A_CHILD = 20000  # triangles

Evened = tuple[np.ndarray, np.ndarray, np.ndarray, Constraints]  # quads as they were split, vertices and faces; the vertices evened out, held to these


def split(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Quads of any part (quad_split), evened out on its surface where that makes better ones."""
    request, quads = part.request, split_count(part.faces, part.quads)
    ahead = _ahead(part, quads)
    try:
        found = of_even(part.vertices, part.faces, quads, request.crease_degrees, request.for_the_rest, request.memory_mb)
        if found is not None:
            done = *found, *evened(*found, part.surface, request)
        else:
            done = _fetched(ahead) or own_evened(part.vertices, part.faces, quads, request, part.surface)
    finally:
        if ahead is not None:
            ahead.kill()
    return better(*done, part.surface, request, part.fine()), done[1]


def own_evened(vertices: np.ndarray, faces: np.ndarray, quads: int, request: Request, surface: Surface | None = None, nice: int = 0) -> Evened:
    """So many quads of a mesh's own triangles; nice: what a child that may not be needed gives way by."""
    if nice:
        os.nice(nice)
    found = of_own(vertices, faces, quads, request.for_the_rest)
    return *found, *evened(*found, Surface(vertices, faces) if surface is None else surface, request)


def _ahead(part: Part, quads: int) -> Running | None:
    if cores() == 1 or len(part.faces) < _WORTH_A_CHILD:
        return None
    return begin("gdtool.geometry.quad_child:own_evened", part.vertices, part.faces, quads, part.request, nice=NICE,
                 seconds=part.request.for_the_rest, memory_mb=part.request.memory_mb)


def _fetched(ahead: Running | None) -> Evened | None:
    with contextlib.suppress(ChildFailed):
        return None if ahead is None else ahead.result()
    return None
