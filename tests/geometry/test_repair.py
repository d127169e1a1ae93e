"""Repair meshes: a sound one passes unchanged, a broken one becomes manifold, a hopeless one is refused."""

import numpy as np
import pytest

from gdtool.core.errors import InputError
from gdtool.geometry import repair, topology
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.nonmanifold_edges import separate_sheets
from tests.geometry.solids import cube, joined, plane, sphere, volume


def soup_of(vertices: np.ndarray, faces: np.ndarray) -> TriMesh:
    """Give each triangle three vertices that no other triangle shares."""
    return TriMesh(vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))


def cubes_sharing_corners(shift: tuple[float, float, float]) -> TriMesh:
    """Make two cubes, the second moved by `shift`, that share a vertex where two corners coincide."""
    vertices, faces = joined(cube(), (cube()[0] + shift, cube()[1]))
    _, first, inverse = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
    return TriMesh(vertices, first[inverse.ravel()][faces])


def test_a_cube_passes_unchanged():
    vertices, faces = cube(2.0)
    mesh, repairs, is_closed = repair.clean(TriMesh(vertices, faces))
    assert is_closed
    assert repairs == {}
    assert (mesh.vertices == vertices).all()
    assert (mesh.faces == faces).all()
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(8)


def test_a_soup_of_triangles_is_welded():
    mesh, repairs, is_closed = repair.clean(soup_of(*cube()))
    assert len(mesh.vertices) == 8
    assert is_closed
    assert topology.is_watertight(mesh.faces)
    assert repairs == {"welded_vertices": 28}


@pytest.mark.parametrize("is_turned", [False, True], ids=["outward", "inside out"])
def test_a_mesh_that_welding_closes_needs_no_other_repair(monkeypatch, is_turned):
    """As in a file with rounded coordinates: an edge has no length, and its two faces were left out."""
    vertices, faces = sphere(24)
    a, b = faces[0, :2].tolist()
    vertices[b] = vertices[a]
    torn = faces[~((faces == a).any(1) & (faces == b).any(1))]
    assert len(torn) == len(faces) - 2
    assert not topology.is_watertight(torn)
    monkeypatch.setattr(repair, "_repair_structure", None)
    mesh, repairs, is_closed = repair.clean(TriMesh(vertices, torn[:, ::-1] if is_turned else torn))
    assert is_closed
    assert topology.is_watertight(mesh.faces)
    assert topology.is_manifold(mesh.faces)
    assert repairs == {"welded_vertices": 1} | ({"turned_inside_out": True} if is_turned else {})
    assert np.array_equal(mesh.vertices[mesh.faces], vertices[torn])


def test_two_faces_back_to_back_become_one():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 2, float)
    mesh, repairs, is_closed = repair.clean(TriMesh(vertices, np.array([[0, 1, 2], [3, 5, 4]])))
    assert len(mesh.faces) == 1
    assert not is_closed
    assert repairs == {"welded_vertices": 3, "duplicate_faces": 1}


def test_two_cubes_that_share_an_edge_become_two_pieces():
    shared = cubes_sharing_corners((1, 1, 0))
    assert not topology.is_manifold(shared.faces)
    mesh, repairs, is_closed = repair.clean(shared)
    assert is_closed
    assert repairs["nonmanifold_edges"] == 1
    assert topology.is_watertight(mesh.faces)
    assert topology.is_manifold(mesh.faces)
    assert topology.components(mesh.faces)[0] == 2
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(2)


def test_a_vertex_that_two_cubes_share_is_doubled():
    shared = cubes_sharing_corners((1, 1, 1))
    assert topology.is_watertight(shared.faces)
    assert not topology.is_manifold(shared.faces)
    assert len(topology.split_vertices(shared.faces)) == 1
    mesh, repairs, is_closed = repair.clean(shared)
    assert is_closed
    assert repairs == {"nonmanifold_vertices": 1}
    assert topology.is_manifold(mesh.faces)
    assert len(mesh.vertices) == 16


def test_a_face_in_the_wrong_direction_is_turned():
    vertices, faces = cube()
    faces[3] = faces[3][::-1]
    mesh, repairs, is_closed = repair.clean(TriMesh(vertices, faces))
    assert is_closed
    assert repairs["turned_edges"] == 3
    assert topology.is_watertight(mesh.faces)
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(1)


def test_a_mesh_that_is_inside_out_is_turned():
    vertices, faces = cube()
    mesh, repairs, is_closed = repair.clean(TriMesh(vertices, faces[:, ::-1]))
    assert is_closed
    assert repairs == {"turned_inside_out": True}
    assert volume(mesh.vertices, mesh.faces) == pytest.approx(1)


def test_duplicate_flat_and_degenerate_faces_are_removed():
    vertices, faces = plane(2)
    vertices = np.concatenate([vertices, [[0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]]])
    n = len(vertices)
    more = np.concatenate([faces, faces[:2], [[n - 3, n - 2, n - 1], [0, 0, 1]]])
    mesh, repairs, is_closed = repair.clean(TriMesh(vertices, more))
    assert not is_closed
    assert len(mesh.faces) == 8
    assert repairs["duplicate_faces"] == 2
    assert repairs["zero_area_faces"] == 1
    assert repairs["degenerate_faces"] == 1


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
def test_a_mesh_without_a_surface_is_refused(vertices, faces, fact):
    with pytest.raises(InputError, match=fact):
        repair.clean(TriMesh(vertices, faces), "x.obj")


@pytest.mark.parametrize("scale", [1e-20, 1e20])
def test_welding_does_not_depend_on_the_unit_of_length(scale):
    assert len(repair.clean(soup_of(*cube(scale))).mesh.vertices) == 8


def test_sheets_that_share_an_edge_are_separated():
    """Two cubes stand side by side along one edge, which therefore has four faces."""
    vertices, faces = cube()
    both = np.concatenate([vertices, vertices + [1.0, 1.0, 0]])
    points, merged = np.unique(both, axis=0, return_inverse=True)
    shared = merged.ravel()[np.concatenate([faces, faces + 8])]
    assert len(points) == 14
    assert not topology.is_watertight(shared)
    mesh = separate_sheets(TriMesh(points, shared))
    assert topology.is_watertight(mesh.faces)
    assert topology.is_manifold(mesh.faces)
    assert topology.components(mesh.faces)[0] == 2
    assert len(mesh.vertices) == 16
