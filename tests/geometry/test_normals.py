"""Compute face and vertex normals, also of faces without area."""

import numpy as np
import pytest

from gdtool.geometry import normals as normals_module
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals, vertex_normals
from tests.geometry.solids import sphere


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_faces_without_area_have_normal_zero_and_do_not_affect_vertex_normals(kind):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]], kind)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]])
    normals, area = face_normals(TriMesh(vertices, faces))
    assert np.array_equal(normals, [[0, 0, 1], [0, 0, 0], [0, 0, 0]])
    assert np.allclose(area, [0.5, 0, 0])
    assert np.allclose(vertex_normals(TriMesh(vertices, faces))[:3], [0, 0, 1])


def test_normals_do_not_depend_on_the_chunk_size(monkeypatch):
    mesh = TriMesh(*sphere(24))
    normals, areas = face_normals(mesh)
    monkeypatch.setattr(normals_module, "CHUNK", 100)
    chunked_normals, chunked_areas = face_normals(mesh)
    assert np.array_equal(normals, chunked_normals)
    assert np.array_equal(areas, chunked_areas)


def test_normals_of_a_sphere_look_outward():
    mesh = TriMesh(*sphere(24))
    normals, _ = face_normals(mesh)
    assert (normals * mesh.vertices[mesh.faces].mean(1)).sum(1).min() > 0.7
    assert abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-6
    assert (vertex_normals(mesh) * mesh.vertices).sum(1).min() > 0.79


def test_a_mesh_without_faces_has_no_face_normals():
    normals, areas = face_normals(TriMesh(np.eye(3), np.zeros((0, 3), int)))
    assert normals.shape == (0, 3)
    assert areas.shape == (0,)
