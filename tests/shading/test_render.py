"""Check rendered buffers and direct light on shapes with analytic answers."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gdtool.assets.scene import Material, Scene, Texture
from gdtool.cameras import camera_at, rays, rig
from gdtool.shading.lights.environment import Environment
from gdtool.shading.render.color import render_color
from gdtool.shading.render.pattern import pixel_pattern
from gdtool.shading.render.render import Renderer, render_buffers
from gdtool.shading.render.surface_points import surface_attributes

GREY = Material(base_color=(0.5, 0.25, 0.125, 1.0), metallic=0.0, roughness=0.5)


def sphere(radius: float = 0.5, rings: int = 96, material: Material = GREY) -> Scene:
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False), indexing="ij"
    )
    unit = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = row * 2 * rings + column, row * 2 * rings + (column + 1) % (2 * rings)
    faces = np.concatenate(
        [
            np.stack([a, a + 2 * rings, b + 2 * rings], -1).reshape(-1, 3),
            np.stack([a, b + 2 * rings, b], -1).reshape(-1, 3),
        ]
    )
    return Scene(vertices=unit * radius, faces=faces.astype(np.int32), materials=(material,), normals=unit)


def quad(material: Material, z: float = 0.0, half: float = 0.5, uv_scale: float = 1.0) -> Scene:
    """Make a square that faces +Z, with its texture upright as seen from there."""
    vertices = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float) * uv_scale
    return Scene(vertices=vertices, faces=np.array([[0, 1, 2], [0, 2, 3]], np.int32), materials=(material,), uvs=(uv,))


def uniform(value: float = 1.0) -> Environment:
    return Environment(np.full((16, 32, 3), value, np.float32), "uniform")


@pytest.mark.parametrize("fov", [None, 40.0])
def test_sphere_normals_depth_and_coverage(fov):
    camera = camera_at(30.0, 20.0, name="v", size=96, fov_degrees=fov)
    out = render_buffers(sphere(), camera, samples=16)
    inside = out["mask"] == 1
    origins, directions = rays(camera)
    # The analytic first hit of the pixel centre's ray.
    b = (origins * directions).sum(-1)
    root = b * b - (origins**2).sum(-1) + 0.25
    at = origins + directions * (-b - np.sqrt(np.maximum(root, 0)))[..., None]
    middle = inside & (root > 0.03)
    assert middle.sum() > 800
    assert (out["normal"][middle] * at[middle] / 0.5).sum(-1).min() > np.cos(np.radians(1.0))
    depth = (camera.position - at) @ camera.backward
    assert np.abs(out["depth"] - depth)[middle].max() < 2e-3
    if fov is None:
        area = out["mask"].sum() * camera.pixel_size**2
        assert area == pytest.approx(np.pi * 0.25, rel=2e-3)
    assert np.allclose(out["albedo"][inside], (0.5, 0.25, 0.125), atol=1e-6)
    assert np.allclose(out["roughness"][inside], 0.5)
    assert not out["metallic"].any()
    outside = out["mask"] == 0
    assert not any(out[name][outside].any() for name in ("normal", "depth", "albedo", "roughness"))


def test_coverage_of_a_quad_that_cuts_pixels():
    camera = rig("six", 64)[0]
    half = 10.25 * camera.pixel_size
    out = render_buffers(quad(GREY, half=half), camera, samples=64)
    row = out["mask"][32]
    assert row[21] == pytest.approx(0.25, abs=0.05)
    assert row[42] == pytest.approx(0.25, abs=0.05)
    assert (row[22:42] == 1).all()
    assert not row[:21].any()
    assert not row[43:].any()


def test_every_pass_of_a_pixels_samples_reduces_the_error():
    """The error of coverage by half planes falls faster than the root of the number of samples.

    No two samples coincide.
    """
    rng = np.random.default_rng(0)
    angle, offset = rng.random(400) * 2 * np.pi, rng.uniform(-0.5, 0.5, 400)
    grid = np.stack(np.meshgrid(*[(np.arange(200) + 0.5) / 200] * 2), -1).reshape(-1, 2)

    def covered(points):
        return ((points - 0.5) @ np.stack([np.cos(angle), np.sin(angle)]) < offset).mean(0)

    pattern, truth = pixel_pattern(64), covered(grid)
    assert len(np.unique(pattern, axis=0)) == 64
    assert pattern.min() >= 0
    assert pattern.max() < 1
    for count in (4, 8, 16, 32, 64):
        assert np.allclose(pattern[:count].mean(0), 0.5, atol=1e-3)
        error = np.sqrt(((covered(pattern[:count]) - truth) ** 2).mean())
        assert error < 0.12 * (4 / count) ** 0.72


def four_colors() -> Texture:
    """Make an 8-bit sRGB texture: red top left, green top right, blue bottom left, white bottom right."""
    image = np.zeros((2, 2, 3), np.uint8)
    image[0, 0], image[0, 1], image[1, 0], image[1, 1] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 255)
    return Texture(image, "srgb", filter="nearest")


def test_pictures_are_not_mirrored_in_any_view():
    """The object has a red ball toward +X, a green one on top and a blue one in front."""
    balls = [(0.35, 0, 0), (0, 0.35, 0), (0, 0, 0.35)]
    ball = sphere(0.1, 16)
    parts = [ball.vertices + np.array(p) for p in balls]
    colors = np.repeat(np.eye(3), len(ball.vertices), 0)
    scene = Scene(
        vertices=np.concatenate(parts),
        faces=np.concatenate([ball.faces + k * len(ball.vertices) for k in range(3)]),
        materials=(dataclasses.replace(GREY, base_color=(1, 1, 1, 1)),),
        normals=np.concatenate([ball.normals] * 3),
        colors=np.concatenate([colors, np.ones((len(colors), 1))], 1),
    )
    expected = {"front": "right", "back": "left", "right": None, "left": None}
    for camera in rig("six", 64):
        albedo = render_buffers(scene, camera, samples=4)["albedo"]
        rows = {
            c: np.argwhere(albedo[..., k] > 0.5).mean(0) for k, c in enumerate("rgb") if (albedo[..., k] > 0.5).any()
        }
        assert rows["g"][0] < 25, "up is up"
        if camera.name in ("front", "back"):
            assert (rows["r"][1] > 40) == (expected[camera.name] == "right")
        if camera.name in ("right", "left"):
            # Seen from +X the front (blue) is to the left.
            assert (rows["b"][1] < 24) == (camera.name == "right")


def test_texture_is_upright_and_wraps():
    material = dataclasses.replace(GREY, base_color=(1, 1, 1, 1), base_color_texture=four_colors())
    albedo = render_buffers(quad(material), rig("six", 64)[0], samples=4)["albedo"]
    assert np.allclose(albedo[20, 20], (1, 0, 0))
    assert np.allclose(albedo[20, 44], (0, 1, 0))
    assert np.allclose(albedo[44, 20], (0, 0, 1))
    assert np.allclose(albedo[44, 44], 1)
    for wrap, wanted in {"repeat": (1, 0, 0), "mirror": (0, 1, 0), "clamp": (0, 1, 0)}.items():
        texture = dataclasses.replace(four_colors(), wrap_u=wrap, wrap_v="clamp")
        scene = quad(dataclasses.replace(material, base_color_texture=texture))
        scene = dataclasses.replace(scene, uvs=(np.array([[1.2, 0.2]] * 4),))
        assert np.allclose(surface_attributes(scene, np.array([0]), np.array([[1.0, 0, 0]]))["albedo"][0], wanted)


def test_bilinear_filter_blends_linear_values():
    texture = Texture(np.array([[[0], [255]]], np.uint8).repeat(3, 2), "srgb", wrap_u="clamp", wrap_v="clamp")
    scene = quad(dataclasses.replace(GREY, base_color=(1, 1, 1, 1), base_color_texture=texture))
    scene = dataclasses.replace(scene, uvs=(np.array([[0.5, 0.5]] * 4),))
    assert np.allclose(surface_attributes(scene, np.array([0]), np.array([[1.0, 0, 0]]))["albedo"][0], 0.5, atol=1e-6)


def test_a_fine_checker_averages_and_second_uv_set_is_used():
    checker = (np.indices((64, 64)).sum(0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, 2)
    material = dataclasses.replace(
        GREY, base_color=(1, 1, 1, 1), base_color_texture=Texture(checker, "linear", uv_set=1)
    )
    scene = quad(material, uv_scale=0.0)
    scene = dataclasses.replace(scene, uvs=(scene.uvs[0], quad(material, uv_scale=4.0).uvs[0]))
    out = render_buffers(scene, rig("six", 32)[0], samples=16)
    assert np.abs(out["albedo"][out["mask"] == 1] - 0.5).max() < 0.02


def test_normal_map_tilts_toward_the_tangents():
    """+X of the map tilts toward +u and +Y (green) toward the top of the picture, from the front and from behind."""
    tilted = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.6, 0.8])
    for local in tilted:
        texel = np.rint((0.5 * local + 0.5) * 65535).astype(np.uint16)
        material = dataclasses.replace(GREY, normal_texture=Texture(np.broadcast_to(texel, (4, 4, 3)).copy()))
        views = {
            c.name: render_buffers(quad(material), c, samples=4)["normal"][32, 32]
            for c in rig("six", 64)
            if c.name in ("front", "back")
        }
        assert np.allclose(views["front"], local, atol=1e-3)
        assert np.allclose(views["back"], -local, atol=1e-3)


def test_alpha_mask_lets_rays_through_and_blend_counts_from_one_half():
    front = Texture(np.array([[[255, 255, 255, 255], [255, 255, 255, 0]]], np.uint8), filter="nearest")
    for mode, cutoff in (("MASK", 0.5), ("BLEND", 0.0)):
        near = quad(Material(base_color_texture=front, alpha_mode=mode, alpha_cutoff=cutoff, metallic=0.0), z=0.2)
        far = quad(dataclasses.replace(GREY, base_color=(0, 0, 1, 1)), z=-0.2)
        scene = Scene(
            vertices=np.concatenate([near.vertices, far.vertices]),
            faces=np.concatenate([near.faces, far.faces + 4]),
            materials=(near.materials[0], far.materials[0]),
            material_idx=np.array([0, 0, 1, 1], np.int32),
            uvs=(np.concatenate([near.uvs[0], far.uvs[0]]),),
        )
        out = render_buffers(scene, rig("six", 64)[0], samples=4)
        assert np.allclose(out["albedo"][32, 20], 1)
        assert np.allclose(out["albedo"][32, 44], (0, 0, 1))
        assert out["depth"][32, 20] == pytest.approx(1.8, abs=1e-5)
        assert out["depth"][32, 44] == pytest.approx(2.2, abs=1e-5)
        renderer = Renderer(scene)
        # From behind the hole the sky is open, behind the solid half it is not.
        origins = np.array([[-0.25, 0, -0.1], [0.25, 0, -0.1]])
        assert renderer.occluded(origins, np.array([[0.0, 0, 1]] * 2)).tolist() == [True, False]


def test_white_furnace_of_sampled_light():
    """Under uniform light of 1 a white rough dielectric reflects about 1: neither shadows nor sampling lose energy."""
    white = Material(base_color=(1, 1, 1, 1), metallic=0.0, roughness=1.0)
    color, mask = render_color(sphere(material=white), rig("six", 48)[0], uniform(), samples=4, light_samples=64)
    assert color[mask == 1].mean() == pytest.approx(0.985, abs=0.03)


def test_lambert_quad_under_a_hemisphere_and_its_shadow():
    """A square under uniform light reflects its albedo, and a wall beside it hides the analytic share of the light."""
    from gdtool.shading.bsdf.brdf import MIN_ROUGHNESS

    floor = quad(dataclasses.replace(GREY, base_color=(0.5, 0.5, 0.5, 1), roughness=1.0))
    camera = rig("six", 32)[0]
    open_sky, mask = render_color(floor, camera, uniform(), samples=4, light_samples=64)
    lit = open_sky[mask == 1].mean()
    assert 0.47 < lit < 0.54
    assert MIN_ROUGHNESS < 0.1
    # A long wall of height 0.5 at x = 0.5: at distance d it hides (1 - d / sqrt(d² + 0.25)) / 2 of the cosine-weighted
    # sky.
    wall = quad(GREY, half=4.0)
    turned = wall.vertices[:, [2, 1, 0]] * (1, 1, -0.125) + (0.5, 0, 0)
    scene = Scene(
        vertices=np.concatenate([floor.vertices, turned]),
        faces=np.concatenate([floor.faces, wall.faces + 4]),
        materials=(floor.materials[0], Material(base_color=(0, 0, 0, 1), metallic=0.0)),
        material_idx=np.array([0, 0, 1, 1], np.int32),
    )
    shadowed, mask = render_color(scene, camera, uniform(), samples=4, light_samples=64)
    for column in (6, 16, 26):
        d = 0.5 - (column + 0.5 - 16) * camera.pixel_size
        assert shadowed[16, column].mean() / lit == pytest.approx(1 - (1 - d / np.hypot(d, 0.5)) / 2, abs=0.03)


def test_same_seed_same_pixels_and_noise_falls_with_samples():
    light = Environment(np.random.default_rng(0).random((16, 32, 3)).astype(np.float32) ** 4)
    scene, camera = sphere(), rig("six", 32)[0]
    first, mask = render_color(scene, camera, light, samples=4, light_samples=4, seed=3)
    again, _ = render_color(scene, camera, light, samples=4, light_samples=4, seed=3)
    assert np.array_equal(first, again)
    best, _ = render_color(scene, camera, light, samples=4, light_samples=256, seed=9)
    more, _ = render_color(scene, camera, light, samples=4, light_samples=64, seed=4)

    def error(image):
        return np.sqrt(((image - best)[mask == 1] ** 2).mean())

    assert error(more) < 0.4 * error(first)
    assert (first >= 0).all()
    assert np.isfinite(first).all()


def test_light_is_unbiased_at_few_directions():
    """The mean of many noisy renderings is the converged one: in the open, in half shadow and on refined pixels."""
    light = Environment((np.random.default_rng(5).random((16, 32, 3)) ** 8).astype(np.float32) * 5)
    ball = sphere(0.25, 24)
    scene = Scene(
        vertices=np.concatenate([ball.vertices + (0.2, 0, 0.1), ball.vertices - (0.2, 0, 0.1)]),
        materials=ball.materials,
        faces=np.concatenate([ball.faces, ball.faces + len(ball.vertices)]),
        normals=np.concatenate([ball.normals] * 2),
    )
    camera = rig("six", 24)[1]
    best, mask = render_color(scene, camera, light, samples=16, light_samples=256, seed=50)
    cheap = np.mean([render_color(scene, camera, light, samples=16, light_samples=8, seed=s)[0] for s in range(12)], 0)
    inside = mask == 1
    assert cheap[inside].mean() == pytest.approx(best[inside].mean(), rel=0.01)
    assert np.abs(cheap - best)[inside].mean() < 0.03 * best[inside].mean()
