"""What is drawn in a child, in case that it is wanted, is what is drawn in turn."""

import numpy as np
import pytest

from gdtool.geometry import quad_ahead, quad_candidate, quads
from gdtool.geometry.quad_candidate import Candidate
from gdtool.geometry.quad_task import Request
from tests.geometry.solids import sphere


@pytest.mark.parametrize("child", ["works", "is gone", "is not wanted"])
def test_drawn_ahead_or_in_turn(monkeypatch, child):
    vertices, faces = sphere(96, 0.45)
    if child != "is not wanted":
        monkeypatch.setattr(Candidate, "good", property(lambda self: False))  # the first is not taken without a look at the second
    monkeypatch.setattr(quad_ahead, "cores", lambda: 1)
    in_turn = quads.remesh(vertices, faces, Request(quads=4000))
    begun, begin, killed = [], quad_ahead.begin, []
    monkeypatch.setattr(quad_ahead, "begin", lambda *given, **limits: begun.append(given) or begin(*given, **limits))
    monkeypatch.setattr(quad_ahead, "cores", lambda: 2)
    monkeypatch.setattr(quad_ahead, "_DOUBT_EDGES", 0.0)
    monkeypatch.setattr(quad_ahead, "_SURE_EDGES", 0.0)
    kill = quad_ahead.Running.kill
    monkeypatch.setattr(quad_ahead.Running, "kill", lambda self: killed.append(self) or kill(self))
    if child == "is gone":
        monkeypatch.setattr(quad_ahead, "begin", lambda _, *given, **limits: begun.append(given) or begin("gdtool.geometry.quad_child:none", *given, **limits))
    out, found, record = quads.remesh(vertices, faces, Request(quads=4000))
    assert len(begun) == 1 and len(killed) == (child == "is not wanted") and record.engine == in_turn[2].engine
    assert np.array_equal(out, in_turn[0]) and np.array_equal(found, in_turn[1])


@pytest.mark.parametrize("why", ["near", "alone of the number"])
def test_what_was_begun_is_given_up_once_the_first_one_is_traced(monkeypatch, why):
    if why != "near":
        monkeypatch.setattr(quad_ahead, "_SURE_EDGES", 0.0)
        outlined, count = quad_candidate.outlined, Candidate.count
        # Once the first has its outline, tips that were drawn out make the other one too many.
        monkeypatch.setattr(quad_candidate, "outlined", lambda *given: monkeypatch.setattr(
            Candidate, "count", property(lambda self: count.fget(self) * (1 if self.outline is not None else 2))) or outlined(*given))
    monkeypatch.setattr(quad_ahead, "cores", lambda: 2)
    monkeypatch.setattr(quad_ahead, "_DOUBT_EDGES", 0.0)
    happened, begin, kill, draw = [], quad_ahead.begin, quad_ahead.Running.kill, Candidate.draw
    monkeypatch.setattr(quad_ahead, "begin", lambda *given, **limits: happened.append("begun") or begin(*given, **limits))
    monkeypatch.setattr(quad_ahead.Running, "kill", lambda self: happened.append("killed") or kill(self))
    monkeypatch.setattr(Candidate, "draw", lambda self, part: happened.append("drawn") or draw(self, part))
    quads.remesh(*sphere(96, 0.45), Request(quads=4000))
    assert happened == ["begun", "killed", "drawn"]


def test_a_first_one_near_to_the_surface_is_not_in_doubt(monkeypatch):
    monkeypatch.setattr(quad_ahead, "cores", lambda: 2)
    monkeypatch.setattr(quad_ahead, "begin", None)
    assert quads.remesh(*sphere(96, 0.45), Request(quads=4000))[2].engine == "instant-meshes, 1 subdivision"
