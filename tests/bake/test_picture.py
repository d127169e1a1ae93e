"""The detail that a picture adds to the view of the same object: paint, but not light."""

from dataclasses import replace

import numpy as np
import pytest

from gdtool.bake.origin import from_surface
from gdtool.bake.picture import picture_of
from gdtool.cameras import project, rig
from gdtool.folders.surface import Surface
from gdtool.folders.views import Views
from gdtool.geometry.meshes import TriMesh
from gdtool.images.metrics import resized
from tests.bake.shapes import albedo_of, psnr, torus, triangles_of
from tests.stages.bake_folders import torus_views

FINE, COARSE = 256, 64


def view_and_picture(painted: np.ndarray, light: np.ndarray):
    """Make the albedo of a view (COARSE) and the picture (FINE, RGBA) of a disc that is painted and lit.

    Also returns the disc's mask (FINE, FINE).
    """
    y, x = np.mgrid[:FINE, :FINE] + 0.5
    disc = (((x - FINE / 2) ** 2 + (y - FINE / 2) ** 2) < (0.4 * FINE) ** 2).astype(float)[..., None]
    view = resized(np.concatenate([painted * disc, disc], -1), COARSE, COARSE)
    return (
        view[..., :3] / np.maximum(view[..., 3:], 1e-3),
        np.concatenate([painted * light[..., None], disc], -1).astype(np.float32),
        disc[..., 0] > 0,
    )


@pytest.fixture(scope="module")
def camera():
    return replace(rig("six", COARSE)[0])


def test_paint_is_recovered_under_smooth_light(camera):
    y, x = np.mgrid[:FINE, :FINE]
    painted = np.stack([0.2 + 0.6 * ((x // 9 + y // 9) % 2), 0.3 + 0.3 * ((x // 5) % 2), 0.5 + 0 * x], -1)
    albedo, picture, disc = view_and_picture(painted, 0.4 + 0.5 * x / FINE)
    coarse = resized(albedo, FINE, FINE)
    sharp = coarse * picture_of(picture, camera, albedo).factor
    inside = resized(resized(disc * 1.0, COARSE, COARSE), FINE, FINE) > 0.99
    assert psnr(sharp[inside], painted[inside]) > psnr(coarse[inside], painted[inside]) + 3


def test_hard_shadows_on_one_color_are_no_paint(camera):
    y, x = np.mgrid[:FINE, :FINE]
    light = np.where((x + y) % 40 < 12, 0.3, 0.9)
    albedo, picture, _ = view_and_picture(np.full((FINE, FINE, 3), 0.5), light)
    np.testing.assert_allclose(picture_of(picture, camera, albedo).factor, 1, atol=1e-3)


def test_a_picture_no_finer_than_its_view_adds_nothing(camera):
    albedo, picture, _ = view_and_picture(
        np.random.default_rng(0).uniform(0.2, 0.8, (FINE, FINE, 3)), np.ones((FINE, FINE))
    )
    small = resized(picture, COARSE, COARSE)
    np.testing.assert_allclose(picture_of(small, camera, albedo).factor, 1, atol=1e-5)


def test_points_read_the_pixels_that_show_them(camera):
    rng = np.random.default_rng(1)
    points = rng.uniform(-0.3, 0.3, (50, 3))
    ramp = np.stack(np.broadcast_arrays(*np.meshgrid(np.arange(FINE) + 0.5, np.arange(FINE) + 0.5), 1.0), -1)
    albedo, picture, _ = view_and_picture(np.full((FINE, FINE, 3), 0.5), np.ones((FINE, FINE)))
    factors = replace(picture_of(picture, camera, albedo), factor=ramp.astype(np.float32)).at(points)
    np.testing.assert_allclose(factors[:, :2], project(camera, points)[0] * FINE / COARSE, atol=1e-3)


def test_the_view_that_the_others_were_generated_from_is_not_outvoted():
    """All views but the front show another color; where the front sees the surface, its color is baked."""
    vertices, quads, normals = torus(160, 90)
    count, views = len(vertices), torus_views(96)
    other = np.full((count, 3), 0.5)
    surface = Surface(
        vertices, triangles_of(quads), other, np.full(count, 0.5), np.zeros(count), np.ones(count), normals
    )
    albedo = np.where(views.mask[..., None] > 0, np.full(3, 0.5), 0).astype(np.float32)
    albedo[0] = views.images["albedo"][0]
    changed_views = Views(views.cameras, {"albedo": albedo}, views.mask)
    picture = picture_of(np.concatenate([albedo[0], views.mask[0, ..., None]], -1), views.cameras[0], albedo[0])
    places = _front_places(vertices, triangles_of(quads), normals)
    without_picture, with_picture = (from_surface(surface, changed_views, picture=one) for one in (None, picture))
    points = with_picture.source.at(places.face_idx, places.barycentric, with_picture.source.mesh.vertices)
    errors = [
        np.abs(one.lookup(places)["albedo"] - albedo_of(points)).mean() for one in (without_picture, with_picture)
    ]
    assert errors[1] < 0.05
    assert errors[1] < 0.5 * errors[0]
    assert "picture: albedo" in with_picture.label
    assert "picture" not in without_picture.label


def _front_places(vertices, faces, normals):
    """Choose places in the middle of faces that the front camera sees well."""
    from gdtool.bake.reproject import Places

    facing = np.flatnonzero(normals[faces].mean(1)[:, 2] > 0.95)
    facing = facing[vertices[faces[facing]].mean(1)[:, 2] > 0.3]
    return Places(
        facing.astype(np.int32),
        np.full((len(facing), 3), 1 / 3, np.float32),
        np.ones(len(facing), bool),
        np.zeros(len(facing), bool),
    )


def test_only_colors_follow_the_pictures_view_where_others_face_the_surface_better():
    """A plane at 40 degrees to the front camera and at 5 to the next: only its colors follow the front view."""
    from gdtool.bake.project_views import ViewStack, observe, view_visibility
    from gdtool.geometry.rays import RayCaster

    cameras = [camera for camera in rig("six", 64) if camera.name in ("front", "front_right")]
    turned = np.radians(40)
    across, up = np.array([np.cos(turned), 0, -np.sin(turned)]), np.array([0.0, 1.0, 0.0])
    corners = np.array([a * across + b * up for a, b in ((-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (-0.3, 0.3))])
    normal = np.cross(across, up)
    assert normal @ cameras[1].backward > 0.95 > normal @ cameras[0].backward
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    caster = RayCaster(TriMesh(corners, faces))
    visibilities = [view_visibility(camera, caster, np.ones((64, 64), np.float32)) for camera in cameras]
    stack = np.stack([np.full((64, 64, 4), value, np.float32) for value in (0.3, 0.4)])
    points = np.random.default_rng(0).uniform(-0.15, 0.15, (40, 2)) @ np.stack([across, up])
    normals, mask = np.tile(normal, (40, 1)), np.ones((2, 64, 64), np.float32)
    alike = observe(points, normals, ViewStack(visibilities, stack, mask)).values
    value, _, shares = observe(points, normals, ViewStack(visibilities, stack, mask, 0, 3))
    assert (alike > 0.37).all()
    assert (value[:, :3] < 0.36).all()
    assert (shares[0] > 0.45).all()
    np.testing.assert_allclose(value[:, 3], alike[:, 3], atol=1e-6)
