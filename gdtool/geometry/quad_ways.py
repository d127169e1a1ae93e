"""An engine's quads: made in a child in one way after the other, mended, judged, finished."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.geometry import repair
from gdtool.geometry.mesh_quality import scaled_jacobian, valences
from gdtool.geometry.quad_engines import ENGINES
from gdtool.geometry.quad_fit import farthest, finished, left_out, sticks_out
from gdtool.geometry.quad_shape import Surface, fill_holes, remove_doublets
from gdtool.geometry.quad_task import Part, Record, Request
from gdtool.geometry.quad_topology import cancel_irregular

COUNT_TOLERANCE = 0.03
_TRIES, _MOST_MORE = 3, 2.0  # of one way, to come near enough to the count; times what was asked for before
_CLOSE_EDGES, _LEAST_JACOBIAN = 0.55, 0.2  # nearer and squarer than this, a result is taken without a look at others
_FAR_EDGES, _FAR_SUBDIVIDED = 2.0, 1.0  # edge lengths that a result may stray; of a subdivided one, after which others come
_LOST_EDGES, _LOST_SHARE = 0.75, 0.003  # surface so far from the quads is lost on them, and how much of it may be
_MOST_FOLDED = 0.01  # of the quads
_CUT_EDGES, _CUT_SHARE = 0.25, 0.01  # surface so far from the quads lies beyond an edge that they cut off; how much of a piece may
_LOST, _ADDED, _PIECES = "handles are lost", "handles are added", "pieces are lost or joined"
_TOO_COARSE = _STRAYS, _LEAVES_OUT, _STICKS_OUT = "strays", "leaves out", "sticks out"
_MOST_TORN = 0.1  # of the quads may be missing from a result that another density may mend
_MENDINGS = 4  # rounds of filling holes and parting what meets at a vertex
_SHORTEST_RUN = 0.05  # seconds
_MANY = 3000  # quads of a mesh that is tried coarser and subdivided

Found = tuple[np.ndarray, np.ndarray, str]  # vertices (v, 3), quads (q, 4), the way that they were made


@dataclass(frozen=True)
class _Way:
    """An engine, the subdivisions after it, factors on the count to try side by side, the crease angle that it is told."""

    engine: str
    subdivisions: int
    factors: tuple[float, ...]
    degrees: float

    @property
    def label(self) -> str:
        return self.engine + (f", {self.subdivisions} subdivision" if self.subdivisions else "") + ("" if self.degrees else ", creases left out")

    def near(self, count: float) -> list[float]:
        """Numbers to ask for side by side, as far from one another as the first, `count` in their middle."""
        middle = sum(self.factors) / len(self.factors)
        return [count * factor / middle for factor in self.factors]

    @property
    def children(self) -> int:
        """Quads of the engine's own for each in the end."""
        return 4**self.subdivisions


def _ways(quads: int, request: Request) -> list[_Way]:
    """In the order to try.

    A coarser mesh subdivided has a quarter of the irregular vertices; it fails where features are finer than its quads.
    """
    engine = "instant-meshes" if request.engine == "auto" else request.engine
    out = [_Way(engine, 1, (0.99, 1.005), request.crease_degrees)] if engine == "instant-meshes" and quads >= _MANY else []
    # Where a seam of the engine's fields fails, it often holds at a slightly different density.
    out += [_Way(engine, 0, (1.0,), request.crease_degrees), _Way(engine, 0, (1.02,), request.crease_degrees), _Way(engine, 0, (0.98,), 0.0)]
    return out + [_Way("instant-meshes", 0, (1.0,), request.crease_degrees)] * (request.engine == "quadriflow")


def prepare_engines(quads: int, request: Request) -> None:
    """Start the children of the first way now (core.child.prepare)."""
    if request.engine != "split":
        prepare("gdtool.geometry.quad_engines", len(_ways(quads, request)[0].factors))


@dataclass
class _Result:
    """What an engine made of `asked`, mended, and what is wrong with it."""

    asked: float
    fault: str | None
    vertices: np.ndarray
    quads: np.ndarray
    count: int  # of the quads that it will have when it is subdivided

    def off(self, wanted: float) -> float:
        return self.count / wanted - 1

    def rank(self, wanted: float) -> tuple:
        return self.fault is not None, max(abs(self.off(wanted)), COUNT_TOLERANCE), _irregular(self.quads)


