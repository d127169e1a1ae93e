"""An engine's quads: candidates made in children in one way after the other, the best of them judged on the surface."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.geometry.features import Constraints
from gdtool.geometry.mesh_quality import scaled_jacobian
from gdtool.geometry.quad_candidate import CLOSE_EDGES, COUNT_TOLERANCE, Candidate, Way
from gdtool.geometry.quad_fit import farthest, left_out, settled, sticks_out
from gdtool.geometry.quad_shape import Surface
from gdtool.geometry.quad_task import Part, Record, Request

_TRIES, _MOST_MORE = 3, 2.0  # of one way, to come near enough to the count; times what was asked for before
_FAR_EDGES, _FAR_SUBDIVIDED = 2.0, 1.0  # edge lengths that a result may stray; of a subdivided one, after which others come
_LOST_EDGES, _LOST_SHARE = 0.75, 0.003  # surface so far from the quads is lost on them, and how much of it may be
_MOST_FOLDED = 0.01  # of the quads
_CUT_EDGES, _CUT_SHARE = 0.25, 0.01  # surface so far from the quads lies beyond an edge that they cut off; how much of a piece may
_TOO_COARSE = _STRAYS, _LEAVES_OUT, _STICKS_OUT = "strays", "leaves out", "sticks out"
_MOST_TORN = 0.1  # of the quads may be missing from a result that another density may mend
_SHORTEST_RUN = 0.05  # seconds
_MANY = 3000  # quads of a mesh that is tried coarser and subdivided

Found = tuple[np.ndarray, np.ndarray, str]  # vertices (v, 3), quads (q, 4), the way that they were made


def _ways(quads: int, request: Request) -> list[Way]:
    """In the order to try.

    A coarser mesh subdivided has a quarter of the irregular vertices; it fails where features are finer than its quads.
    """
    engine = "instant-meshes" if request.engine == "auto" else request.engine
    out = [Way(engine, 1, (0.99, 1.005), request.crease_degrees)] if engine == "instant-meshes" and quads >= _MANY else []
    # Where a seam of the engine's fields fails, it often holds at a slightly different density.
    out += [Way(engine, 0, (1.0,), request.crease_degrees), Way(engine, 0, (1.02,), request.crease_degrees), Way(engine, 0, (0.98,), 0.0)]
    return out + [Way("instant-meshes", 0, (1.0,), request.crease_degrees)] * (request.engine == "quadriflow")


def prepare_engines(quads: int, request: Request) -> None:
    """Start the children of the first way now (core.child.prepare)."""
    if request.engine != "split":
        prepare("gdtool.geometry.quad_candidate", len(_ways(quads, request)[0].factors))


class Trial:
    """The ways tried on one part."""

    def __init__(self, part: Part, record: Record):
        self.part, self.record = part, record
        self.whole: Found | None = None  # of several pieces what an engine made of all of them, mended where it could be
        self._several = part.pieces[0] > 1  # what fails together can go piece by piece
        self._over = False
        self._second_best: tuple[Candidate, str] | None = None
        self._given_up: set[str] = set()

    def run(self) -> Found | None:
        """The first way's quads that stand up to judgement, settled; None when none does."""
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

    def _by(self, way: Way) -> Found | None:
        part, quads = self.part, self.part.quads
        asked, extra = [quads * factor for factor in way.factors], 0  # extra: quads of the tips that are drawn out of the engine's
        for turn in range(_TRIES):
            wanted = quads - extra
            candidates = self._candidates(way, asked, wanted)
            if not candidates:
                return None
            best = candidates[0]
            count, counted = best.count, best.counted(wanted)
            together = self._several and not way.subdivisions
            if together and len(best.quads):
                self.whole = best.vertices, best.quads, way.label
            if not counted and (best.usable or together):
                if turn and count * _MOST_MORE < wanted:
                    break  # small pieces are lost however many are asked for
                asked = way.near(best.asked * min(wanted / max(count, 1), _MOST_MORE))
                continue
            if counted and best.bridged and best.drawn is not None:
                self._second_best = best, f"{way.label}, {best.fault}"
            if not best.usable:
                return self._failed(way, best.fault, torn=best.off(wanted) < -_MOST_TORN)
            taken = _chosen([one for one in candidates if one.drawn is not None and one.fault == best.fault])
            if abs((count := len(taken.drawn[1])) / quads - 1) > COUNT_TOLERANCE:
                extra = count - taken.count
                asked = way.near(taken.asked * (quads - extra) / taken.count)
                continue
            vertices, found = self._settled(*taken.drawn)
            fault = fault_of(vertices, found, part.surface, part.edge, _FAR_SUBDIVIDED if way.subdivisions else _FAR_EDGES, part.piece)
            if taken.fault and (over := sticks_out(vertices, found, part.surface) / part.edge) > CLOSE_EDGES:
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

    def _candidates(self, way: Way, asked: list[float], wanted: float) -> list[Candidate]:
        """What comes of each number asked for, made side by side, the best first."""
        part, request, start = self.part, self.part.request, time.perf_counter()
        alone = replace(part, fine=None)  # without what has been found out of it, and without the input
        running = [begin("gdtool.geometry.quad_candidate:candidate", alone, way, number, wanted,
                         seconds=max(request.for_engines, _SHORTEST_RUN), memory_mb=request.memory_mb) for number in asked]
        _ = part.surface, part.fine()  # built while the children work
        out = []
        for child in running:
            try:
                out.append(child.result())
            except ChildFailed as failure:
                self.record.failed.append(f"{way.label}: {failure}")
        self.record.clock("engine", start)
        return sorted(out, key=lambda one: one.rank(wanted))

    def _settled(self, vertices: np.ndarray, quads: np.ndarray, constraints: Constraints) -> tuple[np.ndarray, np.ndarray]:
        start = time.perf_counter()
        out = settled(vertices, quads, constraints, self.part.fine(), self.part.request)
        self.record.clock("fit", start)
        return out

    def _failed(self, way: Way, fault: str, torn: bool = False) -> None:
        self.record.failed.append(f"{way.label}: {fault}")
        if not way.subdivisions:
            self._over = self._several
            # Another density mends a seam of the engine's fields, not a part that is too thin for so many quads.
            if torn or fault.startswith(_TOO_COARSE):
                self._given_up.add(way.engine)

    def _bridged(self) -> Found | None:
        """A gap or tunnel finer than the quads was bridged or filled: still better than no engine."""
        if self._second_best is None:
            return None
        best, label = self._second_best
        vertices, quads = self._settled(*best.drawn)
        return (vertices, quads, label) if farthest(vertices, quads, self.part.surface) < _FAR_EDGES * self.part.edge else None


def _chosen(candidates: list[Candidate]) -> Candidate:
    """The first that has no thin quad and leaves no corner out; where none is so good, the one that comes nearest to it."""
    return next((one for one in candidates if one.good), None) or min(candidates, key=lambda one: one.far - 2 * one.least)


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
