"""A candidate drawn in a child while the one before it is drawn here: where that one is not good, it is wanted next."""

from __future__ import annotations

import numpy as np

from gdtool.core.child import Running, begin
from gdtool.core.threads import cores
from gdtool.geometry.quad_candidate import Candidate
from gdtool.geometry.quad_task import Part, Request

_DOUBT_EDGES = 1.4  # what an engine left nearer to the surface comes out good, nearly always
_SURE_EDGES = 0.6  # and so does what is nearer once it is traced


class Ahead:
    """Candidates of one part that are drawn ahead."""

    def __init__(self, part: Part):
        self._part = part
        self._running: dict[int, Running] = {}

    def begin(self, first: Candidate, one: Candidate) -> None:
        """Have it traced and drawn, where there is a core to spare and the first one, drawn here, is in doubt."""
        part, request = self._part, self._part.request
        if cores() > 1 and first.astray(part) > _DOUBT_EDGES:
            self._running[id(one)] = begin("gdtool.geometry.quad_child:finished", one, part.vertices, part.faces, part.quads, part.edge, request,
                                           seconds=request.for_a_run, memory_mb=request.memory_mb, in_case=True)

    def fetch(self, one: Candidate) -> None:
        """Wait for one that was begun; all else is left as it is, to be done here."""
        running = self._running.pop(id(one), None)
        if running is not None and (done := running.if_done()) is not None:
            vars(one).update(vars(done))

    def traced(self, first: Candidate, counted: bool) -> None:
        """Give up what was begun where the first one, now that its outline is known, is in doubt no longer, or no other has the number of quads."""
        if first.outline.far < _SURE_EDGES or not counted:
            self.stop()

    def stop(self) -> None:
        """Give up those that nobody waited for."""
        while self._running:
            self._running.popitem()[1].kill()


def finished(one: Candidate, vertices: np.ndarray, faces: np.ndarray, quads: int, edge: float, request: Request) -> Candidate:
    """What the child runs: the candidate traced and drawn."""
    part = Part(vertices, faces, quads, edge, request, fine=lambda: None)
    one.trace(part)
    one.draw(part)
    return one
