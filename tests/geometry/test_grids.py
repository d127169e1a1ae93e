"""Grids: extraction is closed and exact on a plane and a sphere, even at the border and at exact zeros."""

import numpy as np
import pytest

from gdtool.fields.grid.fusion import is_closed_manifold
from gdtool.geometry.grids import components, edge_counts, extract, fine_points, grid_over, keep_faces, signed_volume


def values_of(distance, grid):
    index = np.stack(np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij"), -1).reshape(-1, 3)
    return distance(grid.points(index)).reshape(grid.shape).astype(np.float32)


def test_sphere_has_its_volume_and_radius():
    grid = grid_over([-0.5] * 3, [0.5] * 3, 0.02, margin=2)
    vertices, faces = extract(values_of(lambda p: np.linalg.norm(p, axis=1) - 0.4, grid), grid)
    assert is_closed_manifold(faces)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.4).max() < 3e-4
    assert signed_volume(vertices, faces) == pytest.approx(4 / 3 * np.pi * 0.4**3, rel=0.01)


def test_surface_that_reaches_the_border_is_closed():
    grid = grid_over([-0.5] * 3, [0.5] * 3, 0.1, margin=0)
    vertices, faces = extract(np.full(grid.shape, -0.1, np.float32), grid)
    assert is_closed_manifold(faces) and signed_volume(vertices, faces) > 0.9


def test_exact_zeros_and_noise_make_closed_surfaces():
    grid = grid_over([0] * 3, [1] * 3, 0.1, margin=1)
    rng = np.random.default_rng(0)
    for values in (rng.integers(-1, 2, grid.shape) * 0.1, rng.standard_normal(grid.shape)):
        _, faces = extract(values.astype(np.float32), grid)
        assert (edge_counts(faces)[1] % 2 == 0).all()


def test_nothing_inside_gives_nothing():
    grid = grid_over([0] * 3, [1] * 3, 0.25, margin=0)
    vertices, faces = extract(np.ones(grid.shape, np.float32), grid)
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)


def test_grid_covers_its_box_and_counts_cells_in_multiples():
    grid = grid_over([-0.3, 0, 0], [0.4, 0.1, 1], 0.07, margin=3, multiple=4)
    assert all((n - 1) % 4 == 0 for n in grid.shape)
    assert (grid.origin <= np.array([-0.3, 0, 0]) - 2.9 * 0.07).all()
    assert (grid.points(np.array([grid.shape]) - 1)[0] >= np.array([0.4, 0.1, 1]) + 2.9 * 0.07).all()
    assert grid.locate(grid.points(np.array([[1, 2, 3]]))) == pytest.approx(np.array([[1, 2, 3]]))


def test_fine_points_cover_cells_and_their_faces():
    cells = np.zeros((2, 2, 2), bool)
    cells[0, 0, 0] = True
    fine = fine_points(cells, 2)
    assert fine.shape == (5, 5, 5) and fine.sum() == 27 and fine[:3, :3, :3].all()


def test_components_split_and_keep():
    faces = np.array([[0, 1, 2], [3, 4, 5], [2, 1, 6]])
    labels = components(faces, 7)
    assert labels[0] == labels[2] != labels[1]
    vertices, kept, used = keep_faces(np.arange(21.0).reshape(7, 3), faces, labels == labels[0])
    assert used.tolist() == [0, 1, 2, 6] and kept.tolist() == [[0, 1, 2], [2, 1, 3]]
    assert vertices[3].tolist() == [18, 19, 20]
