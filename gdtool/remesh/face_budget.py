"""How many quads a surface needs: the coarsest mesh within a distance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gdtool.geometry.simplify import deviation
from gdtool.geometry.topology import triangulated
from gdtool.remesh.pipeline import remesh
from gdtool.remesh.task import Record, Request

_FEWEST = 64
_CLOSE_ENOUGH = 1.15  # counts nearer than this to each other are not told apart
_MOST_RUNS = 6


def coarsest(
    vertices: np.ndarray, faces: np.ndarray, request: Request, limit: float, way: Callable[..., tuple] | None = None
) -> tuple[np.ndarray, np.ndarray, Record, float]:
    """The fewest quads, at most request.quads, that stay within `limit` of the surface, and the distance they reach.

    The distance is of vertices of both meshes to the other surface (simplify.deviation). It falls about as one over the
    number of quads, which tells the next number to try; when even request.quads are too few they are returned. way:
    what makes quads, called as remesh is."""
    too_few, enough = min(_FEWEST, request.quads) / _CLOSE_ENOUGH, None
    quads = request.quads
    for _ in range(_MOST_RUNS):
        out, found, record = (way or remesh)(vertices, faces, replace(request, quads=quads))
        reached = deviation(vertices, faces, out, triangulated(found)[0])
        if reached <= limit:
            enough = (quads, (out, found, record, reached))
        else:
            if enough is None:
                return out, found, record, reached
            too_few = quads
        if enough[0] <= _CLOSE_ENOUGH * too_few or request.for_engines <= 0:
            break
        guess = quads * 1.05 * reached / limit
        middle = (too_few * enough[0]) ** 0.5
        inside = 1.05 * too_few < guess < 0.95 * enough[0]
        quads = int(max(guess if inside else middle, min(_FEWEST, request.quads)))
        if quads >= enough[0]:
            break
    return enough[1]
