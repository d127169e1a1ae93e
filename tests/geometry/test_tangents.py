"""Compute MikkTSpace frames on shapes whose texture axes are known."""

import numpy as np

from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.tangents import corner_tangents, decode_tangent_space, encode_tangent_space, tangent_frames


def plane(n=4, turned=0.0):
    """Make a square in the plane z = 0 that faces +Z; turned: rotation of its texture in radians.

    With 0 image right is +X and image up is +Y.
    """
    axis = np.linspace(0, 1, n)
    x, y = np.meshgrid(axis, axis)
    vertices = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    c, s = np.cos(turned), np.sin(turned)
    up = (vertices[:, :2] - 0.5) @ np.array([[c, -s], [s, c]]) * 0.6 + 0.5
    uv = np.stack([up[:, 0], 1 - up[:, 1]], 1)
    idx = np.arange(n * n).reshape(n, n)
    quads = np.stack([idx[:-1, :-1], idx[:-1, 1:], idx[1:, 1:], idx[1:, :-1]], -1).reshape(-1, 4)
    return vertices, np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]), np.tile([0.0, 0, 1], (n * n, 1)), uv


def test_the_tangent_is_image_right_and_the_bitangent_image_up():
    for turned in (0.0, 0.7, 2.5):
        vertices, faces, normals, uv = plane(turned=turned)
        tangents = corner_tangents(TriMesh(vertices, faces), normals, uv, faces)
        c, s = np.cos(turned), np.sin(turned)
        np.testing.assert_allclose(tangents[..., :3], np.broadcast_to([c, s, 0], tangents[..., :3].shape), atol=1e-6)
        assert (tangents[..., 3] == 1).all()
        bitangent = np.cross([0, 0, 1], tangents[0, 0, :3]) * tangents[0, 0, 3]
        np.testing.assert_allclose(bitangent, [-s, c, 0], atol=1e-6)


def test_a_mirrored_texture_negates_the_sign_and_the_bitangent_points_up():
    vertices, faces, normals, uv = plane()
    uv = uv * (-1, 1) + (1, 0)
    tangents = corner_tangents(TriMesh(vertices, faces), normals, uv, faces)
    np.testing.assert_allclose(tangents[..., :3], np.broadcast_to([-1, 0, 0], tangents[..., :3].shape), atol=1e-6)
    assert (tangents[..., 3] == -1).all()
    np.testing.assert_allclose(-np.cross([0, 0, 1], tangents[0, 0, :3]), [0, 1, 0], atol=1e-6)


def test_tangents_differ_on_the_two_sides_of_a_mirrored_seam():
    # The texture of a plane is mirrored at x = 0; along that line each side keeps its tangents.
    vertices = np.array([[-1, 0, 0], [0, 0, 0], [1, 0, 0], [-1, 1, 0], [0, 1, 0], [1, 1, 0.0]])
    uv = np.stack([np.abs(vertices[:, 0]), 1 - vertices[:, 1]], 1)
    faces = np.array([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    tangents = corner_tangents(TriMesh(vertices, faces), np.tile([0.0, 0, 1], (6, 1)), uv, faces)
    np.testing.assert_allclose(tangents[:2, :, 0], -1, atol=1e-6)
    np.testing.assert_allclose(tangents[2:, :, 0], 1, atol=1e-6)
    assert (tangents[:2, :, 3] == -1).all()
    assert (tangents[2:, :, 3] == 1).all()


def test_group_tangent_is_the_angle_weighted_mean_of_unit_axes():
    # A fan of two triangles with corner angles 90 and 45 degrees, whose texture axes differ by a known shear.
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 1, 0.0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    up = np.array([[0, 0], [1, 0], [0, 1], [-1.5, 1]])
    uv = up * (1, -1) + (0, 1)
    tangents = corner_tangents(TriMesh(vertices, faces), np.tile([0.0, 0, 1], (4, 1)), uv, faces)
    second = np.linalg.lstsq(np.array([[0, 1], [-1.5, 1]]), vertices[[2, 3]], rcond=None)[0][0]
    expected = np.pi / 2 * np.array([1, 0, 0]) + np.pi / 4 * second / np.linalg.norm(second)
    np.testing.assert_allclose(tangents[0, 0, :3], expected / np.linalg.norm(expected), atol=1e-6)
    np.testing.assert_allclose(tangents[1, 0], tangents[0, 0])
    np.testing.assert_allclose(tangents[0, 1, :3], [1, 0, 0], atol=1e-6)


def test_triangles_without_texture_area_borrow_a_finite_frame():
    vertices, faces, normals, uv = plane(n=3)
    corners = np.vstack([faces, [0, 1, 4]])
    face_uvs = np.vstack([faces, [0, 0, 0]])
    tangents = corner_tangents(TriMesh(vertices, corners), normals, uv, face_uvs)
    assert np.isfinite(tangents).all()
    np.testing.assert_allclose(np.linalg.norm(tangents[..., :3], axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(tangents[-1, 0], [1, 0, 0, 1], atol=1e-6)
    alone = corner_tangents(TriMesh(vertices, faces), normals, np.zeros_like(uv), faces)
    np.testing.assert_allclose((alone[..., :3] * (0, 0, 1)).sum(-1), 0, atol=1e-6)
    assert (alone[..., 3] == 1).all()


def test_encoding_decodes_to_the_same_normal_in_skewed_and_mirrored_frames():
    rng = np.random.default_rng(0)
    count = 500
    normals = rng.normal(size=(count, 3, 3)) * 0.3 + (0, 0, 1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    tangents = np.concatenate([rng.normal(size=(count, 3, 3)) * 0.2 + (1, 0, 0), np.ones((count, 3, 1))], -1)
    tangents[::2, :, 3] = -1
    weights = rng.dirichlet((1, 1, 1), count)
    normal, tangent = np.einsum("nk,nkc->nc", weights, normals), np.einsum("nk,nkc->nc", weights, tangents[..., :3])
    sign = tangents[:, 0, 3]
    frames = tangent_frames(normal, tangent, sign)
    world = rng.normal(size=(count, 3)) + (0, 0, 2.0)
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    local = encode_tangent_space(normal, tangent, sign, world)
    np.testing.assert_allclose(decode_tangent_space(frames, local), world, atol=1e-9)
    flat = encode_tangent_space(normal, tangent, sign, normal / np.linalg.norm(normal, axis=1, keepdims=True))
    np.testing.assert_allclose(flat, np.tile([0, 0, 1.0], (count, 1)), atol=1e-9)
    # Normal and tangent are parallel, so there is no frame.
    np.testing.assert_array_equal(encode_tangent_space(normal[:1], normal[:1], sign[:1], world[:1]), [[0, 0, 1]])
