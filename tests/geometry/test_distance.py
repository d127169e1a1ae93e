"""Find closest points, winding numbers and surface samples on shapes whose answers are known."""

import sys

import numpy as np
import pytest

from gdtool.geometry import distance
from gdtool.geometry.distance import (
    SearchTree,
    barycentric_of,
    closest_on_triangles,
    closest_points,
    sample_surface,
    split_long_faces,
    winding_number,
)
from gdtool.geometry.meshes import TriMesh
from tests.geometry.solids import sphere

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
HALVES = np.array([[0, 1, 2], [0, 2, 3]])


def cube(side=1.0, center=(0, 0, 0)):
    import trimesh

    box = trimesh.creation.box((side,) * 3)
    return np.asarray(box.vertices) + center, np.asarray(box.faces)


def test_distances_to_a_square_from_above_beside_and_on_it():
    points = np.array([[0.5, 0.25, 2], [0.5, 0.25, -2], [2, 0.5, 0], [2, 2, 1], [0.1, 0.2, 0]])
    distance, face_idx, closest = closest_points(points, TriMesh(SQUARE, HALVES))
    np.testing.assert_allclose(distance, [2, 2, 1, np.sqrt(3), 0], atol=1e-12)
    np.testing.assert_allclose(
        closest, [[0.5, 0.25, 0], [0.5, 0.25, 0], [1, 0.5, 0], [1, 1, 0], [0.1, 0.2, 0]], atol=1e-12
    )
    assert face_idx.tolist()[:2] == [0, 0]
    assert face_idx[4] == 1


def test_vertices_without_faces_are_ignored():
    vertices = np.concatenate([SQUARE, [[0.5, 0.5, 5]]])
    assert closest_points(np.array([[0.5, 0.5, 5.0]]), TriMesh(vertices, HALVES))[0] == pytest.approx(5)


def test_a_mesh_without_faces_has_no_closest_point_and_no_inside():
    with pytest.raises(ValueError, match="without faces"):
        closest_points(SQUARE, TriMesh(SQUARE, np.zeros((0, 3), int)))
    assert winding_number(SQUARE, TriMesh(SQUARE, np.zeros((0, 3), int))).tolist() == [0] * 4
    assert len(closest_points(np.zeros((0, 3)), TriMesh(SQUARE, HALVES))[0]) == 0


def test_faces_without_area_count_as_segments_and_are_never_sampled():
    faces = np.array([[0, 1, 1], [0, 1, 2], [2, 2, 2]])
    assert closest_points(np.array([[0.5, -1.0, 0]]), TriMesh(SQUARE, faces[:1]))[0] == pytest.approx(1)
    assert set(sample_surface(TriMesh(SQUARE, faces), 2000, np.random.default_rng(0))[1]) == {1}
    with pytest.raises(ValueError, match="without area"):
        sample_surface(TriMesh(SQUARE, faces[:1]), 10, np.random.default_rng(0))


def test_the_closest_point_on_each_triangle_agrees_with_a_search():
    rng = np.random.default_rng(4)
    triangles = rng.normal(size=(400, 3, 3))
    triangles[100:200, 2] = triangles[100:200, 1]  # segments
    triangles[200:250] = triangles[200:250, :1]  # points
    points = rng.normal(size=(400, 3)) * 2
    for point, triangle, closest in zip(points, triangles, closest_on_triangles(points, triangles), strict=True):
        np.testing.assert_allclose(
            closest, closest_points(point[None], TriMesh(triangle, np.array([[0, 1, 2]])))[2][0], atol=1e-9
        )


@pytest.mark.parametrize("place", [(0, 0, 0), (1e6, -3e5, 20)], ids=["at the origin", "far from it"])
@pytest.mark.parametrize("large", [0, 10**9], ids=["fcpw", "libigl"])
def test_a_search_tree_agrees_with_a_single_search(monkeypatch, large, place):
    pytest.importorskip("fcpw")
    monkeypatch.setattr(distance, "_MIN_FCPW_FACES", large)
    vertices, faces = sphere(40)
    vertices, faces = vertices + place, np.concatenate([faces, np.repeat(faces[:9, :1], 3, 1)])  # some have no area
    rng = np.random.default_rng(5)
    tree = SearchTree(TriMesh(vertices, faces))
    for count in (0, 30, 3000):  # by one thread and by two
        points = rng.normal(size=(count, 3)) + place
        away, face_idx, point = tree.closest(points)
        want = closest_points(points, TriMesh(vertices, faces))
        np.testing.assert_allclose(away, want[0], rtol=0, atol=5e-7 if large == 0 else 2e-9)
        np.testing.assert_allclose(np.linalg.norm(points - point, axis=1), away, atol=1e-9)
        np.testing.assert_allclose(closest_on_triangles(points, vertices[faces[face_idx]]), point, atol=1e-9)


