"""What is made in case that it is wanted is what is made in turn."""

import numpy as np
import pytest

from gdtool.geometry import quad_candidate, quad_fallback, quad_ways, quads
from gdtool.geometry.quad_task import Part, Request
from tests.geometry.solids import sphere


@pytest.mark.parametrize("child", ["works", "is gone", "is not wanted"])
def test_quads_of_own_triangles_beside_the_search_for_even_ones(monkeypatch, child):
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


@pytest.mark.parametrize("child", ["works", "is gone", "is not wanted"])
def test_the_fallback_of_a_coarse_mesh_beside_an_engine(monkeypatch, child):
    vertices, faces = sphere(16, 0.45)
    request = Request(quads=1600)
    assert len(faces) < request.quads
    if child != "is not wanted":
        monkeypatch.setattr(quad_candidate, "fault_of", lambda *given: ("strays", 9.0))
    monkeypatch.setattr(quad_fallback, "cores", lambda: 1)
    in_turn = quads.remesh(vertices, faces, request)
    monkeypatch.setattr(quad_fallback, "cores", lambda: 2)
    begun, begin, killed = [], quad_fallback.begin, []
    name = "none" if child == "is gone" else "split_evened"
    monkeypatch.setattr(quad_fallback, "begin", lambda which, *given, **more: begun.append(which) or begin(f"gdtool.geometry.quad_child:{name}", *given, **more))
    kill = quad_ways.Running.kill
    monkeypatch.setattr(quad_ways.Running, "kill", lambda self: killed.append(self) or kill(self))
    here, split_evened = [], quad_fallback.split_evened
    monkeypatch.setattr(quad_fallback, "split_evened", lambda *given: here.append(given) or split_evened(*given))
    out, found, record = quads.remesh(vertices, faces, request)
    assert begun == ["gdtool.geometry.quad_child:split_evened"] and len(killed) == (child == "is not wanted") and len(here) == (child == "is gone")
    assert record.engine == in_turn[2].engine == ("instant-meshes" if child == "is not wanted" else "pair and split")
    assert np.array_equal(out, in_turn[0]) and np.array_equal(found, in_turn[1])


def test_the_fallback_of_a_fine_mesh_waits():
    assert quad_fallback.begun(Part(*sphere(32), 400, 0.1, Request(), None)) is None
