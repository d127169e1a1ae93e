"""Mirror planes: found or not, meshes cut at them, and halves joined."""

import numpy as np
import pytest

from gdtool.geometry import topology
from gdtool.geometry.meshes import QuadMesh, TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.remesh.symmetry import half_mesh, join_with_mirror, mirror_plane
from tests.geometry.solids import cube, sphere, torus


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_has_half_the_area_and_ends_at_the_plane(axis):
    vertices, faces = torus(31)
    vertices = vertices + 0.003 * (np.arange(3) == axis)  # the plane cuts through faces
    made = half_mesh(TriMesh(vertices, faces), axis)
    half_vertices, half = made.vertices, made.faces
    whole = face_normals(TriMesh(vertices, faces))[1].sum()
    assert face_normals(TriMesh(half_vertices, half))[1].sum() == pytest.approx(whole / 2, rel=0.02)
    edges = topology.edges_of(half)
    rim = np.unique(edges.ends[edges.count == 1])
    assert topology.is_manifold(half)
    assert not edges.turned.any()
    assert half_vertices[:, axis].min() == 0
    assert (half_vertices[rim, axis] == 0).all()
    assert len(rim) > 10


def test_mirror_planes_are_found_only_where_the_mesh_is_symmetric():
    vertices, faces = sphere(24, 0.45)
    assert mirror_plane(TriMesh(vertices, faces), 2000)[0] is not None
    vertices = np.where(vertices > 0.3, 0.3 + 0.5 * (vertices - 0.3), vertices)  # three sides flattened
    axis, apart = mirror_plane(TriMesh(vertices, faces), 2000)
    assert axis is None
    assert min(apart.values()) > 0.01
    vertices[:, 1] = np.where(np.abs(vertices[:, 1]) > 0.3, np.sign(vertices[:, 1]) * 0.3, vertices[:, 1])
    axis, apart = mirror_plane(TriMesh(vertices, faces), 2000)
    assert axis == 1
    assert apart["y"] < 1e-3 < apart["x"]
    assert list(mirror_plane(TriMesh(vertices, faces), 2000, "x")[1]) == ["x"]


def test_halves_of_a_box_close():
    vertices, faces = cube()
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    side = (vertices[quads][..., 0] < 0).all(1)
    half = vertices.copy()
    half[:, 0] = np.where(half[:, 0] < 0, 0.02, half[:, 0])  # the open end near the plane
    made = join_with_mirror(QuadMesh(half, quads[~side]), 0, 0.5)
    out, quads_out = made.vertices, made.faces
    assert len(quads_out) == 10
    assert topology.is_watertight(quads_out)
    assert np.ptp(out[:, 0]) == pytest.approx(1)
    assert (np.abs(out[:, 0]) < 1e-12).sum() == 4
