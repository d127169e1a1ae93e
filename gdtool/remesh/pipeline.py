"""Remesh triangles to quads: simplify, try engines on the whole or on its pieces, fall back to paired triangles."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module

from gdtool.core.child import prepare
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.simplify import (
    CHILD_MODULES,
    JITTER_EDGES,
    SimplifyOptions,
    collapse_in_child,
    median_edge,
    simplify,
)
from gdtool.geometry.topology import has_even_edge_counts
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
# A multiple of the noise (JITTER_EDGES) that keeps triangles of one size while simplifying. It moves few vertices
# farther than this off the surface, so those farther away were moved to a restored crease.
_NOISE_REACH = 3.0
_MAX_CREASE_EDGE = 0.75  # of the quads' edge: bevels of triangles larger than this are kept as bevels
_TRIANGLES_PER_QUAD, _MIN_TRIANGLES = 3, 20000  # triangles that show all that the quads can


def remesh(mesh: TriMesh, request: Request) -> tuple[QuadMesh, Record]:
    """Remesh a clean triangle mesh (repair.clean) to quads; return them and the record of how they were made.

    mesh: in a unit box. No face of the result is a triangle. The result is closed and manifold where the input is.
    Pieces that nearly touch are moved apart while it runs, so that no quads are fitted to a neighbouring piece.
    """
    if len(mesh.faces) > _triangles_needed(request):
        prepare(collapse_in_child, CHILD_MODULES)
    edge = (mesh.area / request.quads) ** 0.5
    if (pieces := separate_pieces(mesh, _PIECE_GAP_EDGES * edge)) is not None:
        quads, record = _Remesher(pieces.mesh, edge, request).run()
        record.source = None
        return QuadMesh(pieces.to_original(quads.vertices), quads.faces), record
    return _Remesher(mesh, edge, request).run()


@dataclass
class _Remesher:
    """One run of remesh() on a mesh whose pieces are apart, or are too many to move apart."""

    mesh: TriMesh
    edge: float
    request: Request

    def __post_init__(self) -> None:
        self.record = Record()
        self.full_surface = cache(lambda: ProjectionTarget(self.mesh))

    def run(self) -> tuple[QuadMesh, Record]:
        """Make the quads and the record."""
        small, large = split_small_pieces(self._simplified_patch())
        # Small pieces cannot always be made of as few quads as requested: the large ones make up for the count.
        if small is None:
            results = _quads_of(large, self.record)
        elif small.has_only_tiny_pieces:
            start = time.perf_counter()
            small.input_quads = quads_from_input(
                small.mesh, split_count(small.mesh.faces, small.quads), self.request.fallback_seconds
            )
            self.record.clock("fallback", start)
            large.quads = max(self.request.quads - len(small.input_quads.faces), 4)
            results = _quads_of(large, self.record) + _quads_of(small, self.record)
        else:
            small_results = _quads_of(small, self.record)
            large.quads = max(self.request.quads - sum(len(result.mesh.faces) for result in small_results), 4)
            results = _quads_of(large, self.record) + small_results
        self.record.source = self.full_surface()
        self.record.engine = "; ".join(dict.fromkeys(result.method for result in results))
        return concatenate_meshes([result.mesh for result in results]), self.record

    def _simplified_patch(self) -> RemeshPatch:
        """Simplify the mesh to what the quads need, creases restored.

        Where the result is more than an edge length from the surface, simplify again with the collapse that keeps the
        topology.
        """
        for topology_first in (False, True):
            start = time.perf_counter()
            simplified = _simplified(self, topology_first)
            error = 0.0
            if len(simplified.faces) < len(self.mesh.faces):
                # Undo the noise that keeps triangles of one size; vertices farther away stand on restored creases.
                vertices = simplified.vertices
                distance, _, point = self.full_surface().closest(vertices)
                near = distance < _NOISE_REACH * JITTER_EDGES * median_edge(self.mesh)
                vertices[near] = point[near]
                error = float(distance.max())
            patch = RemeshPatch(simplified, self.request.quads, self.edge, self.request, self.full_surface)
            if error:
                error = max(error, max_distance(patch.surface, self.full_surface()))
            self.record.figures["simplify_error"] = error
            self.record.clock("simplify", start)
            if error <= self.edge or self.request.engine_seconds_left <= 0:
                break
            self.record.failed.append(f"simplify: strays {error / self.edge:.2g} edge lengths from the surface")
        return patch


def _quads_of(patch: RemeshPatch, record: Record) -> list[QuadResult]:
    """Make the quads of a patch, as one result or as several of its pieces."""
    if _uses_engines(patch, record):
        search = EngineSearch(patch, record)
        if (result := search.run()) is not None:
            return [result]
        if patch.pieces[0] > 1:
            start = time.perf_counter()
            result, good = accept_good_pieces(patch, search.whole)
            rest = remaining_patches(patch, good, patch.quads - (len(result.mesh.faces) if result is not None else 0))
            record.clock("pieces", start)
            accepted = [] if result is None else [result]
            return accepted + [piece for remaining in rest for piece in _quads_of(remaining, record)]
    start = time.perf_counter()
    result = QuadResult(split(patch), "pair and split")
    record.clock("fallback", start)
    return [result]


def _uses_engines(patch: RemeshPatch, record: Record) -> bool:
    """Return whether to try engines on a patch; if not, record the reason unless the request asked for it."""
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
    """Return the number of triangles that show all that the requested quads can."""
    return max(_TRIANGLES_PER_QUAD * request.quads, _MIN_TRIANGLES)


def _while_simplifying(request: Request, full_surface: Callable[[], ProjectionTarget]) -> None:
    """Prepare the next steps while a child simplifies: start engines' children, build the search tree, import modules.

    This waits until the child works: starting the engines slows this process, and building the tree holds the
    interpreter's lock.
    """
    prepare_engines(request)
    full_surface()
    for module in ("scipy.spatial", "embreex.mesh_construction", "embreex.rtcore_scene"):
        import_module(module)


def _simplified(run: _Remesher, topology_first: bool) -> TriMesh:
    """Simplify the triangles to what the quads need, creases restored; return the input where that fails."""
    request, record = run.request, run.record
    if len(run.mesh.faces) <= _triangles_needed(request):
        prepare_engines(request)
    restore = request.restore_creases and median_edge(run.mesh) < _MAX_CREASE_EDGE * run.edge
    options = SimplifyOptions(
        seconds=request.fallback_seconds,
        crease_degrees=request.crease_degrees if restore else 0.0,
        topology_first=topology_first,
        uniform=True,
        measure_error=False,
        is_closed=lambda: has_even_edge_counts(run.mesh.faces),
        while_waiting=lambda: _while_simplifying(request, run.full_surface),
    )
    simplified, _, report = simplify(run.mesh, _triangles_needed(request), options=options)
    record.figures |= {"simplified_to": report.faces} | (
        {"crease_vertices_restored": report.creases} if restore else {}
    )
    if report.failed is not None:
        record.failed.append(f"simplify: {report.failed}")
    return simplified
