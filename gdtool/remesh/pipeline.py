"""Triangles to quads: simplified to what the quads can show, an engine's quads of the whole or of its pieces, and the
fallback."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from importlib import import_module

import numpy as np

from gdtool.core.child import prepare
from gdtool.geometry.normals import face_normals
from gdtool.geometry.simplify import CHILD_MODULES, SHAKEN, median_edge, reduced, simplify
from gdtool.geometry.topology import even
from gdtool.remesh.components import SMALL_PIECE_QUADS, apart, by_size, joined, well_made
from gdtool.remesh.engines.search import Found, Trial, prepare_engines
from gdtool.remesh.fallback.pair_and_split import of_own, split_count
from gdtool.remesh.fallback.smoothed import split
from gdtool.remesh.fit.shaping import farthest
from gdtool.remesh.fit.surface_projection import Surface
from gdtool.remesh.spacing import spread
from gdtool.remesh.task import Part, Record, Request

_GAP = 8.0  # edge lengths between pieces: none of what is asked of a surface reaches so far
_FOR_A_HANDLE = 100  # quads: with fewer engines lose some (benchmarks/remesh_nets.py)
_SHAKEN_OFF = 3.0  # of the noise that keeps triangles even, which moves few of their corners farther off the surface


def remesh(vertices: np.ndarray, faces: np.ndarray, request: Request) -> tuple[np.ndarray, np.ndarray, Record]:
    """Quads (q, 4) on the surface of a clean triangle mesh (repair.clean), and the record of how.

    vertices (v, 3) in a unit box, faces (f, 3). All faces are quads; closed and manifold where the input is. Pieces
    that nearly touch are laid apart meanwhile, so that none is drawn onto another."""
    if len(faces) > _needed(request):
        prepare(reduced, CHILD_MODULES)
    edge = (face_normals(vertices, faces)[1].sum() / request.quads) ** 0.5
    if (pieces := spread(vertices, faces, _GAP * edge)) is not None:
        out, quads, record = _remeshed(pieces.vertices, faces, edge, request)
        record.source = None
        return pieces.back(out), quads, record
    return _remeshed(vertices, faces, edge, request)


def _remeshed(
    vertices: np.ndarray, faces: np.ndarray, edge: float, request: Request
) -> tuple[np.ndarray, np.ndarray, Record]:
    """remesh() of what is one piece, or of pieces none of which is near another, or that are too many to lay apart."""
    record, fine = Record(), cache(lambda: Surface(vertices, faces))
    whole = _coarse(vertices, faces, edge, request, record, fine)
    few, large = by_size(whole)
    # Small pieces cannot always be made of as few quads as asked for; the count holds for the sum.
    if few is None:
        done = _quads_of(large, record)
    elif few.crumbs:
        start = time.perf_counter()
        few.cut = of_own(few.vertices, few.faces, split_count(few.faces, few.quads), request.for_the_rest)
        record.clock("fallback", start)
        large.quads = max(request.quads - len(few.cut[1]), 4)
        done = _quads_of(large, record) + _quads_of(few, record)
    else:
        small = _quads_of(few, record)
        large.quads = max(request.quads - sum(len(found) for _, found, _ in small), 4)
        done = _quads_of(large, record) + small
    record.source = fine()
    record.engine = "; ".join(dict.fromkeys(way for _, _, way in done))
    return *joined([found[:2] for found in done]), record


def _coarse(
    vertices: np.ndarray, faces: np.ndarray, edge: float, request: Request, record: Record, fine: Callable[[], Surface]
) -> Part:
    """What quads of that edge need of the mesh, its creases restored: collapsed quickly, with care where that strays by
    more than an edge.

    What the noise that keeps its triangles even moved is on the surface again.
    """
    for careful in (False, True):
        start = time.perf_counter()
        out, found = _simplified(vertices, faces, edge, request, record, careful, fine)
        error = 0.0
        if len(found) < len(faces):
            away, _, point = fine().closest(out)
            # What is farther was drawn out to a crease.
            near = away < _SHAKEN_OFF * SHAKEN * median_edge(vertices, faces)
            out[near] = point[near]
            error = float(away.max())
        part = Part(out, found, request.quads, edge, request, fine)
        if error:
            error = max(error, farthest(part.surface, fine()))
        record.figures["simplify_error"] = error
        record.clock("simplify", start)
        if error <= edge or request.for_engines <= 0:
            break
        record.failed.append(f"simplify: strays {error / edge:.2g} edge lengths from the surface")
    return part


def _quads_of(part: Part, record: Record) -> list[Found]:
    """The quads of a mesh, or those of parts of it that were made in different ways."""
    if _for_engines(part, record):
        trial = Trial(part, record)
        if (found := trial.run()) is not None:
            return [found]
        if part.pieces[0] > 1:
            start = time.perf_counter()
            found, good = well_made(part, trial.whole)
            left = apart(part, good, part.quads - (len(found[1]) if found is not None else 0))
            record.clock("pieces", start)
            return ([] if found is None else [found]) + [piece for one in left for piece in _quads_of(one, record)]
    start = time.perf_counter()
    found = *split(part), "pair and split"
    record.clock("fallback", start)
    return [found]


def _for_engines(part: Part, record: Record) -> bool:
    """Whether engines are to be tried on a part."""
    if part.given_up or part.quads < SMALL_PIECE_QUADS or part.request.engine == "split":
        return False
    why, pieces = None, part.pieces[0]
    if part.request.engine == "auto":
        if part.crumbs:
            why = f"{pieces} pieces of so few quads"
        elif pieces == 1 and part.quads < _FOR_A_HANDLE * part.handles:
            why = f"so few quads lose some of {part.handles} handles"
    if why:
        record.failed.append(f"engines: not tried, {why}")
    return why is None


def _needed(request: Request) -> int:
    """How many triangles show all that so many quads can."""
    return max(3 * request.quads, 20000)


def _simplified(
    vertices: np.ndarray,
    faces: np.ndarray,
    edge: float,
    request: Request,
    record: Record,
    careful: bool,
    fine: Callable[[], Surface],
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with its creases restored as coarse as quads of that edge need, or the mesh as it was where that cannot
    be done."""

    def meanwhile() -> None:
        # Not before: the engines' start would slow what this process does alone, the tree's building holds the
        # interpreter's lock.
        prepare_engines(request.quads, request)
        fine()
        # What comes next would wait for them.
        for module in ("scipy.spatial", "embreex.mesh_construction", "embreex.rtcore_scene"):
            import_module(module)

    if len(faces) <= _needed(request):
        prepare_engines(request.quads, request)
    # Bevels as wide as the quads are drawn as they are.
    restored = request.restore_creases and median_edge(vertices, faces) < 0.75 * edge
    found = simplify(
        vertices,
        faces,
        _needed(request),
        seconds=request.for_the_rest,
        crease_degrees=request.crease_degrees if restored else 0.0,
        closed=lambda: even(faces),
        careful=careful,
        even=True,
        measured=False,
        meanwhile=meanwhile,
    )
    report = found[3]
    record.figures |= {"simplified_to": report["faces"]} | (
        {"crease_vertices_restored": report["creases"]} if restored else {}
    )
    if "failed" in report:
        record.failed.append(f"simplify: {report['failed']}")
    return found[:2]
