"""Simplification: the count, the error it reports, and what it does when the child fails."""

import numpy as np
import pytest

from gdtool.core.child import ChildFailed
from gdtool.core.errors import InputError
from gdtool.geometry import simplify, topology
from tests.geometry.solids import assembly, bored_box, cube, joined, plane, quad_cube, sphere, volume


def test_sphere_keeps_shape_and_topology():
    vertices, faces = sphere(40)
    out, out_faces, _, report = simplify.simplify(vertices, faces, 800)
    assert 0.9 * 800 <= len(out_faces) <= 800 and topology.is_watertight(out_faces) and topology.is_manifold(out_faces)
    assert report["method"] == "quadric collapse" and 0 < report["error"] < 0.02
    # The error is an upper bound for the vertices of both (all of them are below the sampling limit).
    radius = np.linalg.norm(out, axis=1)
    assert abs(radius - 0.8).max() < report["error"] + 2e-3
    assert volume(out, out_faces) == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.02)


def test_attributes_follow():
    vertices, faces = sphere(32)
    out, _, attributes, _ = simplify.simplify(vertices, faces, 500, attributes=vertices * 2 + 1)
    assert np.abs(attributes - (out * 2 + 1)).max() < 0.02


def test_nothing_to_do():
    vertices, faces = cube()
    out = simplify.simplify(vertices, faces, 100)
    assert out[0] is vertices and out[3] == {"faces": 12, "method": "none", "error": 0.0, "creases": 0}


def test_target_one_is_not_empty():
    vertices, faces = sphere(16)
    _, out, _, _ = simplify.simplify(vertices, faces, 1)
    assert len(out) >= 4 and topology.is_watertight(out)


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_units_do_not_matter(scale):
    vertices, faces = sphere(24)
    out, _, _, report = simplify.simplify(vertices * scale, faces, 300)
    assert np.abs(np.linalg.norm(out / scale, axis=1) - 0.8).max() < 0.05 and report["error"] / scale < 0.05


def test_dead_child_of_open_mesh_falls_back(monkeypatch):
    def dead(*_, **__):
        raise ChildFailed("died of SIGSEGV")

    monkeypatch.setattr(simplify, "begin", dead)
    vertices, faces = plane(40)
    out, out_faces, _, report = simplify.simplify(vertices, faces, 400)
    assert report["method"] == "vertex clustering" and "SIGSEGV" in report["failed"] and 0 < len(out_faces) < len(faces)
    # A closed mesh is rather left as it is than torn.
    vertices, faces = sphere(24)
    assert simplify.simplify(vertices, faces, 100)[1] is faces


def test_index_out_of_range_never_reaches_the_library():
    with pytest.raises(InputError):
        simplify.simplify(np.eye(3), np.array([[0, 1, 7]]), 1)


def test_two_pieces_stay_two():
    vertices, faces = joined(sphere(24, 0.4, (-0.5, 0, 0)), sphere(24, 0.4, (0.5, 0, 0)))
    assert topology.components(simplify.simplify(vertices, faces, 400)[1])[0] == 2


def test_slivers_that_the_quick_collapse_does_not_touch():
    """Pins of slivers around a disk: the quick collapse leaves them as they are and tears down the disk."""
    vertices, faces = assembly(60, 48)
    out, found, _, report = simplify.simplify(vertices, faces, 900)
    assert report["method"].endswith("topology kept") and "the quick collapse stopped" in report["failed"]
    assert len(found) <= 900 and report["error"] < 0.02 and topology.invariants(found) == topology.invariants(faces)