def test_neighbours_in_the_spatial_order_are_near_each_other():
    points = np.random.default_rng(3).uniform(-1, 1, (4000, 3)).astype(np.float32) + np.float32(1e3)
    order = distance.spatial_order(points)
    assert np.array_equal(np.sort(order), np.arange(4000))
    steps = [np.linalg.norm(np.diff(ordered, axis=0), axis=1).mean() for ordered in (points, points[order])]
    assert steps[1] < 0.5 * steps[0]
    # Equal points keep their order.
    assert np.array_equal(distance.spatial_order(np.repeat(points[:1], 5, 0)), np.arange(5))


def test_split_faces_cover_the_same_surface():
    vertices, faces = (
        np.array([[0, 0, 0], [8, 0.01, 0], [0, 0.1, 0], [0.5, 0.5, 1.0]]),
        np.array([[0, 1, 2], [0, 2, 3], [2, 1, 3], [1, 1, 1]]),
    )
    mesh = TriMesh(vertices, faces)
    split, face_idx = split_long_faces(mesh, 0.5, 1000)
    corners = split.vertices[split.faces]
    assert len(split.faces) > 40
    assert np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=-1).max() <= 0.5
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    original = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))) / 2
    for k in range(3):  # of vectors: a part that faces the other way would reduce the sum
        np.testing.assert_allclose(np.bincount(face_idx, area[:, k], len(faces)), original[:, k], atol=1e-12)
    assert np.linalg.norm(area, axis=1).sum() == pytest.approx(np.linalg.norm(original, axis=1).sum())
    points = np.random.default_rng(0).uniform(-1, 9, (500, 3))
    np.testing.assert_allclose(
        closest_points(points, split)[2],
        closest_points(points, mesh)[2],
        atol=1e-12,
    )


def test_splitting_stops_at_the_most_faces_and_leaves_short_faces():
    assert len(split_long_faces(TriMesh(SQUARE, HALVES), 1e-3, 100).mesh.faces) <= 100
    square = TriMesh(SQUARE, HALVES)
    split, face_idx = split_long_faces(square, 2.0, 100)
    assert split is square
    assert face_idx.tolist() == [0, 1]
    assert len(split_long_faces(TriMesh(SQUARE, HALVES[:0]), 1e-3, 100).mesh.faces) == 0


def test_without_fcpw_a_large_mesh_is_searched_by_libigl(monkeypatch):
    monkeypatch.setattr(distance, "_MIN_FCPW_FACES", 0)
    monkeypatch.setitem(sys.modules, "fcpw", None)
    assert SearchTree(TriMesh(SQUARE, HALVES)).closest(np.array([[0.5, 0.25, 2.0]]))[0].tolist() == [2]


def test_the_winding_number_tells_inside_from_outside_of_a_cube():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (5000, 3))
    points = points[np.abs(np.abs(points).max(1) - 0.5) > 1e-3]
    inside = np.abs(points).max(1) < 0.5
    vertices, faces = cube()
    np.testing.assert_allclose(winding_number(points, TriMesh(vertices, faces)), inside, atol=0.02)
    np.testing.assert_allclose(winding_number(points, TriMesh(vertices, faces[:, ::-1])), -1.0 * inside, atol=0.02)


def test_samples_are_uniform_by_area():
    # A square and, on another plane, a half square of a third of that area in all.
    vertices = np.concatenate([SQUARE, SQUARE * [1, 1 / 3, 1] + [0, 0, 4]])
    faces = np.concatenate([HALVES, HALVES + 4])
    points, face_idx, barycentric = sample_surface(TriMesh(vertices, faces), 40000, np.random.default_rng(1))
    assert np.mean(face_idx >= 2) == pytest.approx(0.25, abs=0.01)  # five standard deviations
    counts = np.histogram2d(*points[face_idx < 2, :2].T, bins=5, range=((0, 1), (0, 1)))[0]
    assert ((counts - 1200) ** 2 / 1200).sum() < 60  # chi-square with 24 degrees of freedom: 1e-4
    np.testing.assert_allclose(points, np.einsum("nc,ncd->nd", barycentric, vertices[faces[face_idx]]))
    assert (barycentric >= 0).all()
    assert np.allclose(barycentric.sum(1), 1)


def test_equal_generators_draw_equal_samples():
    a, b = (sample_surface(TriMesh(SQUARE, HALVES), 50, np.random.default_rng(3))[0] for _ in range(2))
    assert (a == b).all()


def test_barycentric_inverts_interpolation_even_on_slivers():
    rng = np.random.default_rng(2)
    triangles = rng.normal(size=(500, 3, 3))
    triangles[250:, 2] = triangles[250:, 0] * 0.5 + triangles[250:, 1] * 0.5 + 1e-5 * rng.normal(size=(250, 3))
    weights = rng.dirichlet((1, 1, 1), 500)
    points = np.einsum("nc,ncd->nd", weights, triangles)
    np.testing.assert_allclose(barycentric_of(points, triangles), weights, atol=1e-8)
    assert barycentric_of(np.ones((1, 3)), np.zeros((1, 3, 3))).tolist() == [[1, 0, 0]]
