"""An engine's quads: candidates made in children in one way after the other, the best of them judged on the surface."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import numpy as np

from gdtool.core.child import ChildFailed, begin, prepare
from gdtool.geometry.simplify import CHILD_MODULES
from gdtool.remesh.engines.candidate import Candidate, Way, candidate
from gdtool.remesh.fit.shaping import FAR_EDGES, TOO_COARSE, settled
from gdtool.remesh.task import Part, Record, Request

_AT_ONCE = 2  # candidates of the first way
_TRIES, _MOST_MORE = 3, 2.0  # of one way, to come near enough to the count; times what was asked for before
_MOST_TORN = 0.1  # of the quads may be missing from a result that another density may mend
# Megabytes that an engine has, and more for each quad and triangle: several times what it needs, but for holes that
# Instant Meshes fills for ever, with half a gigabyte a second.
_MEMORY = 2000, 4e-3
_FOR_A_HANDLE = 250  # quads: a coarser mesh subdivided to fewer loses some
_MANY = 3000  # quads of a mesh that is tried coarser and subdivided
# So far from the surface the best may not come out good: one at so many times its distance goes before it.
_ASTRAY_EDGES, _NEARER = 1.75, 0.75

Found = tuple[np.ndarray, np.ndarray, str]  # vertices (v, 3), quads (q, 4), the way that they were made


def _ways(quads: int, request: Request) -> list[Way]:
    """In the order to try.

    A coarser mesh subdivided has a quarter of the irregular vertices; it fails where features, or walls, are finer than
    its quads."""
    engine = "instant-meshes" if request.engine == "auto" else request.engine
    out = (
        [Way(engine, 1, (0.985, 1.005), request.crease_degrees)]
        if engine == "instant-meshes" and quads >= _MANY
        else []
    )
    # Where a seam of the engine's fields fails, it often holds at a slightly different density.
    out += [
        Way(engine, 0, (1.0,), request.crease_degrees),
        Way(engine, 0, (1.02,), request.crease_degrees),
        Way(engine, 0, (0.98,), 0.0),
    ]
    return out + [Way("instant-meshes", 0, (1.0,), request.crease_degrees)] * (request.engine == "quadriflow")


def prepare_engines(quads: int, request: Request) -> None:
    """Start the children of the first way now (core.child.prepare)."""
    if request.engine != "split":
        prepare(candidate, CHILD_MODULES, _AT_ONCE)


def _between(gave: list[tuple[float, int]], wanted: float) -> float | None:
    """What to ask for where one number gave fewer quads than wanted and another more: a number between them. gave:
    (asked, count) of each."""
    fewer, more = [one for one in gave if one[1] < wanted], [one for one in gave if one[1] > wanted]
    if not fewer or not more:
        return None
    (low, below), (high, above) = max(fewer, key=lambda one: one[1]), min(more, key=lambda one: one[1])
    return low + (high - low) * (wanted - below) / (above - below)


class Trial:
    """The ways tried on one part."""

    def __init__(self, part: Part, record: Record):
        self.part, self.record = part, record
        self.whole: Candidate | None = None  # of several pieces what an engine made of all of them
        self._several = part.pieces[0] > 1  # what fails together can go piece by piece
        self._over = False
        self._passable: Candidate | None = None
        self._second_best: Candidate | None = None
        self._given_up: set[str] = set()

    def run(self) -> Found | None:
        """The first way's quads that stand up to judgement, settled; None when none does."""
        for way in _ways(self.part.quads, self.part.request):
            if self.part.request.for_engines <= 0:
                self.record.failed.append(f"{way.label}: not tried, the time is over")
                self._over = True
                return self._passed() or self._bridged()
            if way.subdivisions and (why := self._hopeless()):
                self.record.failed.append(f"{way.label}: not tried, {why}")
                continue
            tried = not way.subdivisions and self._passable is not None
            if way.engine not in self._given_up and (found := self._by(way)) is not None:
                return found
            if self._over:
                return self._passed()
            if tried or self._second_best is not None:
                break  # what one density bridges, another does too
        return self._passed() or self._bridged()

    def _hopeless(self) -> str | None:
        """What is known to be wrong with a coarser mesh subdivided before it is made."""
        if self.part.quads < _FOR_A_HANDLE * self.part.handles:
            return f"so few quads lose some of {self.part.handles} handles"
        return "its quads are wider than the strips between creases" if self.part.narrow else None

    def _by(self, way: Way) -> Found | None:
        quads = self.part.quads
        # extra: quads of the tips that are drawn out of the engine's.
        asked, extra = [quads * factor for factor in way.factors], 0
        gave: list[tuple[float, int]] = []
        for turn in range(_TRIES):
            wanted = quads - extra
            candidates = self._candidates(way, asked, wanted)
            if not candidates:
                return None
            best = candidates[0]
            count, counted, usable = best.count, self.part.counted(best.count, wanted), best.usable(self.part)
            together = self._several and not way.subdivisions
            if together and len(best.quads):
                self.whole = best
            if (
                (together or usable and (self._several or not counted))
                and len(best.quads)
                and (bare := best.leaves_out(self.part))
            ):
                return self._failed(way, bare)
            if not counted and (usable or together):
                if turn and count * _MOST_MORE < wanted:
                    break  # small pieces are lost however many are asked for
                gave += [(one.asked, one.count) for one in candidates if one.fault == best.fault]
                asked = way.near(_between(gave, wanted) or best.asked * min(wanted / max(count, 1), _MOST_MORE))
                continue
            if counted and best.bridged and not way.subdivisions:
                self._second_best = best
            if not usable:
                return self._failed(way, best.fault, torn=best.off(wanted) < -_MOST_TORN)
            like = [one for one in candidates if one.fault == best.fault]
            if way.subdivisions and len(like) > 1:
                like = self._nearer_first(like, wanted)
                best = like[0]
            taken = self._drawn(self._of_count(like, extra))
            if taken is not None and taken.wrong is not None:
                if taken.passable and self.part.counted(len(taken.drawn[1]), quads):
                    self._passable = taken
                return self._failed(way, f"{taken.fault}; {taken.wrong}" if taken.fault else taken.wrong)
            taken, count = (best, len(best.outline.faces)) if taken is None else (taken, len(taken.drawn[1]))
            if not self.part.counted(count, quads):
                extra = count - taken.count
                asked = way.near(taken.asked * (quads - extra) / taken.count)
                continue
            return self._settled(taken)
        self.record.failed.append(f"{way.label}: gave {count} faces for {quads}")
        if not way.subdivisions:
            self._given_up.add(way.engine)
        return None

    def _candidates(self, way: Way, asked: list[float], wanted: float) -> list[Candidate]:
        """What comes of each number asked for, made side by side, the best first."""
        part, request, start = self.part, self.part.request, time.perf_counter()
        running = [
            begin(
                candidate,
                part.vertices,
                part.faces,
                way,
                number,
                seconds=request.for_a_run,
                memory_mb=min(int(_MEMORY[0] + _MEMORY[1] * (number + len(part.faces))), request.memory_mb),
            )
            for number in asked
        ]
        # Found out while the children work.
        if way.subdivisions and part.thin:
            for child in running:
                child.kill()
            self.record.failed.append(f"{way.label}: given up, walls are thinner than its quads")
            self.record.clock("engine", start)
            return []
        _ = part.features, part.surface, part.fine()
        out = []
        for child in running:
            try:
                out.append(child.result())
            except ChildFailed as failure:
                self.record.failed.append(f"{way.label}: {failure}")
        self.record.clock("engine", start)
        return sorted(out, key=lambda one: one.rank(wanted, part.tolerance))

    def _nearer_first(self, candidates: list[Candidate], wanted: float) -> list[Candidate]:
        """The second before the first where the first is in doubt, and the second much nearer to the surface."""
        first, second, *others = candidates
        far = first.astray(self.part)
        nearer = (
            far > _ASTRAY_EDGES and self.part.counted(second.count, wanted) and second.astray(self.part) < _NEARER * far
        )
        return [second, first, *others] if nearer else candidates

    def _of_count(self, candidates: list[Candidate], extra: int) -> Iterator[Candidate]:
        """Those that have about as many quads as asked for once tips are drawn out of theirs, at the first `extra`
        more, and those that are hopeless."""
        quads = self.part.quads
        for one in candidates:
            if one is not candidates[0] and not self.part.counted(one.count + extra, quads):
                continue
            one.trace(self.part)
            extra = len(one.outline.faces) - one.count
            if one.outline.hopeless or self.part.counted(one.count + extra, quads):
                yield one

    def _drawn(self, candidates: Iterable[Candidate]) -> Candidate | None:
        """The first that comes out good, those that do not promise to last; where none does the one that comes nearest
        to the surface."""
        start, done = time.perf_counter(), []
        for one in self._promising_first(candidates):
            one.draw(self.part)
            done.append(one)
            if one.good or not one.way.subdivisions:
                break
        self.record.clock("fit", start)
        if not done or done[-1].good:
            return done[-1] if done else None
        return min(done, key=lambda one: (one.wrong is not None, one.far - 2 * one.least))

    def _promising_first(self, candidates: Iterable[Candidate]) -> Iterator[Candidate]:
        late = []
        for one in candidates:
            if one.promising(self.part):
                yield one
            else:
                late.append(one)
        yield from late

    def _settled(self, taken: Candidate) -> Found:
        start = time.perf_counter()
        found = settled(*taken.drawn, self.part.fine(), self.part.request)
        self.record.clock("fit", start)
        return *found, f"{taken.way.label}, {taken.fault}" if taken.fault else taken.way.label

    def _failed(self, way: Way, fault: str, torn: bool = False) -> None:
        self.record.failed.append(f"{way.label}: {fault}")
        if not way.subdivisions:
            self._over = self._several
            # Another density mends a seam of the engine's fields, not a part that is too thin for so many quads.
            if torn or fault.startswith(TOO_COARSE):
                self._given_up.add(way.engine)

    def _passed(self) -> Found | None:
        """A subdivided result that is no worse than what is taken of a finer one: better than none."""
        return None if self._passable is None else self._settled(self._passable)

    def _bridged(self) -> Found | None:
        """A gap or tunnel finer than the quads was bridged or filled: still better than no engine."""
        best = self._second_best
        if best is None:
            return None
        if best.drawn is None:
            self._drawn([best])
        return self._settled(best) if best.far <= FAR_EDGES else None
