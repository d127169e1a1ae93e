"""Compare parts and solids with shapes of known volume and normals."""

import numpy as np
import pytest

from gdtool.assets.procedural import parts, patterns, solids
from gdtool.assets.procedural.assembly import convexity


def volume(part):
    """Compute the volume of a part."""
    return parts.signed_volume(part.vertices, part.faces)


def test_parts_have_the_volume_of_their_shape():
    assert volume(parts.box(2, 1, 3, bevel=0.001)) == pytest.approx(6.0, rel=2e-3)
    assert volume(parts.cylinder(0.5, 2.0, bevel=0.001, count=200)) == pytest.approx(np.pi * 0.5, rel=2e-3)
    assert volume(parts.ball(0.5, 1.0, 0.25, count=120)) == pytest.approx(4 / 3 * np.pi * 0.125, rel=3e-3)
    ring = np.stack([np.cos(w := 2 * np.pi * np.arange(200) / 200), np.sin(w), 0 * w], -1)
    assert volume(parts.tube(ring, 0.1, closed=True, outline=parts.circle(60))) == pytest.approx(
        2 * np.pi**2 * 0.01, rel=5e-3
    )


def test_a_polygonised_sphere_lies_on_the_sphere():
    part = solids.polygonised(solids.ellipsoid((0.1, 0.2, 0.3), 0.5), 48)
    offset = part.vertices - np.array([0.1, 0.2, 0.3])
    assert np.abs(np.linalg.norm(offset, axis=1) - 0.5).max() < 1e-3
    assert (part.normals * offset / 0.5).sum(axis=1).min() > 0.999
    assert volume(part) == pytest.approx(4 / 3 * np.pi * 0.125, rel=5e-3)


def test_union_difference_and_intersection_contain_their_points():
    ball, hole = solids.ellipsoid((0, 0, 0), 1.0), solids.ellipsoid((1, 0, 0), 0.5)
    points = np.array([[0, 0, 0], [0.9, 0, 0], [1.2, 0, 0], [-0.9, 0, 0]], np.float32)
    assert (solids.blended([ball, hole], 0.01)(points) < 0).tolist() == [True, True, True, True]
    assert (solids.carved(ball, hole)(points) < 0).tolist() == [True, False, False, True]
    assert (solids.common([ball, hole])(points) < 0).tolist() == [False, True, False, False]


def test_a_repeated_profile_row_changes_nothing():
    twice = parts.loft(np.array([(0, 0), (1, 0), (1, 0), (1, 2), (0, 2)]), parts.circle(20))
    once = parts.loft(np.array([(0, 0), (1, 0), (1, 2), (0, 2)]), parts.circle(20))
    assert len(twice.faces) == len(once.faces)
    assert volume(twice) == volume(once)


def test_an_empty_solid_is_refused():
    with pytest.raises(ValueError, match="no inside"):
        solids.polygonised(lambda p: np.ones(len(p), np.float32))


def test_transformed_and_mirrored_parts_keep_outward_winding():
    part = parts.cone(0.5, 1.0)
    for other in (part.turned("x", 70), part.moved(1, 2, 3), part.mirrored(), part.scaled(0.5, -2.0, 1.0)):
        assert volume(other) > 0
        corners = other.vertices[other.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert (np.einsum("ij,ij->i", normals, other.normals[other.faces].mean(axis=1)) > 0).all()


def test_rotation_is_right_handed():
    assert parts.rotation("y", 90) @ np.array([0, 0, 1]) == pytest.approx([1, 0, 0])
    assert parts.rotation("x", 90) @ np.array([0, 1, 0]) == pytest.approx([0, 0, 1])


def test_a_wide_bevel_does_not_fold_the_sides_of_a_thin_plank():
    part = parts.extrusion(parts.rectangle(0.03, 0.5, 6), 0.12, 0.006)
    corners = part.vertices[part.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("ij,ij->i", normals, part.normals[part.faces].mean(axis=1)) > 0).all()


def test_boxes_have_flat_normals_and_balls_smooth_ones():
    box = parts.box(1, 1, 1, bevel=0.05)
    flat = np.abs(box.normals).max(axis=1) > 0.999
    assert flat.mean() > 0.5
    ball = parts.ball(1.0, count=48)
    assert (ball.normals * ball.vertices).sum(axis=1).min() > 0.995


def test_convexity_is_high_on_edges_and_zero_on_sides():
    part = parts.extrusion(parts.rectangle(1, 1, 10), 1.0, 0.05).moved(y=-0.5)
    value = convexity(part.vertices, part.normals, part.faces)
    middle = np.abs(part.vertices).max(axis=1) > 0.499
    middle &= np.sort(np.abs(part.vertices), axis=1)[:, 1] < 0.25
    edge = np.sort(np.abs(part.vertices), axis=1)[:, 1] > 0.44
    assert value[edge].mean() > 0.5
    assert np.abs(value[middle]).max() < 0.2


def test_tiling_images_have_no_seam():
    rng = np.random.default_rng(0)
    noise = patterns.tile_noise(rng, 128, 2, 8)
    inner = np.abs(np.diff(noise, axis=1)).mean()
    assert np.abs(noise[:, 0] - noise[:, -1]).mean() < 1.5 * inner
    near = patterns.tile_cells(rng, 128, 20).nearest
    assert np.abs(near[0] - near[-1]).max() < 2 / 128


def test_normals_of_a_height_map_point_down_the_slope():
    ramp = np.zeros((8, 8))
    ramp[:, 3:5] = [0.5, 1.0]  # rises toward the right
    normal = patterns.normal_from_height(ramp, 0.5).astype(float) / 127.5 - 1
    assert normal[0, 3, 0] < -0.2
    assert abs(normal[0, 3, 1]) < 0.02
    normal = patterns.normal_from_height(ramp.T, 0.5).astype(float) / 127.5 - 1
    assert normal[3, 0, 1] > 0.2  # rises toward the bottom: +Y is up
