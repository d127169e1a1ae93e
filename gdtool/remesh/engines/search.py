"""Search for an engine's quads: try engines and quad counts in order, and fit the best candidate to the surface."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.geometry.simplify import CHILD_MODULES
from gdtool.remesh.engines.candidate import Candidate, EngineAttempt, make_candidate
from gdtool.remesh.fit.shaping import FAR_EDGES, TOO_COARSE, finalize
from gdtool.remesh.task import QuadResult, Record, RemeshPatch, Request

_PARALLEL_CANDIDATES = 2  # children of the first attempt
_MAX_ROUNDS = 3  # of one attempt, each with a corrected request, to come near enough to the count
_MAX_GROWTH = 2.0  # a round requests at most this many times the count of the round before
_MAX_TORN_SHARE = 0.1  # of the quads may be missing from a result that another density may repair
# Megabytes of an engine's child, and more for each quad and triangle: several times what it needs. The limit is for
# holes that Instant Meshes fills without end, half a gigabyte a second.
_BASE_MEMORY_MB, _MEMORY_MB_PER_FACE = 2000, 4e-3
# Quads: a coarser mesh subdivided to fewer for each handle loses some handles (benchmarks/remesh/nets.py).
_MIN_QUADS_PER_HANDLE = 250
_MIN_SUBDIVIDED_QUADS = 3000  # quads: smaller meshes are not tried coarser and subdivided
# Edge lengths: with an engine's quads farther than this from the surface the best candidate is in doubt ...
_DOUBTFUL_EDGES = 1.75
_MUCH_NEARER = 0.75  # ... and one within this share of its distance goes before it.


def _attempts(quads: int, request: Request) -> list[EngineAttempt]:
    """List the attempts for this many quads, in the order to try them.

    A coarser mesh subdivided has a quarter of the irregular vertices. It fails where features or walls are finer than
    the coarse quads. Where an engine's quads fail along a seam of its orientation field, a count that differs by 2 %
    often succeeds.
    """
    engine = "instant-meshes" if request.engine == "auto" else request.engine
    attempts = (
        [EngineAttempt(engine, 1, (0.985, 1.005), request.crease_degrees)]
        if engine == "instant-meshes" and quads >= _MIN_SUBDIVIDED_QUADS
        else []
    )
    attempts += [
        EngineAttempt(engine, 0, (1.0,), request.crease_degrees),
        EngineAttempt(engine, 0, (1.02,), request.crease_degrees),
        EngineAttempt(engine, 0, (0.98,), 0.0),
    ]
    if request.engine == "quadriflow":
        attempts.append(EngineAttempt("instant-meshes", 0, (1.0,), request.crease_degrees))
    return attempts


def prepare_engines(request: Request) -> None:
    """Start the child processes of the first attempt, so that they import their modules while the caller works."""
    if request.engine != "split":
        prepare(make_candidate, CHILD_MODULES, _PARALLEL_CANDIDATES)


class EngineAnswer(NamedTuple):
    """The number of quads requested from an engine, and the number that it returned."""

    requested: float
    received: int


def _interpolate_request(answers: list[EngineAnswer], wanted: float) -> float | None:
    """Interpolate the count to request from an answer with too few quads and one with too many.

    Returns None unless there is an answer of each kind.
    """
    fewer = [answer for answer in answers if answer.received < wanted]
    more = [answer for answer in answers if answer.received > wanted]
    if not fewer or not more:
        return None
    (low, below) = max(fewer, key=lambda answer: answer.received)
    (high, above) = min(more, key=lambda answer: answer.received)
    return low + (high - low) * (wanted - below) / (above - below)


class EngineSearch:
    """A search for the quads of one patch, by several attempts.

    record: gets the reason of each attempt that fails.
    """

    def __init__(self, patch: RemeshPatch, record: Record):
        self.patch, self.record = patch, record
        self.whole: Candidate | None = None  # for several pieces: the last result for all of them together
        self._has_pieces = patch.pieces[0] > 1  # pieces that fail together can go one by one
        self._stopped = False
        self._acceptable: Candidate | None = None  # a subdivided result that would do as a finer one
        self._bridged: Candidate | None = None  # a result with a gap or tunnel bridged or filled
        self._skipped_engines: set[str] = set()

    def run(self) -> QuadResult | None:
        """Try the attempts in order; return the first acceptable quads, finalized, or None."""
        for attempt in _attempts(self.patch.quads, self.patch.request):
            if self.patch.request.engine_seconds_left <= 0:
                self.record.failed.append(f"{attempt.label}: not tried, the time is over")
                self._stopped = True
                return self._finalize_acceptable() or self._finalize_bridged()
            if attempt.subdivisions and (why := self._why_not_coarser()):
                self.record.failed.append(f"{attempt.label}: not tried, {why}")
                continue
            # One attempt at full density is enough where there is something to fall back to.
            is_last = not attempt.subdivisions and self._acceptable is not None
            if attempt.engine not in self._skipped_engines and (result := self._try(attempt)) is not None:
                return result
            if self._stopped:
                return self._finalize_acceptable()
            if is_last or self._bridged is not None:
                break  # what one density bridges, another does too
        return self._finalize_acceptable() or self._finalize_bridged()

    def _why_not_coarser(self) -> str | None:
        """Return why subdividing a coarser mesh is known to fail on this patch, else None."""
        if self.patch.quads < _MIN_QUADS_PER_HANDLE * self.patch.handles:
            return f"so few quads lose some of {self.patch.handles} handles"
        return "its quads are wider than the strips between creases" if self.patch.has_narrow_strips else None

    def _try(self, attempt: EngineAttempt) -> QuadResult | None:
        """Request quads in up to _MAX_ROUNDS rounds, each with a corrected count, and fit the best to the surface."""
        quads = self.patch.quads
        requests = [quads * factor for factor in attempt.factors]
        tip_quads = 0  # quads that tip extrusion adds to the engine's
        answers: list[EngineAnswer] = []
        for turn in range(_MAX_ROUNDS):
            wanted = quads - tip_quads
            candidates = self._candidates(attempt, requests, wanted)
            if not candidates:
                return None
            best = candidates[0]
            count, has_count = best.count, self.patch.has_count(best.count, wanted)
            usable = best.is_usable(self.patch)
            is_together = self._has_pieces and not attempt.subdivisions
            if is_together and len(best.mesh.faces):
                self.whole = best
            if (
                (is_together or usable and (self._has_pieces or not has_count))
                and len(best.mesh.faces)
                and (missing := best.missing_surface(self.patch))
            ):
                self._fail(attempt, missing)
                return None
            if not has_count and (usable or is_together):
                if turn and count * _MAX_GROWTH < wanted:
                    break  # small pieces are lost however many quads are requested
                answers += [
                    EngineAnswer(candidate.requested, candidate.count)
                    for candidate in candidates
                    if candidate.fault == best.fault
                ]
                requests = attempt.counts_around(
                    _interpolate_request(answers, wanted) or best.requested * min(wanted / max(count, 1), _MAX_GROWTH)
                )
                continue
            if has_count and best.is_bridged and not attempt.subdivisions:
                self._bridged = best
            if not usable:
                self._fail(attempt, best.fault, torn=best.count_error(wanted) < -_MAX_TORN_SHARE)
                return None
            in_order = self._fit_order(attempt, candidates, wanted)
            taken = self._fit_first_good(self._with_right_count(in_order, tip_quads))
            if taken is not None and taken.rejection is not None:
                self._reject(taken)
                return None
            if taken is None:  # the first was snapped, and does not have the count together with its tips
                taken, count = in_order[0], in_order[0].snapped_count
            else:
                count = taken.fitted_count
            if not self.patch.has_count(count, quads):
                tip_quads = count - taken.count
                requests = attempt.counts_around(taken.requested * (quads - tip_quads) / taken.count)
                continue
            return self._finalized(taken)
        self.record.failed.append(f"{attempt.label}: gave {count} faces for {quads}")
        if not attempt.subdivisions:
            self._skipped_engines.add(attempt.engine)
        return None

    def _fit_order(self, attempt: EngineAttempt, candidates: list[Candidate], wanted: float) -> list[Candidate]:
        """Sort the candidates that have the same fault as the best one into the order to fit them."""
        alike = [candidate for candidate in candidates if candidate.fault == candidates[0].fault]
        if attempt.subdivisions and len(alike) > 1:
            alike = self._nearer_first(alike, wanted)
        return alike

    def _reject(self, taken: Candidate) -> None:
        """Record why a fitted candidate is rejected; keep it if it passes the limits of results without subdivision."""
        if taken.acceptable_as_finer and self.patch.has_count(taken.fitted_count, self.patch.quads):
            self._acceptable = taken
        self._fail(taken.attempt, f"{taken.fault}; {taken.rejection}" if taken.fault else taken.rejection)

    def _candidates(self, attempt: EngineAttempt, requests: list[float], wanted: float) -> list[Candidate]:
        """Run one child for each requested count, side by side, and return the candidates, best first."""
        patch, request, start = self.patch, self.patch.request, time.perf_counter()
        running = [
            begin(
                make_candidate,
                patch.mesh,
                attempt,
                number,
                seconds=request.child_seconds,
                memory_mb=min(
                    int(_BASE_MEMORY_MB + _MEMORY_MB_PER_FACE * (number + len(patch.mesh.faces))), request.memory_mb
                ),
            )
            for number in requests
        ]
        # Computed while the children work.
        if attempt.subdivisions and patch.has_thin_walls:
            for child in running:
                child.kill()
            self.record.failed.append(f"{attempt.label}: given up, walls are thinner than its quads")
            self.record.clock("engine", start)
            return []
        _ = patch.features, patch.surface, patch.full_surface()
        candidates = []
        for child in running:
            try:
                candidates.append(child.result())
            except ChildFailed as failure:
                self.record.failed.append(f"{attempt.label}: {failure}")
        self.record.clock("engine", start)
        return sorted(candidates, key=lambda candidate: candidate.rank(wanted, patch.tolerance))

    def _nearer_first(self, candidates: list[Candidate], wanted: float) -> list[Candidate]:
        """Swap the first two candidates where the first is far from the surface and the second much nearer to it."""
        first, second, *others = candidates
        distance = first.raw_distance(self.patch)
        swap = (
            distance > _DOUBTFUL_EDGES
            and self.patch.has_count(second.count, wanted)
            and second.raw_distance(self.patch) < _MUCH_NEARER * distance
        )
        return [second, first, *others] if swap else candidates

    def _with_right_count(self, candidates: list[Candidate], tip_quads: int) -> Iterator[Candidate]:
        """Yield the candidates whose count, tips included, is the wanted one, and the hopeless ones.

        Hopeless: see SnappedQuads. tip_quads: the quads that tips are expected to add, until a candidate is snapped.
        """
        quads = self.patch.quads
        for candidate in candidates:
            if candidate is not candidates[0] and not self.patch.has_count(candidate.count + tip_quads, quads):
                continue
            candidate.snap(self.patch)
            tip_quads = candidate.snapped_count - candidate.count
            if candidate.snapped.hopeless or self.patch.has_count(candidate.count + tip_quads, quads):
                yield candidate

    def _fit_first_good(self, candidates: Iterable[Candidate]) -> Candidate | None:
        """Fit candidates until one is good, and return it; where none is good, return the nearest to the surface.

        Promising ones come first.
        """
        start, done = time.perf_counter(), []
        for candidate in self._promising_first(candidates):
            candidate.fit(self.patch)
            done.append(candidate)
            if candidate.is_good or not candidate.attempt.subdivisions:
                break
        self.record.clock("fit", start)
        if not done or done[-1].is_good:
            return done[-1] if done else None
        return min(
            done,
            key=lambda candidate: (
                candidate.rejection is not None,
                candidate.distance_edges - 2 * candidate.min_jacobian,
            ),
        )

    def _promising_first(self, candidates: Iterable[Candidate]) -> Iterator[Candidate]:
        """Yield promising candidates as they come, and the others after these."""
        late = []
        for candidate in candidates:
            if candidate.is_promising(self.patch):
                yield candidate
            else:
                late.append(candidate)
        yield from late

    def _finalized(self, taken: Candidate) -> QuadResult:
        """Finalize the quads of a fitted candidate."""
        start = time.perf_counter()
        assert taken.fitted is not None
        mesh = finalize(taken.fitted, self.patch.full_surface(), self.patch.request)
        self.record.clock("fit", start)
        label = taken.attempt.label
        return QuadResult(mesh, f"{label}, {taken.fault}" if taken.fault else label)

    def _fail(self, attempt: EngineAttempt, reason: str, torn: bool = False) -> None:
        """Record why an attempt failed, and skip the attempts that would fail for the same reason.

        torn: whether more quads are missing than another density can bring back.
        """
        self.record.failed.append(f"{attempt.label}: {reason}")
        if not attempt.subdivisions:
            self._stopped = self._has_pieces
            # Another density repairs a seam of the engine's fields, not a part too thin for this many quads.
            if torn or reason.startswith(TOO_COARSE):
                self._skipped_engines.add(attempt.engine)

    def _finalize_acceptable(self) -> QuadResult | None:
        """Finalize the subdivided result that passes only the limits of results without subdivision; None if none."""
        return None if self._acceptable is None else self._finalized(self._acceptable)

    def _finalize_bridged(self) -> QuadResult | None:
        """Finalize the result that bridges a gap or tunnel finer than its quads; None without one.

        It is still better than the fallback.
        """
        best = self._bridged
        if best is None:
            return None
        if best.fitted is None:
            self._fit_first_good([best])
        return self._finalized(best) if best.distance_edges <= FAR_EDGES else None
