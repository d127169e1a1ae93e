"""Simplification: the count, the error it reports, and what it does when the child fails."""

import numpy as np
import pytest

from gdtool.core.child import ChildFailed
from gdtool.core.errors import InputError
from gdtool.geometry import repair, simplify
from tests.geometry.solids import cube, joined, plane, sphere, volume


def test_sphere_keeps_shape_and_topology():
    vertices, faces = sphere(40)
    out, out_faces, _, report = simplify.simplify(vertices, faces, 800)
    assert 0.9 * 800 <= len(out_faces) <= 800 and repair.is_watertight(out_faces) and repair.is_manifold(out_faces)
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
    assert out[0] is vertices and out[3] == {"faces": 12, "method": "none", "error": 0.0}


def test_target_one_is_not_empty():
    vertices, faces = sphere(16)
    _, out, _, _ = simplify.simplify(vertices, faces, 1)
    assert len(out) >= 4 and repair.is_watertight(out)


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
    assert repair.components(simplify.simplify(vertices, faces, 400)[1])[0] == 2
