"""Quads where no engine's will do: of even triangles, or, made beside them in case that there are none, of the mesh's own."""

from __future__ import annotations

import numpy as np

from gdtool.core.child import Running, begin
from gdtool.core.threads import cores
from gdtool.geometry.features import Constraints
from gdtool.geometry.normals import face_normals
from gdtool.geometry.quad_fit import better, evened
from gdtool.geometry.quad_shape import Surface
from gdtool.geometry.quad_split import few_for_even, of_even, of_own, split_count
from gdtool.geometry.quad_task import Part, Request

_WORTH_A_CHILD = 20000  # triangles

Evened = tuple[np.ndarray, np.ndarray, np.ndarray, Constraints]  # quads as they were split, vertices and faces; the vertices evened out, held to these


def split(part: Part, ahead: Running | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Quads of any part (quad_split), evened out on its surface where that makes better ones; ahead: as begun() gave it."""
    request = part.request
    if part.cut is not None:
        given = part.vertices, part.faces, part.cut, request
        child = _begin("cut_evened", *given) if cores() > 1 and request.threads > 1 else None  # other pieces keep this process busy
        done = child and child.if_done() or cut_evened(*given)
    else:
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
    if few_for_even(faces, quads):
        return own_evened(vertices, faces, quads, request, surface)
    ahead = _begin("own_evened", vertices, faces, quads, request) if cores() > 1 and len(faces) >= _WORTH_A_CHILD else None
    ground = _ground(vertices, faces, quads, request, surface)
    try:
        found = of_even(vertices, faces, quads, request.crease_degrees, request.for_the_rest, request.memory_mb, lambda: ground.features)
        if found is not None:
            return _evened(found, ground)
        return ahead and ahead.if_done() or own_evened(vertices, faces, quads, request, ground.surface)
    finally:
        if ahead is not None:
            ahead.kill()


def own_evened(vertices: np.ndarray, faces: np.ndarray, quads: int, request: Request, surface: Surface | None = None) -> Evened:
    """So many quads of the mesh's own triangles."""
    ground = _ground(vertices, faces, quads, request, surface)
    return _evened(of_own(vertices, faces, quads, request.for_the_rest, lambda: ground.features), ground)


def cut_evened(vertices: np.ndarray, faces: np.ndarray, cut: tuple[np.ndarray, np.ndarray], request: Request) -> Evened:
    """Quads that were made before."""
    return _evened(cut, _ground(vertices, faces, len(cut[1]), request))


def _ground(vertices: np.ndarray, faces: np.ndarray, quads: int, request: Request, surface: Surface | None = None) -> Part:
    """What so many quads are evened out on: the surface and its features, those for their own edge length."""
    surface = Surface(vertices, faces) if surface is None else surface
    ground = Part(vertices, faces, quads, (face_normals(vertices, faces)[1].sum() / quads) ** 0.5, request, lambda: surface)
    ground.surface = surface
    return ground


def _evened(found: tuple[np.ndarray, np.ndarray], ground: Part) -> Evened:
    return *found, *evened(*found, ground.surface, ground.features, ground.request)


def _begin(name: str, vertices: np.ndarray, faces: np.ndarray, made: int | tuple[np.ndarray, np.ndarray], request: Request) -> Running:
    return begin(f"gdtool.geometry.quad_child:{name}", vertices, faces, made, request, seconds=request.for_the_rest, memory_mb=request.memory_mb,
                 in_case=True)
