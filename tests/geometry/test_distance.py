import numpy as np
import pytest

from gdtool.geometry.distance import barycentric_of, closest_points, sample_surface, winding_number

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def cube(side=1.0, center=(0, 0, 0)):
    import trimesh

    box = trimesh.creation.box((side,) * 3)
    return np.asarray(box.vertices) + center, np.asarray(box.faces)


def test_distance_to_a_square():
    points = np.array([[0.5, 0.25, 2], [0.5, 0.25, -2], [2, 0.5, 0], [2, 2, 1], [0.1, 0.2, 0]])
    distance, face_idx, closest = closest_points(points, SQUARE, HALVES)
    np.testing.assert_allclose(distance, [2, 2, 1, np.sqrt(3), 0], atol=1e-12)
    np.testing.assert_allclose(closest, [[0.5, 0.25, 0], [0.5, 0.25, 0], [1, 0.5, 0], [1, 1, 0], [0.1, 0.2, 0]], atol=1e-12)
    assert face_idx.tolist()[:2] == [0, 0] and face_idx[4] == 1


def test_unused_vertices_are_no_surface():
    vertices = np.concatenate([SQUARE, [[0.5, 0.5, 5]]])
    assert closest_points(np.array([[0.5, 0.5, 5.0]]), vertices, HALVES)[0] == pytest.approx(5)


def test_a_mesh_without_faces():
    with pytest.raises(ValueError, match="without faces"):
        closest_points(SQUARE, SQUARE, np.zeros((0, 3), int))
    assert winding_number(SQUARE, SQUARE, np.zeros((0, 3), int)).tolist() == [0] * 4
    assert len(closest_points(np.zeros((0, 3)), SQUARE, HALVES)[0]) == 0


def test_zero_area_faces_are_segments_and_are_never_sampled():
    faces = np.array([[0, 1, 1], [0, 1, 2], [2, 2, 2]])
    assert closest_points(np.array([[0.5, -1.0, 0]]), SQUARE, faces[:1])[0] == pytest.approx(1)
    assert set(sample_surface(SQUARE, faces, 2000, np.random.default_rng(0))[1]) == {1}
    with pytest.raises(ValueError, match="without area"):
        sample_surface(SQUARE, faces[:1], 10, np.random.default_rng(0))


def test_winding_number_of_a_cube():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (5000, 3))
    points = points[np.abs(np.abs(points).max(1) - 0.5) > 1e-3]
    inside = np.abs(points).max(1) < 0.5
    vertices, faces = cube()
    np.testing.assert_allclose(winding_number(points, vertices, faces), inside, atol=0.02)
    np.testing.assert_allclose(winding_number(points, vertices, faces[:, ::-1]), -1.0 * inside, atol=0.02)


def test_samples_are_uniform_by_area():
    # A square and, on another plane, a half square of a third of that area in all.
    vertices = np.concatenate([SQUARE, SQUARE * [1, 1 / 3, 1] + [0, 0, 4]])
    faces = np.concatenate([HALVES, HALVES + 4])
    points, face_idx, barycentric = sample_surface(vertices, faces, 40000, np.random.default_rng(1))
    assert np.mean(face_idx >= 2) == pytest.approx(0.25, abs=0.01)  # five standard deviations
    counts = np.histogram2d(*points[face_idx < 2, :2].T, bins=5, range=((0, 1), (0, 1)))[0]
    assert ((counts - 1200) ** 2 / 1200).sum() < 60  # chi-square with 24 degrees of freedom: 1e-4
    np.testing.assert_allclose(points, np.einsum("nc,ncd->nd", barycentric, vertices[faces[face_idx]]))
    assert (barycentric >= 0).all() and np.allclose(barycentric.sum(1), 1)


def test_samples_repeat_with_their_generator():
    a, b = (sample_surface(SQUARE, HALVES, 50, np.random.default_rng(3))[0] for _ in range(2))
    assert (a == b).all()


def test_barycentric_inverts_interpolation_even_on_slivers():
    rng = np.random.default_rng(2)
    triangles = rng.normal(size=(500, 3, 3))
    triangles[250:, 2] = triangles[250:, 0] * 0.5 + triangles[250:, 1] * 0.5 + 1e-5 * rng.normal(size=(250, 3))
    weights = rng.dirichlet((1, 1, 1), 500)
    found = barycentric_of(np.einsum("nc,ncd->nd", weights, triangles), triangles)
    np.testing.assert_allclose(found, weights, atol=1e-8)
    assert barycentric_of(np.ones((1, 3)), np.zeros((1, 3, 3))).tolist() == [[1, 0, 0]]