def test_flat_parts_go_first_however_they_lie():
    """Sides cut finely, turned so that rounding bends them: the quick collapse comes to its end, and the cube stays
    one."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    vertices, quads = quad_cube(6)
    vertices, faces = vertices @ (turn * np.linalg.det(turn)), np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    out, found = topology.compact(*simplify.collapse(simplify.uneven(vertices, faces), faces, 200, 5.0))
    assert len(found) == 200 and topology.is_watertight(found) and topology.is_manifold(found)
    assert simplify.deviation(vertices, faces, out, found) < 1e-3 and volume(out, found) == pytest.approx(1, abs=1e-4)
    assert len(simplify.collapse(vertices, faces, 200, 5.0)[1]) > 5000
    # Only what lies in a side moves: at an edge of the cube the middle of the normals' squares has a determinant of
    # nought too.
    by = np.linalg.norm(simplify.uneven(vertices, faces) - vertices, axis=1) / np.linalg.norm(
        vertices[quads[0, 0]] - vertices[quads[0, 1]]
    )
    assert 0.5 < (by > 0).mean() <= 1 and by.max() < 3 * simplify._UNEVEN
    # What is not flat stays where it is, and what is flat along an axis, which rounding does not bend.
    for vertices, faces in (sphere(40), bored_box(40)):
        assert simplify.uneven(vertices, faces) is vertices


def test_creases_are_drawn_out_unless_that_cannot_be_collapsed(monkeypatch):
    vertices, faces = bored_box(64)
    corner = np.array([0.8, 0.6, 0.5])

    def off(vertices):
        return np.linalg.norm(vertices - corner, axis=1).min()

    out, found, _, report = simplify.simplify(vertices, faces, 2000, crease_degrees=30.0)
    assert (
        report["creases"] > 300
        and len(found) <= 2000
        and topology.is_watertight(found)
        and off(out) < 0.2 * off(vertices)
    )
    begin = simplify.begin

    class Torn:
        def __init__(self, running):
            self.running = running

        def result(self):
            vertices, faces, moved = self.running.result()
            return vertices, faces[:-1], moved

    def restored(given):
        return given[-1] > 0  # crease_degrees

    def dying(*given, **limits):
        if restored(given):
            raise ChildFailed("died of SIGSEGV")
        return begin(*given, **limits)

    monkeypatch.setattr(simplify, "begin", dying)
    assert (found := simplify.simplify(vertices, faces, 2000, crease_degrees=30.0)[3])["faces"] <= 2000 and found[
        "creases"
    ] == 0
    monkeypatch.setattr(
        simplify,
        "begin",
        lambda *given, **limits: Torn(begin(*given, **limits)) if restored(given) else begin(*given, **limits),
    )
    out, found, _, report = simplify.simplify(vertices, faces, 2000, crease_degrees=30.0)
    assert report["creases"] == 0 and "creases restored" in report["failed"] and topology.is_watertight(found)
    assert off(out) > 0.5 * off(vertices)


def test_even_leaves_triangles_of_one_size():
    vertices, faces = bored_box(64)

    def spread(even):
        out, found = simplify.simplify(vertices, faces, 1500, even=even, measured=False)[:2]
        edges = topology.edges_of(found)
        assert topology.is_watertight(found) and abs(len(found) / 1500 - 1) < 0.02
        tenth, most = np.quantile(np.linalg.norm(out[edges.ends[:, 0]] - out[edges.ends[:, 1]], axis=1), (0.1, 0.9))
        return most / tenth

    assert spread(even=True) < 4 < 10 < spread(even=False)


def test_the_noise_of_even_is_as_fine_as_the_detail():
    """A ball a thousandth of the size of what lies beside it keeps its shape."""
    cube_vertices, quads = quad_cube(6)
    ball_vertices, ball_faces = sphere(24)
    ball = ball_vertices * 1e-3 + (2.0, 0.0, 0.0), ball_faces
    vertices, faces = joined((cube_vertices, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])), ball)
    out = simplify.shaken(vertices, faces)
    assert np.abs(out - vertices)[: len(cube_vertices)].max() > 0.01 * np.linalg.norm(
        cube_vertices[quads[0, 0]] - cube_vertices[quads[0, 1]]
    )
    radius = np.linalg.norm(out[len(cube_vertices) :] - (2.0, 0.0, 0.0), axis=1)
    assert 1e-6 < np.abs(radius - 0.8e-3).max() < 1e-5


def test_near_keeps_nearer_with_as_many_triangles():
    vertices, faces = bored_box(64)
    even, near = (simplify.simplify(vertices, faces, 1000, near=near)[3] for near in (False, True))
    assert even["faces"] == near["faces"] == 1000 and near["error"] < 0.5 * even["error"]


def test_a_quick_result_that_is_far_off_is_compared_with_the_slow_one(monkeypatch):
    vertices, faces = sphere(40)
    begin = simplify.begin

    def shrinking(function, vertices, faces, way, *given, **limits):
        return begin(function, vertices * (0.5 if way == "collapse" else 1), faces, way, *given, **limits)

    monkeypatch.setattr(simplify, "begin", shrinking)
    out, _, _, report = simplify.simplify(vertices, faces, 800)
    assert report["method"].endswith("topology kept") and report["error"] < 0.02
    assert abs(np.linalg.norm(out, axis=1) - 0.8).max() < 0.02


def test_the_collapse_that_keeps_the_topology_keeps_what_coincides():
    """Two balls that touch in a vertex each: not joined, and nothing of them left out."""
    one = sphere(24)
    top = one[0][one[0][:, 0].argmax()]
    two = one[0] * (-1, 1, 1) + (2 * top[0], 0, 0), one[1][:, ::-1]
    vertices, faces = joined(one, two)
    out, found = simplify.collapse_topology(vertices, faces, 600)
    assert topology.invariants(found) == topology.invariants(faces) and len(found) <= 600


def test_where_the_quick_collapse_gives_up_it_still_goes_most_of_the_way(monkeypatch):
    """MeshLab's goes on from six times the triangles asked for: as near to the surface as from all of them."""
    vertices, faces = sphere(64)
    assert len(faces) > 20_000
    whole, by_way = simplify.collapse_topology(vertices, faces, 1000), simplify.collapse_by_way(vertices, faces, 1000)
    assert len(by_way[1]) == 1000 and topology.is_watertight(by_way[1])
    assert simplify.deviation(vertices, faces, *by_way) < 1.5 * simplify.deviation(vertices, faces, *whole)
    called, begin = [], simplify.begin
    monkeypatch.setattr(simplify, "begin", lambda *given, **how: called.append(given[3]) or begin(*given, **how))
    found = simplify.simplify(vertices, faces, 1000, careful=True)
    assert called == ["collapse_by_way"] and found[3]["faces"] == 1000
    monkeypatch.setattr(simplify, "collapse", lambda vertices, faces, target, pace: (vertices, faces))
    assert not len(simplify.collapse_by_way(vertices, faces, 1000)[1])
