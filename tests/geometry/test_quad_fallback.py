"""Quads of a mesh's own triangles, made in case that there are no even ones, are those that are made in turn."""

import numpy as np
import pytest

from gdtool.geometry import quad_fallback, quads
from gdtool.geometry.quad_task import Request
from tests.geometry.solids import sphere


@pytest.mark.parametrize("child", ["works", "is gone", "is not wanted"])
def test_made_ahead_or_in_turn(monkeypatch, child):
    vertices, faces = sphere(48, 0.45)
    if child != "is not wanted":
        monkeypatch.setattr(quad_fallback, "of_even", lambda *given: None)
    begun, begin, killed = [], quad_fallback.begin, []
    name = "gdtool.geometry.quad_child:none" if child == "is gone" else "gdtool.geometry.quad_child:own_evened"
    monkeypatch.setattr(quad_fallback, "begin", lambda _, *given, **more: begun.append(given) or begin(name, *given, **more))
    monkeypatch.setattr(quad_fallback, "cores", lambda: 1)
    in_turn = quads.remesh(vertices, faces, Request(quads=2000, engine="split"))
    assert not begun
    monkeypatch.setattr(quad_fallback, "cores", lambda: 2)
    monkeypatch.setattr(quad_fallback, "_WORTH_A_CHILD", 0)
    kill = quad_fallback.Running.kill
    monkeypatch.setattr(quad_fallback.Running, "kill", lambda self: killed.append(self) or kill(self))
    own, own_evened = [], quad_fallback.own_evened
    monkeypatch.setattr(quad_fallback, "own_evened", lambda *given: own.append(given) or own_evened(*given))
    out, found, record = quads.remesh(vertices, faces, Request(quads=2000, engine="split"))
    assert len(begun) == len(killed) == 1 and len(own) == (child == "is gone") and record.engine == "pair and split"
    assert np.array_equal(out, in_turn[0]) and np.array_equal(found, in_turn[1])