class Trial:
    """The ways tried on one part."""

    def __init__(self, part: Part, record: Record):
        self.part, self.record = part, record
        self.whole: Found | None = None  # of several pieces what an engine made of all of them, mended where it could be
        self._several = part.pieces[0] > 1  # what fails together can go piece by piece
        self._over = False
        self._second_best: Found | None = None
        self._given_up: set[str] = set()

    def run(self) -> Found | None:
        """The first way's quads that stand up to judgement, finished; None when none does."""
        for way in _ways(self.part.quads, self.part.request):
            if self.part.request.for_engines <= 0:
                self.record.failed.append(f"{way.label}: not tried, the time is over")
                self._over = True
                return self._bridged()
            if way.engine not in self._given_up and (found := self._by(way)) is not None:
                return found
            if self._over:
                return None
            if self._second_best is not None:
                break  # what one density bridges, another does too
        return self._bridged()

    def _by(self, way: _Way) -> Found | None:
        part, quads = self.part, self.part.quads
        asked, extra = [quads * factor for factor in way.factors], 0  # extra: quads of the tips that are drawn out of the engine's
        for turn in range(_TRIES):
            wanted = quads - extra
            results = sorted(self._results(way, asked), key=lambda result, wanted=wanted: result.rank(wanted))
            if not results:
                return None
            best = results[0]
            count, counted = best.count, abs(best.off(wanted)) <= COUNT_TOLERANCE
            together = self._several and not way.subdivisions
            if together and len(best.quads):
                self.whole = best.vertices, best.quads, way.label
            fine = best.fault is None or best.fault == _LOST and sticks_out(best.vertices, best.quads, part.surface) < 2 * _CLOSE_EDGES * part.edge
            if not counted and (fine or together):
                if turn and count * _MOST_MORE < wanted:
                    break  # small pieces are lost however many are asked for
                asked = way.near(best.asked * min(wanted / max(count, 1), _MOST_MORE))
                continue
            if counted and best.fault in (_LOST, _ADDED) and not way.subdivisions:
                self._second_best = best.vertices, best.quads, f"{way.label}, {best.fault}"
            if not fine:
                return self._failed(way, best.fault, torn=best.off(wanted) < -_MOST_TORN)
            vertices, found, taken = self._finished(way, [r for r in results if r.fault == best.fault and abs(r.off(wanted)) <= COUNT_TOLERANCE])
            if abs(len(found) / quads - 1) > COUNT_TOLERANCE:
                count, extra = len(found), len(found) - taken.count
                asked = way.near(taken.asked * (quads - extra) / taken.count)
                continue
            fault = fault_of(vertices, found, part.surface, part.edge, _FAR_SUBDIVIDED if way.subdivisions else _FAR_EDGES, part.piece)
            if taken.fault and (over := sticks_out(vertices, found, part.surface) / part.edge) > _CLOSE_EDGES:
                fault = f"{_STICKS_OUT} {over:.2g} edge lengths"  # else what is lost was finer than a quad
            if way.subdivisions and (least := scaled_jacobian(vertices, found).min()) < part.request.least_jacobian:
                fault = f"has a quad of scaled Jacobian {least:.2g}"
            if fault is not None:
                return self._failed(way, f"{taken.fault}; {fault}" if taken.fault else fault)
            return vertices, found, f"{way.label}, {taken.fault}" if taken.fault else way.label
        self.record.failed.append(f"{way.label}: gave {count} faces for {quads}")
        if not way.subdivisions:
            self._given_up.add(way.engine)
        return None

    def _results(self, way: _Way, asked: list[float]) -> list[_Result]:
        """What the engine makes of each number, side by side, mended and judged."""
        part, request, start = self.part, self.part.request, time.perf_counter()
        name = ENGINES["on few" if way.engine == "instant-meshes" and way.subdivisions else way.engine]
        running = [begin(name, part.vertices.astype(np.float32), part.faces.astype(np.int32), max(int(number / way.children), 16),
                         way.degrees, seconds=max(request.for_engines, _SHORTEST_RUN), memory_mb=request.memory_mb) for number in asked]
        _ = part.features, part.surface, part.fine()  # found out while the children work
        out = []
        for number, child in zip(asked, running, strict=True):
            try:
                fault, vertices, quads = judged(*child.result(), part.vertices, part.faces)
                out.append(_Result(number, fault, vertices, quads, len(quads) * way.children))
            except ChildFailed as failure:
                self.record.failed.append(f"{way.label}: {failure}")
        self.record.clock("engine", start)
        return out

    def _finished(self, way: _Way, results: list[_Result]) -> tuple[np.ndarray, np.ndarray, _Result]:
        """The first result finished; of a subdivided way the others too, until one has no thin quad and leaves no corner out."""
        part, start, best = self.part, time.perf_counter(), None
        for result in results:
            vertices, quads = finished(result.vertices, result.quads, part.surface, part.features, way.subdivisions, part.request, part.fine())
            far, least = farthest(vertices, quads, part.surface) / part.edge, float(scaled_jacobian(vertices, quads).min())
            good = far < _CLOSE_EDGES and least > _LEAST_JACOBIAN
            if best is None or good or far - 2 * least < best[0]:
                best = far - 2 * least, (vertices, quads, result)
            if good or not way.subdivisions:
                break
        self.record.clock("fit", start)
        return best[1]

    def _failed(self, way: _Way, fault: str, torn: bool = False) -> None:
        self.record.failed.append(f"{way.label}: {fault}")
        if not way.subdivisions:
            self._over = self._several
            # Another density mends a seam of the engine's fields, not a part that is too thin for so many quads.
            if torn or fault.startswith(_TOO_COARSE):
                self._given_up.add(way.engine)

    def _bridged(self) -> Found | None:
        """Closed and manifold, but a gap or tunnel finer than the quads was bridged or filled: still better than no engine."""
        if self._second_best is None:
            return None
        part, start = self.part, time.perf_counter()
        vertices, quads = finished(*self._second_best[:2], part.surface, part.features, 0, part.request, part.fine())
        self.record.clock("fit", start)
        return (vertices, quads, self._second_best[2]) if farthest(vertices, quads, part.surface) < _FAR_EDGES * part.edge else None


