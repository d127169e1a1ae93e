"""Find how many quads a surface needs for a quad size, or for a largest distance from the surface."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gdtool.geometry import topology
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.simplify import deviation
from gdtool.remesh.limits import COUNT_TOLERANCE
from gdtool.remesh.pipeline import remesh
from gdtool.remesh.task import Record, Request

_MIN_QUADS = 64  # fewer are not tried
_SAME_COUNT = 1.15  # counts within this factor of each other are not told apart: another run gains too little
_MAX_RUNS = 6


MakeQuads = Callable[[TriMesh, Request], tuple[QuadMesh, Record]]  # as pipeline.remesh


class BudgetedQuads(NamedTuple):
    """Quads, the record of how they were made, and their largest distance from the surface."""

    mesh: QuadMesh
    record: Record
    reached: float


def quads_of_size(mesh: TriMesh, size: float) -> int:
    """Count the quads with sides of length `size` that cover the triangles: their area over size squared."""
    return round(mesh.area / size**2)


def is_finished(quads: np.ndarray, count: int) -> bool:
    """Return whether quads (q, 4) need no remeshing: closed, manifold, and about `count` of them."""
    return (
        abs(len(quads) / count - 1) <= COUNT_TOLERANCE and topology.is_watertight(quads) and topology.is_manifold(quads)
    )


def coarsest_within(
    mesh: TriMesh,
    request: Request,
    limit: float,
    make_quads: MakeQuads | None = None,
) -> BudgetedQuads:
    """Find the fewest quads, at most request.quads, that stay within the distance `limit` of the surface.

    The distance is the largest from the vertices of either mesh to the other surface (simplify.deviation). It falls
    about as one over the number of quads, which predicts the next count to try. When even request.quads are too few,
    these are returned. make_quads: the function that remeshes; None is pipeline.remesh.
    """
    too_few, quads = min(_MIN_QUADS, request.quads) / _SAME_COUNT, request.quads
    enough: tuple[int, BudgetedQuads] | None = None
    for _ in range(_MAX_RUNS):
        made, record = (make_quads or remesh)(mesh, replace(request, quads=quads))
        reached = deviation(mesh, made.triangles)
        budgeted = BudgetedQuads(made, record, reached)
        if reached <= limit:
            enough = (quads, budgeted)
        elif enough is None:
            return budgeted
        else:
            too_few = quads
        if enough[0] <= _SAME_COUNT * too_few or request.engine_seconds_left <= 0:
            break
        guess = quads * 1.05 * reached / limit
        middle = (too_few * enough[0]) ** 0.5
        inside = 1.05 * too_few < guess < 0.95 * enough[0]
        quads = int(max(guess if inside else middle, min(_MIN_QUADS, request.quads)))
        if quads >= enough[0]:
            break
    assert enough is not None  # the first run sets it, or returns
    return enough[1]
