"""Call the native quad remeshers; each runs in a child process, for it may hang or crash.

Every engine takes a triangle mesh in a unit box, and returns quads, unchecked.
"""

from __future__ import annotations

import numpy as np

from gdtool.core.native import imported
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.nonmanifold_edges import separate_sheets
from gdtool.geometry.repair import drop_small_pieces
from gdtool.geometry.topology import Invariants, compact, edges_of, invariants

_FACES_PER_QUAD = 4  # triangles per requested quad that an engine needs to see the shape


def simplify_for_engine(mesh: TriMesh, quads: int, wanted: Invariants) -> TriMesh:
    """Simplify an engine's input to the triangles that `quads` quads can show.

    This halves the time of Instant Meshes: it splits long edges itself, so its cost follows the vertices of its input
    more than those of its output. wanted: the topology invariants of `mesh`; where simplifying changes them, the input
    is returned.
    """
    from gdtool.geometry.simplify import collapse

    if len(mesh.faces) <= _FACES_PER_QUAD * quads:
        return mesh
    simplified = compact(collapse(mesh, _FACES_PER_QUAD * quads, 5.0))
    if invariants(simplified.faces) != wanted:  # most often where two sheets meet in an edge
        simplified = drop_small_pieces(separate_sheets(simplified), wanted.pieces)
    return simplified if invariants(simplified.faces) == wanted else mesh


def run_instant_meshes(mesh: TriMesh, quads: int, crease_degrees: float) -> QuadMesh:
    """Run Instant Meshes (Jakob et al. 2015) for about `quads` quads.

    It is asked for a quarter as many mixed faces, which one regular subdivision turns into quads. Its deterministic
    mode is used, so that equal input gives equal files. Intrinsic smoothing would leave a tenth fewer irregular
    vertices, but its quads follow creases less well.
    """
    vertices, faces = mesh.vertices, mesh.faces
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
    return QuadMesh(np.asarray(quad_vertices, np.float64), np.asarray(quad_faces, np.int64))


def run_quadriflow(mesh: TriMesh, quads: int, crease_degrees: float) -> QuadMesh:
    """Run QuadriFlow (Huang et al. 2018) through pyQuadriFlow, an optional package.

    It ends the process on non-manifold input.
    """
    vertices, faces = mesh.vertices, mesh.faces
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
    return QuadMesh(np.asarray(result["vertices"], np.float64), np.asarray(result["faces"], np.int64))


ENGINES = {"instant-meshes": run_instant_meshes, "quadriflow": run_quadriflow}
