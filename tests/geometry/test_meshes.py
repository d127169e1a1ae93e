"""Check that mesh values keep their arrays, derive the rest once, and pickle the arrays alone."""

import pickle

import numpy as np
import pytest

from gdtool.geometry.meshes import QuadMesh, TriMesh
from tests.geometry.solids import cube

CUBE_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def test_arrays_are_neither_copied_nor_cast():
    vertices, faces = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int16)
    mesh = TriMesh(vertices, faces)
    assert mesh.vertices is vertices
    assert mesh.faces is faces


def test_area_and_extent_of_a_cube():
    mesh = TriMesh(*cube(2.0))
    assert mesh.area == pytest.approx(24)
    assert mesh.extent == 2


def test_derived_values_are_computed_once():
    mesh = TriMesh(*cube())
    assert mesh.edges is mesh.edges
    quads = QuadMesh(cube()[0], CUBE_QUADS)
    assert quads.triangulation is quads.triangulation


def test_a_pickle_holds_the_arrays_alone():
    mesh = TriMesh(*cube())
    fresh = pickle.dumps(mesh)
    assert len(mesh.edges.ends) == 18
    assert pickle.dumps(mesh) == fresh
    copy = pickle.loads(fresh)
    assert np.array_equal(copy.vertices, mesh.vertices)
    assert np.array_equal(copy.faces, mesh.faces)


def test_triangles_of_quads_name_the_quad_they_come_from():
    mesh = QuadMesh(cube()[0], np.concatenate([CUBE_QUADS[:5], [[1, 5, 7, -1]]]))
    assert mesh.is_quad.tolist() == [True] * 5 + [False]
    assert len(mesh.triangles.faces) == 11
    assert mesh.triangulation.face_idx.tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5]
    assert mesh.triangles.vertices is mesh.vertices


def test_texture_coordinates_that_are_missing_are_an_error():
    with pytest.raises(ValueError, match="no texture coordinates"):
        QuadMesh(cube()[0], CUBE_QUADS).texture_coordinates()