def _irregular(faces: np.ndarray) -> int:
    valence, inner = valences(faces, int(faces.max(initial=0)) + 1)
    return int((valence[inner] != 4).sum())


def fault_of(vertices: np.ndarray, quads: np.ndarray, surface: Surface, edge: float, limit: float, piece: bool) -> str | None:
    """What of finished quads does not do on the surface, or None.

    limit: edge lengths that they may stray. piece: it is one of several, and not most of them, so that paired triangles that keep its
    edges do better than quads that cut them off.
    """
    if (far := farthest(vertices, quads, surface) / edge) > limit:
        return f"{_STRAYS} {far:.2g} edge lengths from the surface"
    if (left := left_out(vertices, quads, surface, _LOST_EDGES * edge)) > _LOST_SHARE:
        return f"{_LEAVES_OUT} {left:.1%} of the surface"
    if (over := sticks_out(vertices, quads, surface) / edge) > limit:
        return f"{_STICKS_OUT} {over:.2g} edge lengths"
    if (folded := float((scaled_jacobian(vertices, quads) <= 0).mean())) > _MOST_FOLDED:
        return f"{folded:.1%} of the quads are folded"
    if piece and (cut := left_out(vertices, quads, surface, _CUT_EDGES * edge)) > _CUT_SHARE:
        return f"cuts off {cut:.1%} of the surface"
    return None


def judged(quad_vertices: np.ndarray, quad_faces: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> tuple[str | None, np.ndarray, np.ndarray]:
    """What is wrong with an engine's result, or None, and the result without its small defects."""
    if quad_faces.ndim != 2 or quad_faces.shape[1] != 4 or not len(quad_faces):
        return "no quads", quad_vertices, quad_faces
    if quad_faces.min() < 0 or quad_faces.max() >= len(quad_vertices) or not np.isfinite(quad_vertices).all():
        return "indices or coordinates out of range", quad_vertices, quad_faces
    whole = (np.sort(quad_faces, 1)[:, 1:] != np.sort(quad_faces, 1)[:, :-1]).all(1)
    if not whole.any():
        return "no quads", quad_vertices, quad_faces
    quad_vertices, quad_faces = repair.compact(quad_vertices, quad_faces[whole])
    closed = repair.is_watertight(faces)
    pieces = repair.components(faces)[0]
    for turn in range(_MENDINGS):
        if turn and (not closed or repair.is_watertight(quad_faces)):
            break
        if closed:
            quad_vertices, quad_faces = fill_holes(quad_vertices, quad_faces)
        # What parts where fans met at a vertex, and what lay in a hole as a piece of its own, leave holes to fill.
        quad_vertices, quad_faces = remove_doublets(*repair.one_vertex_per_fan(quad_vertices, quad_faces))
        quad_vertices, quad_faces = cancel_irregular(quad_vertices, quad_faces)
        quad_vertices, quad_faces = repair.without_crumbs(quad_vertices, quad_faces, pieces)
        if not len(quad_faces):
            return "no quads", quad_vertices, quad_faces
    if closed and not repair.is_watertight(quad_faces):
        return "not watertight, though the input is", quad_vertices, quad_faces
    if not repair.is_manifold(quad_faces):
        return "not manifold", quad_vertices, quad_faces
    if repair.components(quad_faces)[0] != pieces:
        return _PIECES, quad_vertices, quad_faces
    if closed and (more := repair.euler_number(quad_faces) - repair.euler_number(faces)):
        return _LOST if more > 0 else _ADDED, quad_vertices, quad_faces
    return None, quad_vertices, quad_faces
