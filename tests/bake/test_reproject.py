"""Points of a baked mesh find their places on the source, on the right side of walls."""

import numpy as np

from gdtool.bake.reproject import Source, cage_offsets, reproject
from gdtool.geometry.meshes import TriMesh
from tests.bake.shapes import sphere, torus, triangles_of


def box(size):
    """Make a closed box centred at the origin: vertices (8, 3), faces (12, 3)."""
    x, y, z = np.array(size) / 2
    vertices = np.array([[a, b, c] for a in (-x, x) for b in (-y, y) for c in (-z, z)])
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return vertices, triangles_of(quads)


def at(source, places):
    """Compute the positions (n, 3) of places on a source."""
    return source.at(places.face_idx, places.barycentric, source.mesh.vertices)


def test_sphere_inside_and_outside_points_meet_it_along_the_normal():
    vertices, faces = sphere(5)
    source = Source(TriMesh(vertices, faces))
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(2000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    for radius in (0.49, 0.5, 0.51):
        places = reproject(radius * direction, direction, np.full(2000, 0.03), source)
        assert places.by_ray.all()
        np.testing.assert_allclose(at(source, places), 0.5 * direction, atol=1e-3)


def test_thin_wall_is_never_crossed():
    # A plate 0.1 % thick; the baked mesh is off by several times that, to either side.
    vertices, faces = box((1.0, 1.0, 0.001))
    source = Source(TriMesh(vertices, faces))
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.45, 0.45, (3000, 2))
    for side in (1.0, -1.0):
        normals = np.tile([0.0, 0.0, side], (3000, 1))
        for offset in (-0.004, -0.0005, 0.0, 0.0005, 0.004):
            points = np.column_stack([xy, np.full(3000, side * (0.0005 + offset))])
            places = reproject(points, normals, np.full(3000, 0.01), source)
            # Weights of the corners are float32.
            np.testing.assert_allclose(at(source, places)[:, 2], side * 0.0005, atol=3e-7)
            np.testing.assert_allclose(at(source, places)[:, :2], xy, atol=3e-7)  # weights of the corners are float32


def test_the_nearest_point_on_its_side_is_taken_where_the_normal_misses():
    vertices, faces = box((1.0, 1.0, 0.001))
    source = Source(TriMesh(vertices, faces))
    # Beside the plate: rays along the normal meet nothing, and both sides' rims are equally near.
    points = np.array([[0.6, 0.1, 0.0005], [0.6, 0.1, -0.0005], [0.6, 0.1, -0.0006]])
    normals = np.array([[0.0, 0, 1], [0, 0, -1], [0, 0, 1]])
    places = reproject(points, normals, np.full(3, 0.01), source)
    assert not places.by_ray.any()
    np.testing.assert_allclose(
        at(source, places), [[0.5, 0.1, 0.0005], [0.5, 0.1, -0.0005], [0.5, 0.1, 0.0005]], atol=1e-9
    )


def test_reach_covers_the_distance_but_not_the_object():
    vertices, quads, _ = torus(300, 150)
    coarse, coarse_quads, _ = torus(40, 20, minor=0.145)
    faces = triangles_of(coarse_quads)
    reach = cage_offsets(TriMesh(coarse, faces), Source(TriMesh(vertices, triangles_of(quads))))
    assert reach.min() > 0.005
    assert reach.max() < 0.08


def test_a_one_sided_sheet_is_read_from_behind():
    # A one-sided square at z = 0 that faces +z, and one far below it that faces -z.
    square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    source = Source(
        TriMesh(np.concatenate([square, square + (0, 0, -0.3)]), np.concatenate([faces, faces[:, ::-1] + 4]))
    )
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(-0.45, 0.45, (500, 2)), rng.uniform(-0.002, 0.002, 500)])
    for side in (1.0, -1.0):
        places = reproject(points, np.tile([0.0, 0.0, side], (500, 1)), np.full(500, 0.01), source)
        np.testing.assert_allclose(at(source, places), points * (1, 1, 0), atol=1e-6)
        assert (places.from_behind == (side < 0)).all()
    # A face within reach that faces the same way is taken first, however near the sheet is.
    places = reproject(points, np.tile([0.0, 0.0, -1.0], (500, 1)), np.full(500, 0.35), source)
    np.testing.assert_allclose(at(source, places)[:, 2], -0.3, atol=1e-6)


def test_nothing_is_read_through_a_one_sided_sheet():
    # Behind a one-sided sheet lies a face that faces the same way as the baked mesh; it must not be read.
    square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    source = Source(
        TriMesh(np.concatenate([square, square * 0.9 - (0, 0, 0.01)]), np.concatenate([faces, faces[:, ::-1] + 4]))
    )
    rng = np.random.default_rng(3)
    for height in (0.0, 0.002):  # the mesh lies on the sheet, or a little above it
        points = np.column_stack([rng.uniform(-0.4, 0.4, (500, 2)), np.full(500, height)])
        places = reproject(points, np.tile([0.0, 0.0, 1.0], (500, 1)), np.full(500, 0.05), source)
        np.testing.assert_allclose(at(source, places), points * (1, 1, 0), atol=1e-6)
        assert places.from_behind.all()
        assert places.by_ray.all()


def test_of_two_faces_back_to_back_the_agreeing_one_is_read():
    square = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    front = np.array([[0, 1, 2], [0, 2, 3]])
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-0.45, 0.45, (500, 2)), rng.uniform(-0.002, 0.002, 500)])
    for order in (1, -1):  # whichever of the two the ray meets
        source = Source(TriMesh(np.concatenate([square, square]), np.concatenate([front, front[:, ::-1] + 4])[::order]))
        np.testing.assert_array_equal(source.twins, [2, 3, 0, 1])
        for side in (1.0, -1.0):
            normals = np.tile([0.0, 0.0, side], (500, 1))
            places = reproject(points, normals, np.full(500, 0.01), source)
            np.testing.assert_allclose(source.face_normals[places.face_idx], normals, atol=1e-9)
            assert not places.from_behind.any()
            np.testing.assert_allclose(at(source, places), points * (1, 1, 0), atol=1e-6)
