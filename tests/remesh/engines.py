"""Stand-ins for engines, and candidates made in the test's own process."""

from __future__ import annotations

import numpy as np

from gdtool.core.child import ChildFailed
from gdtool.geometry import topology
from gdtool.remesh.engines import candidate as candidates
from gdtool.remesh.engines import search


def is_watertight_manifold(faces) -> bool:
    """Return whether all faces are quads, watertight and manifold."""
    return faces.min() >= 0 and topology.is_watertight(faces) and topology.is_manifold(faces)


class Ended:
    """A child process that has ended with a result or a failure."""

    def __init__(self, outcome):
        self.outcome = outcome

    def kill(self):
        pass

    def result(self):
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def in_this_process(monkeypatch, engine=None) -> list:
    """Make candidates in this process instead of in children; return the list of calls, filled as they come.

    engine: replaces every engine, unless it is None.
    """
    calls = []

    def begin(_, *arguments, **limits):
        calls.append(arguments)
        try:
            return Ended(candidates.make_candidate(*arguments))
        except ChildFailed as failure:
            return Ended(failure)

    if engine is not None:
        monkeypatch.setattr(candidates, "ENGINES", dict.fromkeys(candidates.ENGINES, engine))
    monkeypatch.setattr(search, "begin", begin)
    return calls


def around(faces, middle) -> tuple[np.ndarray, np.ndarray]:
    """Find the faces that touch face `middle` at one corner only, and those that share an edge with it."""
    shared = np.isin(faces, faces[middle]).sum(1)
    return np.flatnonzero(shared == 1), np.flatnonzero(shared == 2)


def inner_face(vertices, faces) -> int:
    """Find a face in the middle of a cube's side."""
    centre = vertices[faces].mean(1)
    return int(np.linalg.norm(centre - [0.07, 0.07, centre[:, 2].max()], axis=1).argmin())
