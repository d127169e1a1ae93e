"""Lay out grids, and extract surfaces that are closed, also at the border and at exact zeros."""

import numpy as np
import pytest

from gdtool.fields.grid.fusion import is_closed_manifold
from gdtool.geometry.grids import (
    components,
    edge_counts,
    extract_surface,
    fine_points,
    grid_over,
    keep_faces,
    signed_volume,
)
from gdtool.geometry.meshes import TriMesh


def values_of(distance, grid):
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)
    return distance(grid.points(index)).reshape(grid.shape).astype(np.float32)


def test_an_extracted_sphere_has_its_volume_and_radius():
    grid = grid_over([-0.5] * 3, [0.5] * 3, 0.02, margin=2)
    mesh = extract_surface(values_of(lambda p: np.linalg.norm(p, axis=1) - 0.4, grid), grid)
    assert is_closed_manifold(mesh.faces)
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.4).max() < 3e-4
    assert signed_volume(mesh) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.01)


def test_a_surface_that_reaches_the_border_is_closed():
    grid = grid_over([-0.5] * 3, [0.5] * 3, 0.1, margin=0)
    mesh = extract_surface(np.full(grid.shape, -0.1, np.float32), grid)
    assert is_closed_manifold(mesh.faces)
    assert signed_volume(mesh) > 0.9


def test_exact_zeros_and_noise_give_closed_surfaces():
    grid = grid_over([0] * 3, [1] * 3, 0.1, margin=1)
    rng = np.random.default_rng(0)
    for values in (rng.integers(-1, 2, grid.shape) * 0.1, rng.standard_normal(grid.shape)):
        mesh = extract_surface(values.astype(np.float32), grid)
        assert (edge_counts(mesh.faces)[1] % 2 == 0).all()


def test_a_grid_without_negative_values_gives_an_empty_mesh():
    grid = grid_over([0] * 3, [1] * 3, 0.25, margin=0)
    mesh = extract_surface(np.ones(grid.shape, np.float32), grid)
    assert mesh.vertices.shape == (0, 3)
    assert mesh.faces.shape == (0, 3)


def test_a_grid_covers_its_box_with_a_multiple_of_cells():
    grid = grid_over([-0.3, 0, 0], [0.4, 0.1, 1], 0.07, margin=3, multiple=4)
    assert all((n - 1) % 4 == 0 for n in grid.shape)
    assert (grid.origin <= np.array([-0.3, 0, 0]) - 2.9 * 0.07).all()
    assert (grid.points(np.array([grid.shape]) - 1)[0] >= np.array([0.4, 0.1, 1]) + 2.9 * 0.07).all()
    assert grid.locate(grid.points(np.array([[1, 2, 3]]))) == pytest.approx(np.array([[1, 2, 3]]))


def test_fine_points_include_the_borders_of_their_cells():
    cells = np.zeros((2, 2, 2), bool)
    cells[0, 0, 0] = True
    fine = fine_points(cells, 2)
    assert fine.shape == (5, 5, 5)
    assert fine.sum() == 27
    assert fine[:3, :3, :3].all()


def test_faces_that_share_a_vertex_are_one_component():
    faces = np.array([[0, 1, 2], [3, 4, 5], [2, 1, 6]])
    labels = components(faces, 7)
    assert labels[0] == labels[2] != labels[1]
    kept = keep_faces(TriMesh(np.arange(21.0).reshape(7, 3), faces), labels == labels[0])
    assert kept.faces.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert kept.vertices[:, 0].tolist() == [0, 3, 6, 18]
