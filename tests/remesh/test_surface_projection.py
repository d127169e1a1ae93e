"""Projection to the surface: figures of quads, subdivision, doublets, holes."""

import numpy as np
import pytest

from gdtool.geometry.mesh_quality import scaled_jacobian, shape_figures, topology_figures
from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import triangulated
from gdtool.remesh.fit.surface_projection import fill_holes, remove_doublets, subdivide
from tests.geometry.solids import cube, quad_cube, volume
from tests.remesh.engines import around, inner_face, is_watertight_manifold


def test_grid_figures():
    line = np.arange(5.0)
    x, y = np.meshgrid(line, line)
    i = (np.arange(4)[:, None] * 5 + np.arange(4)).ravel()
    faces = np.stack([i, i + 1, i + 6, i + 5], -1)
    vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], -1)
    figures = topology_figures(QuadMesh(vertices, faces)) | shape_figures(QuadMesh(vertices, faces))
    assert figures["irregular_share"] == 0
    assert figures["boundary_edges"] == 16
    assert figures["jacobian_min"] == pytest.approx(1)
    vertices[6] += [1.5, 1.5, 0]  # past the opposite corner: folded
    assert scaled_jacobian(QuadMesh(vertices, faces)).min() < 0


def test_subdivision_of_a_cube_is_regular_but_for_eight_corners():
    vertices, faces = cube()
    quad = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    made, _ = subdivide(QuadMesh(vertices, quad))
    out, quads_out = made.vertices, made.faces
    assert len(quads_out) == 24
    assert is_watertight_manifold(quads_out)
    assert volume(out, quads_out) == pytest.approx(1)
    assert topology_figures(QuadMesh(out, quads_out))["irregular_share"] == pytest.approx(8 / 26)
    mixed = np.concatenate([np.concatenate([faces, np.full((12, 1), -1)], 1)[[1, 2]], quad[2:]])
    assert len(subdivide(QuadMesh(vertices, mixed))[0].faces) == 2 * 3 + 4 * 4


def test_doublet_is_removed():
    # A quad whose middle vertex 4 has two edges only: the pair around it is one quad.
    faces = np.array([[0, 1, 2, 4], [0, 4, 2, 3], [1, 0, 3, 2]])
    made = remove_doublets(QuadMesh(np.arange(15.0).reshape(5, 3), faces))
    out = made.faces
    assert len(out) == 2


def test_two_holes_that_meet_at_a_vertex_are_closed_separately():
    vertices, faces = quad_cube(3)
    middle = inner_face(vertices, faces)
    open_faces = np.delete(faces, [middle, around(faces, middle)[0][0]], 0)
    made = fill_holes(QuadMesh(vertices, open_faces))
    out, quads_out = made.vertices, made.faces
    assert len(out) == len(vertices)
    assert len(quads_out) == len(faces)
    assert is_watertight_manifold(quads_out)
    assert volume(out, triangulated(quads_out)[0]) == pytest.approx(volume(vertices, triangulated(faces)[0]))
