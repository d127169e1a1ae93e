"""Repair: what is whole passes unchanged, what is broken becomes manifold, what is hopeless is refused."""

import numpy as np
import pytest

from gdtool.core.errors import InputError
from gdtool.geometry import repair, topology
from gdtool.geometry.unpinch import unpinched
from tests.geometry.solids import cube, joined, plane, sphere, volume


def test_cube_is_watertight_and_passes_unchanged():
    vertices, faces = cube(2.0)
    assert topology.is_watertight(faces) and topology.is_manifold(faces)
    out_vertices, out_faces, report, closed = repair.clean(vertices, faces)
    assert closed and report == {} and (out_vertices == vertices).all() and (out_faces == faces).all()
    assert volume(out_vertices, out_faces) == pytest.approx(8)


def test_soup_is_welded():
    vertices, faces = cube()
    soup, soup_faces = vertices[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    out_vertices, out_faces, report, closed = repair.clean(soup, soup_faces)
    assert len(out_vertices) == 8 and closed and topology.is_watertight(out_faces) and report == {"welded_vertices": 28}


def test_what_welding_closes_is_not_looked_at_further(monkeypatch):
    """As in a file whose numbers were rounded: an edge of no length, its two faces left out by who wrote it."""
    vertices, faces = sphere(24)
    a, b = faces[0, :2].tolist()
    vertices[b] = vertices[a]
    torn = faces[~((faces == a).any(1) & (faces == b).any(1))]
    assert len(torn) == len(faces) - 2 and not topology.is_watertight(torn)
    monkeypatch.setattr(repair, "corner_fans", None)
    out, found, report, closed = repair.clean(vertices, torn)
    assert closed and topology.is_watertight(found) and topology.is_manifold(found) and report == {"welded_vertices": 1}
    assert np.array_equal(out[found], vertices[torn])
    _, turned, report, closed = repair.clean(vertices, torn[:, ::-1])
    assert closed and np.array_equal(turned, found) and report == {"welded_vertices": 1, "turned_inside_out": True}


def test_two_faces_back_to_back_are_one_once_welded():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 2, float)
    _, found, report, closed = repair.clean(vertices, np.array([[0, 1, 2], [3, 5, 4]]))
    assert len(found) == 1 and not closed and report == {"welded_vertices": 3, "duplicate_faces": 1}


def test_two_cubes_at_one_edge_become_two_manifolds():
    one, two = cube(), cube()
    vertices, faces = joined(one, (two[0] + [1, 1, 0], two[1]))
    _, first, inverse = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
    shared = first[inverse.ravel()][faces]
    assert not topology.is_manifold(shared)
    out_vertices, out_faces, report, closed = repair.clean(vertices, shared)
    assert closed and report["nonmanifold_edges"] == 1
    assert (
        topology.is_watertight(out_faces) and topology.is_manifold(out_faces) and topology.components(out_faces)[0] == 2
    )
    assert volume(out_vertices, out_faces) == pytest.approx(2)


def test_bow_tie_is_parted():
    one, two = cube(), cube()
    vertices, faces = joined(one, (two[0] + 1, two[1]))
    _, first, inverse = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
    shared = first[inverse.ravel()][faces]
    assert (
        topology.is_watertight(shared)
        and not topology.is_manifold(shared)
        and len(topology.split_vertices(shared)) == 1
    )
    out_vertices, out_faces, report, closed = repair.clean(vertices, shared)
    assert (
        closed and report == {"nonmanifold_vertices": 1} and topology.is_manifold(out_faces) and len(out_vertices) == 16
    )


def test_turned_faces_are_turned_back():
    vertices, faces = cube()
    faces[3] = faces[3][::-1]
    out_vertices, out_faces, report, closed = repair.clean(vertices, faces)
    assert (
        closed
        and report["turned_edges"] == 3
        and topology.is_watertight(out_faces)
        and volume(out_vertices, out_faces) == pytest.approx(1)
    )


def test_inside_out_is_turned():
    vertices, faces = cube()
    out_vertices, out_faces, report, closed = repair.clean(vertices, faces[:, ::-1])
    assert closed and report == {"turned_inside_out": True} and volume(out_vertices, out_faces) == pytest.approx(1)


def test_duplicate_and_flat_faces_go():
    vertices, faces = plane(2)
    vertices = np.concatenate([vertices, [[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]]])
    n = len(vertices)
    more = np.concatenate([faces, faces[:2], [[n - 3, n - 2, n - 1], [0, 0, 1]]])
    _, out, report, closed = repair.clean(vertices, more)
    assert (
        not closed
        and len(out) == 8
        and report["duplicate_faces"] == 2
        and report["zero_area_faces"] == 1
        and report["degenerate_faces"] == 1
    )


@pytest.mark.parametrize(
    "vertices, faces, fact",
    [
        (np.zeros((3, 3)), np.zeros((0, 3), int), "no faces"),
        (np.eye(3), np.array([[0, 1, 3]]), "refers to vertex 3 of 3"),
        (np.eye(3), np.array([[0, 1, -1]]), "refers to vertex -1"),
        (np.array([[0, 0, 0], [1, 0, 0], [0, np.nan, 0.0]]), np.array([[0, 1, 2]]), "vertex 2 is not finite"),
        (np.ones((3, 3)), np.array([[0, 1, 2]]), "one point"),
        (np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0.0]]), np.array([[0, 1, 2]]), "no face has an area"),
        (np.eye(3), np.array([[0, 0, 1], [1, 2, 2]]), "no face has an area"),
    ],
)
def test_refused(vertices, faces, fact):
    with pytest.raises(InputError, match=fact):
        repair.clean(vertices, faces, "x.obj")


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_scale_does_not_matter(scale):
    vertices, faces = cube(scale)
    soup, soup_faces = vertices[faces].reshape(-1, 3), np.arange(36).reshape(-1, 3)
    assert len(repair.clean(soup, soup_faces)[0]) == 8


def test_sheets_that_meet_in_an_edge_are_parted():
    vertices, faces = cube()
    # Two cubes side by side along one edge, which then has four faces.
    shift = np.array([1.0, 1.0, 0])
    assert np.ptp(vertices, 0).tolist() == [1, 1, 1]
    both = np.concatenate([vertices, vertices + shift])
    _, joined = np.unique(both, axis=0, return_inverse=True)
    points = np.unique(both, axis=0)
    pinched = joined.ravel()[np.concatenate([faces, faces + 8])]
    assert len(points) == 14 and not topology.is_watertight(pinched)
    out, parted = unpinched(points, pinched)
    assert topology.is_watertight(parted) and topology.is_manifold(parted)
    assert topology.components(parted)[0] == 2 and len(out) == 16
