"""Check each kind of work that the renderer skips, by rendering with and without it, to the tolerance of each test."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

import gdtool.shading.render.direct as direct
import gdtool.shading.render.render as render
from gdtool.assets.scene import Scene, Texture
from gdtool.cameras import rig
from gdtool.geometry import rays
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.rays import is_convex
from gdtool.shading.bsdf.reflection import PointReflection
from gdtool.shading.lights.prefilter import ROUGHNESS_LEVELS
from gdtool.shading.lights.studio import studio
from gdtool.shading.render.direct import DirectLight, LightOptions
from gdtool.shading.render.render import Renderer
from tests.geometry.solids import cube
from tests.shading.test_render import GREY, four_colors, quad, sphere


@pytest.mark.parametrize("most", [0, 10**18], ids=["by the hull", "by pairs"])
def test_a_mesh_is_convex_if_its_vertices_lie_on_its_hull(most, monkeypatch):
    monkeypatch.setattr(rays, "_MAX_PAIRS", most)
    ball = sphere(rings=24)
    turned = ball.vertices @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    assert is_convex(TriMesh(ball.vertices, ball.faces))
    assert is_convex(TriMesh(turned * [1, 2, 3], ball.faces))
    assert is_convex(TriMesh(ball.vertices, ball.faces[:, ::-1]))
    # Open; in a plane.
    assert is_convex(TriMesh(ball.vertices, ball.faces[:500]))
    assert is_convex(TriMesh(ball.vertices * [1, 0, 1], ball.faces[:60]))
    for corner in (0, 300, 1199):
        dented = ball.vertices.copy()
        dented[corner] *= 0.98
        assert not is_convex(TriMesh(dented, ball.faces))
    two = np.concatenate([ball.vertices, ball.vertices * 0.5])
    assert not is_convex(TriMesh(two, np.concatenate([ball.faces, ball.faces + len(ball.vertices)])))


def test_convex_objects_need_no_shadow_rays(monkeypatch):
    # Without Russian roulette, which applies only where rays may be cast.
    monkeypatch.setattr(direct, "ROULETTE_SHARE", 0.0)
    vertices, faces = cube()
    ball = sphere(rings=12)
    assert is_convex(TriMesh(vertices, faces))
    assert is_convex(TriMesh(ball.vertices, ball.faces))
    dented = np.array(vertices, float)
    dented[0] *= 0.2
    assert not is_convex(TriMesh(dented, faces))
    pictures = []
    for skip in (True, False):
        renderer = Renderer(ball)
        renderer.convex = skip
        light = DirectLight(renderer, studio("mid", fit=False)[0], 4)
        pictures.append(renderer.buffers(rig("six", 32)[1], 4, light.color())["color"])
        assert bool(renderer.counts.shadow_rays) is not skip
    assert np.array_equal(*pictures)


def test_pixels_outside_the_bounds_are_empty():
    camera, renderer = rig("six", 48)[0], Renderer(sphere(0.2, 24))
    few = renderer.buffers(camera, 8)
    assert renderer.counts.pixels_in_bounds < 0.3 * renderer.counts.pixels
    renderer.window = lambda camera: (0, 48, 0, 48)
    everything = renderer.buffers(camera, 8)
    assert all(np.array_equal(few[name], everything[name]) for name in few)


def test_skipping_samples_of_uniform_pixels_changes_little(monkeypatch):
    """Compare adaptive sampling with all samples everywhere."""
    material = dataclasses.replace(GREY, base_color=(1, 1, 1, 1), base_color_texture=four_colors())
    scene, camera = quad(material), rig("six", 64)[1]
    renderer = Renderer(scene)
    adaptive = renderer.buffers(camera, 16)
    few = renderer.counts.samples
    monkeypatch.setattr(render, "BASE_SAMPLES", 16)
    full = Renderer(scene).buffers(camera, 16)
    assert few < 0.8 * 16 * 64 * 64
    assert np.abs(adaptive["albedo"] - full["albedo"])[full["mask"] > 0].mean() < 2e-3
    assert np.abs(adaptive["mask"] - full["mask"]).max() < 0.1


def test_a_texture_of_one_value_is_a_factor():
    """The texture is not read, the picture is the same to the bit, and the skipped work names the texture."""
    from gdtool.shading.render.skipped_work import skipped_work

    flat = Texture(np.full((8, 8, 3), (200, 100, 50), np.uint8), "srgb")
    scene = quad(
        dataclasses.replace(GREY, base_color_texture=flat, metallic_roughness_texture=Texture(four_colors().image)),
        uv_scale=1.7,
    )
    renderers = [Renderer(scene), Renderer(scene)]
    renderers[1].lookup.skip_constant = False
    few, all_ = (renderer.buffers(rig("six", 48)[1], 8) for renderer in renderers)
    assert all(np.array_equal(few[name], all_[name]) for name in few)
    reasons = {what: why for what, why, _ in skipped_work(renderers[0], 8, None)}
    assert "one value" in reasons["base color lookups"]
    assert "metallic-roughness lookups" not in reasons


def two_balls() -> Scene:
    """Make a large ball that shades a small one, so that shadow rays hit something."""
    large, small = sphere(0.3, 24), sphere(0.15, 16)
    vertices = np.concatenate([large.vertices, small.vertices + (0.28, 0.25, 0.2)])
    faces = np.concatenate([large.faces, small.faces + len(large.vertices)])
    return Scene(
        vertices=vertices, faces=faces, materials=(GREY,), normals=np.concatenate([large.normals, small.normals])
    )


def test_leaving_out_rays_toward_little_light_keeps_the_mean(monkeypatch):
    """Russian roulette needs fewer rays for the same mean over many seeds, to 0.5 % in all and 3 % at a pixel.

    The noise grows by less than a tenth.
    """
    scene, camera, light = two_balls(), rig("six", 24)[1], studio("mid", fit=False)[0]
    means, noises, rays = [], [], []
    for share in (0.0, direct.ROULETTE_SHARE):
        monkeypatch.setattr(direct, "ROULETTE_SHARE", share)
        pictures = []
        for seed in range(48):
            renderer = Renderer(scene)
            frame = renderer.buffers(camera, 4, DirectLight(renderer, light, 4, seed).color())
            pictures.append(frame["color"][frame["mask"] == 1])
        means.append(np.mean(pictures, 0))
        noises.append(np.std(pictures, 0).mean())
        rays.append(renderer.counts.shadow_rays)
    assert renderer.counts.shadow_rays_rare > 0
    assert rays[1] < 0.9 * rays[0]
    assert abs(means[1].mean() / means[0].mean() - 1) < 5e-3
    assert np.abs(means[1] - means[0]).max() < 0.03 * means[0].max()
    assert noises[1] < 1.1 * noises[0]


def test_directions_below_the_horizon_contribute_nothing(monkeypatch):
    """Rays in these directions hit the surface that they start from, but for 1 in 1000 that pass over an edge."""
    monkeypatch.setattr(direct, "ROULETTE_SHARE", 0.0)
    scene, camera, light = two_balls(), rig("six", 24)[1], studio("mid", fit=False)[0]
    evaluate, frames, rays = PointReflection.evaluate, [], []

    def all_above(self, *direction):
        terms, density, above = evaluate(self, *direction)
        return terms, density, torch.ones_like(above)

    for followed in (evaluate, all_above):
        monkeypatch.setattr(PointReflection, "evaluate", followed)
        renderer = Renderer(scene)
        frames.append(renderer.buffers(camera, 4, DirectLight(renderer, light, 4).color())["color"])
        rays.append(renderer.counts.shadow_rays)
    assert rays[1] > rays[0]
    assert np.abs(frames[0] - frames[1]).mean() < 1e-3 * frames[0].mean()


def test_absent_textures_equal_white_ones():
    white = Texture(np.full((4, 4, 3), 255, np.uint8), "linear")
    flat = Texture(np.tile(np.array([128, 128, 255], np.uint8), (4, 4, 1)), "linear")
    textured = dataclasses.replace(
        GREY,
        base_color_texture=dataclasses.replace(white, encoding="srgb"),
        metallic_roughness_texture=white,
        normal_texture=flat,
        emissive_texture=dataclasses.replace(white, encoding="srgb"),
    )
    frames = []
    for material in (GREY, textured):
        renderer = Renderer(quad(material))
        renderer.lookup.skip_constant = False
        frames.append(renderer.buffers(rig("six", 32)[1], 8))
    # 128 of 255 is not quite a flat normal.
    assert all(
        np.abs(frames[0][name] - frames[1][name]).max() < (5e-3 if name == "normal" else 1e-6) for name in frames[0]
    )


def test_opaque_materials_need_no_alpha_test():
    """The alpha of an opaque material's texture has no effect, and an alpha test at a cutoff of 0 changes nothing."""
    texels = np.full((8, 8, 4), 255, np.uint8)
    texels[::2, :, 3] = 0
    opaque = dataclasses.replace(GREY, base_color_texture=Texture(texels, "srgb"))
    frames = []
    for material in (opaque, dataclasses.replace(opaque, alpha_mode="MASK", alpha_cutoff=0.0)):
        renderer = Renderer(quad(material))
        assert (renderer.tested is None) == (material is opaque)
        frames.append(renderer.buffers(rig("six", 32)[1], 8))
    assert all(np.array_equal(frames[0][name], frames[1][name]) for name in frames[0])


def test_prefiltering_unneeded_levels_changes_nothing():
    camera, light, frames = rig("six", 32)[1], studio("mid", fit=False)[0], []
    for everything in (False, True):
        renderer = Renderer(sphere(rings=24))
        shading = DirectLight(renderer, light, 0, options=LightOptions("prefiltered"))
        if everything:
            shading.prefiltered.prepare(np.array([level.roughness for level in ROUGHNESS_LEVELS], np.float32))
        frames.append(renderer.buffers(camera, 4, shading.color())["color"])
        assert (len(shading.prefiltered.images) == len(ROUGHNESS_LEVELS)) == everything
    assert np.array_equal(*frames)
