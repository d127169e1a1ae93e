"""Remesh triangles to quads: simplify, try engines on the whole or on its pieces, fall back to paired triangles."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module

import numpy as np

from gdtool.core.child import prepare
from gdtool.geometry.normals import face_normals
from gdtool.geometry.simplify import CHILD_MODULES, SHAKEN, median_edge, reduced, simplify
from gdtool.geometry.topology import even
from gdtool.remesh.components import (
    SMALL_PIECE_QUADS,
    accept_good_pieces,
    concatenate_meshes,
    remaining_patches,
    split_small_pieces,
)
from gdtool.remesh.engines.search import EngineSearch, prepare_engines
from gdtool.remesh.fallback.pair_and_split import quads_from_input, split_count
from gdtool.remesh.fallback.smoothed import split
from gdtool.remesh.fit.shaping import max_distance
from gdtool.remesh.fit.surface_projection import ProjectionTarget
from gdtool.remesh.spacing import separate_pieces
from gdtool.remesh.task import QuadResult, Record, RemeshPatch, Request

_PIECE_GAP_EDGES = 8.0  # edge lengths between separated pieces: no step looks at the surface farther away than this
_MIN_QUADS_PER_HANDLE = 100  # with fewer, engines lose some handles (benchmarks/remesh/nets.py)
# Times the noise that keeps triangles of one size: it moves few corners farther than this off the surface, so what is
# farther was moved on purpose, to a restored crease.
_NOISE_REACH = 3.0
_MAX_CREASE_EDGE = 0.75  # of the quads' edge: bevels of triangles larger than this are kept as bevels
_TRIANGLES_PER_QUAD, _MIN_TRIANGLES = 3, 20000  # triangles that show all that the quads can


def remesh(vertices: np.ndarray, faces: np.ndarray, request: Request) -> tuple[np.ndarray, np.ndarray, Record]:
    """Return vertices, quads (q, 4) and the record for the surface of a clean triangle mesh (repair.clean).

    vertices (v, 3) in a unit box, faces (f, 3). All faces are quads. The result is closed and manifold where the input
    is. Pieces that nearly touch are moved apart meanwhile, so that no quads are fitted to a neighbouring piece.
    """
    if len(faces) > _triangles_needed(request):
        prepare(reduced, CHILD_MODULES)
    edge = (face_normals(vertices, faces)[1].sum() / request.quads) ** 0.5
    if (pieces := separate_pieces(vertices, faces, _PIECE_GAP_EDGES * edge)) is not None:
        quad_vertices, quads, record = _Remesher(pieces.vertices, faces, edge, request).run()
        record.source = None
        return pieces.to_original(quad_vertices), quads, record
    return _Remesher(vertices, faces, edge, request).run()


@dataclass
class _Remesher:
    """One run of remesh() on a mesh whose pieces are apart, or are too many to move apart."""

    vertices: np.ndarray
    faces: np.ndarray
    edge: float
    request: Request

    def __post_init__(self) -> None:
        self.record = Record()
        self.full_surface = cache(lambda: ProjectionTarget(self.vertices, self.faces))

    def run(self) -> tuple[np.ndarray, np.ndarray, Record]:
        """Return vertices, quads and the record."""
        small, large = split_small_pieces(self._simplified_patch())
        # Small pieces cannot always be made of as few quads as requested: the large ones make up for the count.
        if small is None:
            results = _quads_of(large, self.record)
        elif small.has_only_tiny_pieces:
            start = time.perf_counter()
            small.input_quads = quads_from_input(
                small.vertices, small.faces, split_count(small.faces, small.quads), self.request.fallback_seconds
            )
            self.record.clock("fallback", start)
            large.quads = max(self.request.quads - len(small.input_quads[1]), 4)
            results = _quads_of(large, self.record) + _quads_of(small, self.record)
        else:
            small_results = _quads_of(small, self.record)
            large.quads = max(self.request.quads - sum(len(result.quads) for result in small_results), 4)
            results = _quads_of(large, self.record) + small_results
        self.record.source = self.full_surface()
        self.record.engine = "; ".join(dict.fromkeys(result.method for result in results))
        return *concatenate_meshes([(result.vertices, result.quads) for result in results]), self.record

    def _simplified_patch(self) -> RemeshPatch:
        """Simplify the mesh to what the quads need, creases restored; again with care where that strays too far."""
        for careful in (False, True):
            start = time.perf_counter()
            vertices, faces = _simplified(self, careful)
            error = 0.0
            if len(faces) < len(self.faces):
                # Undo the noise that keeps triangles of one size; vertices farther away stand on restored creases.
                distance, _, point = self.full_surface().closest(vertices)
                near = distance < _NOISE_REACH * SHAKEN * median_edge(self.vertices, self.faces)
                vertices[near] = point[near]
                error = float(distance.max())
            patch = RemeshPatch(vertices, faces, self.request.quads, self.edge, self.request, self.full_surface)
            if error:
                error = max(error, max_distance(patch.surface, self.full_surface()))
            self.record.figures["simplify_error"] = error
            self.record.clock("simplify", start)
            if error <= self.edge or self.request.engine_seconds_left <= 0:
                break
            self.record.failed.append(f"simplify: strays {error / self.edge:.2g} edge lengths from the surface")
        return patch


def _quads_of(patch: RemeshPatch, record: Record) -> list[QuadResult]:
    """Return the quads of a patch, as one result or as one for each way that its pieces were made."""
    if _uses_engines(patch, record):
        search = EngineSearch(patch, record)
        if (result := search.run()) is not None:
            return [result]
        if patch.pieces[0] > 1:
            start = time.perf_counter()
            result, good = accept_good_pieces(patch, search.whole)
            rest = remaining_patches(patch, good, patch.quads - (len(result.quads) if result is not None else 0))
            record.clock("pieces", start)
            accepted = [] if result is None else [result]
            return accepted + [piece for remaining in rest for piece in _quads_of(remaining, record)]
    start = time.perf_counter()
    result = QuadResult(*split(patch), "pair and split")
    record.clock("fallback", start)
    return [result]


def _uses_engines(patch: RemeshPatch, record: Record) -> bool:
    """Whether engines are tried on a patch; a reason against it that the caller could not know goes to the record."""
    if patch.skip_engines or patch.quads < SMALL_PIECE_QUADS or patch.request.engine == "split":
        return False
    why, pieces = None, patch.pieces[0]
    if patch.request.engine == "auto":
        if patch.has_only_tiny_pieces:
            why = f"{pieces} pieces of so few quads"
        elif pieces == 1 and patch.quads < _MIN_QUADS_PER_HANDLE * patch.handles:
            why = f"so few quads lose some of {patch.handles} handles"
    if why:
        record.failed.append(f"engines: not tried, {why}")
    return why is None


def _triangles_needed(request: Request) -> int:
    """How many triangles show all that the requested quads can."""
    return max(_TRIANGLES_PER_QUAD * request.quads, _MIN_TRIANGLES)


def _while_simplifying(request: Request, full_surface: Callable[[], ProjectionTarget]) -> None:
    """Do what comes next while a child simplifies: start the engines' children, build the search tree, import.

    Not before the child works: starting the engines slows what this process does alone, and building the tree holds the
    interpreter's lock.
    """
    prepare_engines(request)
    full_surface()
    for module in ("scipy.spatial", "embreex.mesh_construction", "embreex.rtcore_scene"):
        import_module(module)


def _simplified(run: _Remesher, careful: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles, creases restored, simplified to what the quads need; the input where that fails."""
    request, record = run.request, run.record
    if len(run.faces) <= _triangles_needed(request):
        prepare_engines(request)
    restore = request.restore_creases and median_edge(run.vertices, run.faces) < _MAX_CREASE_EDGE * run.edge
    vertices, faces, _, report = simplify(
        run.vertices,
        run.faces,
        _triangles_needed(request),
        seconds=request.fallback_seconds,
        crease_degrees=request.crease_degrees if restore else 0.0,
        closed=lambda: even(run.faces),
        careful=careful,
        even=True,
        measured=False,
        meanwhile=lambda: _while_simplifying(request, run.full_surface),
    )
    record.figures |= {"simplified_to": report["faces"]} | (
        {"crease_vertices_restored": report["creases"]} if restore else {}
    )
    if "failed" in report:
        record.failed.append(f"simplify: {report['failed']}")
    return vertices, faces
