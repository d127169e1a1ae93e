"""Call the native quad remeshers; each runs in a child process, for it may hang or crash.

Every engine takes vertices (v, 3) in a unit box and faces (f, 3), and returns vertices and quads (q, 4), unchecked.
"""

from __future__ import annotations

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.repair import without_crumbs
from gdtool.geometry.topology import Invariants, compact, edges_of, invariants
from gdtool.geometry.unpinch import unpinched

_FACES_PER_QUAD = 4  # triangles per requested quad that an engine needs to see the shape


def simplify_for_engine(
    vertices: np.ndarray, faces: np.ndarray, quads: int, wanted: Invariants
) -> tuple[np.ndarray, np.ndarray]:
    """Simplify the engine's input to what `quads` quads can show, where that keeps its invariants.

    Saves half of Instant Meshes' time: it splits long edges itself, so its cost follows the vertices it is given more
    than those it makes. Returns the input where the simplified mesh has other invariants than `wanted`.
    """
    from gdtool.geometry.simplify import collapse

    if len(faces) <= _FACES_PER_QUAD * quads:
        return vertices, faces
    simplified_vertices, simplified = compact(*collapse(vertices, faces, _FACES_PER_QUAD * quads, 5.0))
    if invariants(simplified) != wanted:  # most often where two sheets meet in an edge
        simplified_vertices, simplified = without_crumbs(*unpinched(simplified_vertices, simplified), wanted.pieces)
    return (simplified_vertices, simplified) if invariants(simplified) == wanted else (vertices, faces)


def run_instant_meshes(
    vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """Run Instant Meshes (Jakob et al. 2015): a quarter as many mixed faces, then one regular subdivision to pure
    quads.

    Its deterministic mode, so that equal input gives equal files. Intrinsic smoothing leaves a tenth fewer irregular
    vertices, but its quads follow creases less well.
    """
    pynanoinstantmeshes = imported("pynanoinstantmeshes")
    quad_vertices, quad_faces = pynanoinstantmeshes.remesh(
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
    return np.asarray(quad_vertices, np.float64), np.asarray(quad_faces, np.int64)


def run_quadriflow(
    vertices: np.ndarray, faces: np.ndarray, quads: int, crease_degrees: float
) -> tuple[np.ndarray, np.ndarray]:
    """Run QuadriFlow (Huang et al. 2018) through pyQuadriFlow, an optional package.

    It ends the process on non-manifold input.
    """
    pyQuadriFlow = imported("pyQuadriFlow.pyQuadriFlow")
    result = pyQuadriFlow.pyquadriflow(
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
    return np.asarray(result["vertices"], np.float64), np.asarray(result["faces"], np.int64)


ENGINES = {"instant-meshes": run_instant_meshes, "quadriflow": run_quadriflow}
