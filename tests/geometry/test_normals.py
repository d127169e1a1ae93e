"""Normals of meshes with faces that have none."""

import numpy as np
import pytest

from gdtool.geometry import normals as normals_module
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals, vertex_normals
from tests.geometry.solids import sphere


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_faces_without_area_have_no_normal_and_spoil_none(kind):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]], kind)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]])
    normals, area = face_normals(TriMesh(vertices, faces))
    assert np.array_equal(normals, [[0, 0, 1], [0, 0, 0], [0, 0, 0]])
    assert np.allclose(area, [0.5, 0, 0])
    assert np.allclose(vertex_normals(TriMesh(vertices, faces))[:3], [0, 0, 1])


def test_normals_are_the_same_however_many_faces_are_taken_at_a_time(monkeypatch):
    vertices, faces = sphere(24)
    whole = face_normals(TriMesh(vertices, faces))
    monkeypatch.setattr(normals_module, "CHUNK", 100)
    assert all(
        np.array_equal(one, other) for one, other in zip(whole, face_normals(TriMesh(vertices, faces)), strict=True)
    )
    assert (whole[0] * vertices[faces].mean(1)).sum(1).min() > 0.7
    assert abs(np.linalg.norm(whole[0], axis=1) - 1).max() < 1e-6
    assert (vertex_normals(TriMesh(vertices, faces)) * vertices).sum(1).min() > 0.79
    assert [len(part) for part in face_normals(TriMesh(vertices, faces[:0]))] == [0, 0]
