"""Engines that make quads out of triangles; they run in a killable child, for they may hang or crash.

Every engine takes vertices (v, 3) in a unit box and faces (f, 3) and returns vertices and quads (q, 4), unchecked.
"""

from __future__ import annotations

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.repair import without_crumbs
from gdtool.geometry.topology import Invariants, compact, edges_of, invariants
from gdtool.geometry.unpinch import unpinched

_FACES_PER_QUAD = 4


def on_few(vertices: np.ndarray, faces: np.ndarray, quads: int, wanted: Invariants) -> tuple[np.ndarray, np.ndarray]:
    """A mesh collapsed to what so many quads can show, where that keeps the invariants that it has: half of Instant
    Meshes' time.

    It cuts long edges itself, so its cost follows the vertices that it is given more than those that it makes.
    """
    from gdtool.geometry.simplify import collapse

    if len(faces) <= _FACES_PER_QUAD * quads:
        return vertices, faces
    few_vertices, few = compact(*collapse(vertices, faces, _FACES_PER_QUAD * quads, 5.0))
    if invariants(few) != wanted:  # most often for sheets that meet in an edge
        few_vertices, few = without_crumbs(*unpinched(few_vertices, few), wanted.pieces)
    return (few_vertices, few) if invariants(few) == wanted else (vertices, faces)


def run_instant_meshes(
    vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """Instant Meshes (Jakob et al. 2015): a quarter as many mixed faces, then one regular subdivision to pure quads.

    Its deterministic mode, so that equal input gives equal files. Intrinsic smoothing leaves a tenth fewer irregular
    vertices, but its quads keep to creases less well.
    """
    pynanoinstantmeshes = imported("pynanoinstantmeshes")
    out, found = pynanoinstantmeshes.remesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.uint32),
        vertex_count=max(quads // 4, 4),
        rosy=4,
        posy=4,
        creaseAngle=float(crease_degrees),
        align_to_boundaries=bool((edges_of(faces).count == 1).any()),
        extrinsic=True,
        smooth_iter=0,
        deterministic=True,
    )
    return np.asarray(out, np.float64), np.asarray(found, np.int64)


def run_quadriflow(
    vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """QuadriFlow (Huang et al. 2018) through pyQuadriFlow, an optional package. It ends the process on non-manifold
    input."""
    pyQuadriFlow = imported("pyQuadriFlow.pyQuadriFlow")
    found = pyQuadriFlow.pyquadriflow(
        int(quads),
        0,
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        crease_degrees > 0,
        False,
        False,
        False,
        False,
    )
    return np.asarray(found["vertices"], np.float64), np.asarray(found["faces"], np.int64)


ENGINES = {"instant-meshes": run_instant_meshes, "quadriflow": run_quadriflow}
