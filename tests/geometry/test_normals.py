"""Normals of meshes with faces that have none."""

import numpy as np
import pytest

from gdtool.geometry.normals import face_normals, vertex_normals


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_faces_without_area_have_no_normal_and_spoil_none(kind):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, 0, 0]], kind)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 1]])
    normals, area = face_normals(vertices, faces)
    assert np.array_equal(normals, [[0, 0, 1], [0, 0, 0], [0, 0, 0]]) and np.allclose(area, [0.5, 0, 0])
    assert np.allclose(vertex_normals(vertices, faces)[:3], [0, 0, 1])
