"""A mesh collapsed as two halves: as closed, as even and as near as collapsed whole, and whole where that cannot be."""

import numpy as np
import pytest

from gdtool.core import child
from gdtool.geometry import halves, simplify, topology
from tests.conftest import ROOT
from tests.geometry.solids import joined, plane, sphere, torus

UNIT = 0.5


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def at_pace(vertices, faces, target_faces, unit, keep_border):
    return simplify.collapse(vertices, faces, target_faces, 4.0, unit, keep_border)


def without_rims(vertices, faces, target_faces, unit, keep_border):
    return at_pace(vertices, faces, target_faces, unit, keep_border=False)


def dying(vertices, faces, target_faces, unit, keep_border):
    raise MemoryError


def halved(vertices, faces, target_faces, how="at_pace"):
    """By a child, as in use: this process has threads, and cannot be copied."""
    return child.call("tests.geometry.test_halves:_halved", vertices, faces, target_faces, how, seconds=60)


def _halved(vertices, faces, target_faces, how):
    return halves.in_halves(globals()[how], simplify.shaken(vertices, faces), faces, target_faces, UNIT)


@pytest.fixture(scope="module")
def shapes():
    return {"torus": torus(110), "two balls across the cut": joined(sphere(130, 0.45, (-0.1, 0.5, 0)), sphere(130, 0.45, (0.5, -0.5, 0))), "ball": sphere(100)}


@pytest.mark.parametrize("name", ["torus", "two balls across the cut", "ball"])
def test_the_halves_are_one_mesh_again_as_good_as_collapsed_whole(shapes, name):
    vertices, faces = shapes[name]
    out, found = topology.compact(*halved(vertices, faces, 6000))
    whole, whole_faces = topology.compact(*at_pace(simplify.shaken(vertices, faces), faces, 6000, UNIT, False))
    assert abs(len(found) - 6000) <= 2 and topology.is_watertight(found) and topology.is_manifold(found)
    assert topology.invariants(found) == topology.invariants(faces)
    assert simplify.deviation(vertices, faces, out, found) < 1.5 * simplify.deviation(vertices, faces, whole, whole_faces)
    # About the seam, at the middle of the longest side, the edges are about as long as elsewhere, and none much shorter.
    across = np.ptp(vertices, 0).argmax()
    seam = np.median(vertices[faces[:, 0], across])
    ends = out[topology.edges_of(found).ends]
    length, near = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1), abs(ends[..., across] - seam).min(1) < 0.05
    assert near.sum() > 200 and 0.8 < np.median(length[near]) / np.median(length[~near]) < 1.25
    assert np.quantile(length[near], 0.02) > 0.7 * np.quantile(length[~near], 0.02)


def test_it_comes_out_the_same_each_time(shapes):
    one, other = (halved(*shapes["torus"], 6000) for _ in range(2))
    assert all(np.array_equal(*pair) for pair in zip(one, other, strict=True))


@pytest.mark.parametrize("how, target_faces", [("at_pace", 300), ("without_rims", 6000), ("dying", 6000)],
                         ids=["the rim is too long for so few triangles", "a half lost its rim", "no memory"])
def test_where_it_cannot_be_there_is_nothing(shapes, how, target_faces):
    if how == "dying":
        with pytest.raises(child.ChildFailed, match="memory|MemoryError|MB"):
            halved(*shapes["torus"], target_faces, how)
    else:
        assert halved(*shapes["torus"], target_faces, how) is None


@pytest.mark.parametrize("spoil", [lambda vertices: vertices[:3], lambda vertices: vertices + 0.01], ids=["fewer", "moved"])
def test_a_seam_that_lost_its_border_is_not_put_in(shapes, spoil):
    def spoiling(*given):
        out, found = at_pace(*given)
        return spoil(out), found

    vertices, faces = shapes["torus"]
    assert halves._seam_collapsed(at_pace, vertices, faces, 300, len(faces) - 200, UNIT) is not None
    assert halves._seam_collapsed(spoiling, vertices, faces, 300, len(faces) - 200, UNIT) is None


@pytest.mark.parametrize("failure", [OSError("cannot allocate memory"), child.ChildFailed("died")])
def test_without_a_second_process_there_is_nothing(monkeypatch, shapes, failure):
    def beside(*_):
        raise failure

    monkeypatch.setattr(halves, "beside", beside)
    assert _halved(*shapes["torus"], 6000, "at_pace") is None


def test_only_what_is_large_and_closed_and_left_small_is_halved(monkeypatch, shapes):
    faces = shapes["torus"][1]
    assert not halves.worth_halving(faces, 6000)
    monkeypatch.setattr(halves, "LARGE", len(faces) - 1)
    monkeypatch.setattr(halves, "cores", lambda: 2)
    monkeypatch.setattr(halves.sys, "platform", "linux")
    assert halves.worth_halving(faces, 6000) and not halves.worth_halving(faces, len(faces) // 6)
    assert not halves.worth_halving(np.concatenate([faces[:-1], faces[:1]]), 6000)
    monkeypatch.setattr(halves, "cores", lambda: 1)
    assert not halves.worth_halving(faces, 6000)


def test_even_triangles_are_collapsed_in_halves_and_whole_where_these_fail(monkeypatch):
    vertices, faces = torus(40)
    asked = []
    monkeypatch.setattr(simplify, "worth_halving", lambda faces, target_faces: True)
    monkeypatch.setattr(simplify, "in_halves", lambda *given: asked.append(given[3:]))
    out, found, moved = simplify.reduced(vertices, faces, "collapse", (600, 4.0, UNIT), True)
    assert asked == [(600, UNIT)] and len(found) == 600 and topology.is_watertight(found) and moved == 0
    simplify.reduced(vertices, faces, "collapse", (600, 4.0, UNIT), False)
    simplify.reduced(*plane(20), "collapse_topology", (600,), True)
    assert len(asked) == 1
    monkeypatch.setattr(simplify, "in_halves", lambda *given: ("halves", "joined"))
    assert simplify.reduced(vertices, faces, "collapse", (600, 4.0, UNIT), True) == ("halves", "joined", 0)
