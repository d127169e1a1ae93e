"""Whatever the scene, what is rendered of it is finite and not negative: bad geometry, materials, lights and scales."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from gdtool.assets.scene import Material, Scene, Texture
from gdtool.cameras import camera_at
from gdtool.geometry.frames import invert_similarity, transform_points, unit_box
from gdtool.shading.bsdf.closed_form import closed_form_image, shade
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.lights.bundled import bundled
from gdtool.shading.lights.environment import Environment
from gdtool.shading.render.direct import DirectLight, LightOptions
from gdtool.shading.render.render import Renderer

SHINY = Material(base_color=(1, 1, 1, 1), metallic=1.0, roughness=0.0)
MATERIALS = {
    "mirror": SHINY,
    "black": Material(base_color=(0, 0, 0, 1), metallic=0.0, roughness=0.0),
    "rough": dataclasses.replace(SHINY, roughness=1.0),
    "dense glass": Material(base_color=(1, 1, 1, 1), metallic=0.0, roughness=0.0, ior=1e6, specular=1e6),
    "air": Material(base_color=(0.5, 0.5, 0.5, 1), metallic=0.0, roughness=0.5, ior=1.0, specular=0.0),
    "glowing": Material(base_color=(1, 0, 0, 1), metallic=0.0, emissive=(1e6, 0, 1e-6)),
    "unlit": dataclasses.replace(SHINY, unlit=True),
    "one texel": Material(
        base_color_texture=Texture(np.full((1, 1, 4), 255, np.uint8), "srgb"),
        metallic_roughness_texture=Texture(np.zeros((1, 1, 3), np.uint8)),
        normal_texture=Texture(np.array([[[128, 128, 128]]], np.uint8)),
        alpha_mode="MASK",
    ),
    "normal map from behind": Material(
        normal_texture=Texture(np.array([[[0, 128, 0], [255, 0, 0]]], np.uint8)), normal_scale=100.0, roughness=0.0
    ),
    "float texels": Material(base_color_texture=Texture(np.array([[[-1.0, 2.0, 1e30]]], np.float32))),
}


def ball(rings: int = 12) -> tuple[np.ndarray, np.ndarray]:
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False), indexing="ij"
    )
    unit = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a, b = row * 2 * rings + column, row * 2 * rings + (column + 1) % (2 * rings)
    # At the poles one of the two triangles of a place has no area; they stay.
    faces = np.concatenate(
        [
            np.stack([a, a + 2 * rings, b + 2 * rings], -1).reshape(-1, 3),
            np.stack([a, b + 2 * rings, b], -1).reshape(-1, 3),
        ]
    )
    return unit * 0.5, faces.astype(np.int32)


def scene_of(material: Material = SHINY, scale: float = 1.0) -> Scene:
    """A ball with faces without area, zero normals, texture coordinates of one place, and a single point as a face."""
    vertices, faces = ball()
    normals = vertices * 2
    normals[::5] = 0
    uv = np.random.default_rng(0).random((len(vertices), 2)) * 1e3
    uv[::3] = 0.5
    faces = np.concatenate([faces, [[0, 0, 0], [5, 5, 6], [1, 1, 1]]]).astype(np.int32)
    vertices = (vertices + (3, -2, 1)) * scale
    vertices = transform_points(invert_similarity(unit_box(vertices)), vertices)
    return Scene(vertices=vertices, faces=faces, materials=(material,), normals=normals, uvs=(uv,))


def constant(value, size=(1, 2)) -> Environment:
    return Environment(np.full((*size, 3), value, np.float32), "constant")


def sun() -> Environment:
    image = np.zeros((32, 64, 3), np.float32)
    image[4, 48] = 1e9
    return Environment(image, "sun")


LIGHTS = {
    "black": constant(0.0),
    "one texel": constant(1.0, (1, 1)),
    "huge": constant(1e9),
    "tiny": constant(1e-30),
    "sun": sun(),
    "studio": bundled("mid"),
}


def check(images: dict[str, np.ndarray], lit: bool = True) -> None:
    assert set(images) >= {"mask", "normal", "depth", "albedo", "roughness", "metallic"}
    assert images["mask"].max() > 0.5
    for name, image in images.items():
        assert np.isfinite(image).all(), name
        if name != "normal":
            assert image.min() >= 0, name
        if name in ("albedo", "roughness", "metallic", "mask"):
            assert image.max() <= 1 + 1e-6, name


def rendered(
    scene: Scene, environment: Environment, *, fov: float | None = 30.0, brdf: str = "gltf", size: int = 16, **options
) -> dict[str, np.ndarray]:
    renderer = Renderer(scene, 1)
    light = DirectLight(renderer, environment, options.pop("samples", 4), 0, brdf, LightOptions(**options))
    return renderer.buffers(camera_at(20.0, 10.0, name="v", size=size, fov_degrees=fov), 4, light.color())


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("material", ["mirror", "black", "rough"])
def test_lights(light, material):
    check(rendered(scene_of(MATERIALS[material]), LIGHTS[light]))


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("brdf", ["gltf", pytest.param("paper", marks=pytest.mark.slow)])
def test_materials(material, brdf):
    images = rendered(scene_of(MATERIALS[material]), LIGHTS["studio"], brdf=brdf, fov=None)
    check(images)
    check(rendered(scene_of(MATERIALS[material]), LIGHTS["studio"], brdf=brdf, fov=None, shadows=False))


@pytest.mark.parametrize("material", ["mirror", "rough", "dense glass", "normal map from behind"])
def test_closed_form_of_the_same(material):
    renderer, camera = Renderer(scene_of(MATERIALS[material]), 1), camera_at(20.0, 10.0, name="v", size=32)
    frame = renderer.buffers(camera, 4)
    axes = torch.nn.functional.normalize(torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 1, 1]]), dim=1)
    for sharpness, amplitude in ((0.0, 1.0), (1e10, 1e9), (3e38, 1.0), (1e-8, 0.0)):
        lobes = SphericalGaussians(axes, torch.full((3,), sharpness), torch.full((3, 3), amplitude))
        for brdf in ("gltf", "paper"):
            image = closed_form_image(frame, camera, lobes, brdf)
            assert np.isfinite(image).all()
            assert image.min() >= 0


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1.0, 1e3, 1e6])
def test_the_scale_of_the_file_does_not_matter(scale):
    images, plain = rendered(scene_of(scale=scale), LIGHTS["studio"]), rendered(scene_of(), LIGHTS["studio"])
    check(images)
    inside = (images["mask"] == 1) & (plain["mask"] == 1)
    assert inside.sum() > 20
    assert np.abs(images["depth"] - plain["depth"])[inside].max() < 1e-4
    # Rounding moves rays over edges of faces, a few at most.
    assert np.median(np.abs(images["color"] - plain["color"])[inside]) < 1e-4


def test_a_scene_without_area_is_not_seen():
    point = Scene(vertices=np.zeros((3, 3)), faces=np.array([[0, 1, 2]], np.int32), materials=(SHINY,))
    images = rendered(point, LIGHTS["studio"])
    assert not images["mask"].any()
    assert all(np.isfinite(x).all() and not x.any() for x in images.values())


def test_a_camera_inside_the_object():
    scene = scene_of(MATERIALS["rough"])
    small = dataclasses.replace(scene, vertices=scene.vertices * 20)
    check(rendered(small, LIGHTS["studio"]))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(40))
def test_random_triangles_and_materials(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(3, 60))
    vertices = rng.normal(size=(count, 3)) * 10.0 ** rng.integers(-6, 7)
    vertices = transform_points(invert_similarity(unit_box(vertices)), vertices)
    faces = rng.integers(0, count, (int(rng.integers(8, 80)), 3)).astype(np.int32)
    names = list(MATERIALS)
    scene = Scene(
        vertices=vertices,
        faces=faces,
        materials=tuple(MATERIALS.values()),
        material_idx=rng.integers(0, len(names), len(faces)).astype(np.int32),
        normals=rng.normal(size=(count, 3)) * rng.integers(0, 2, (count, 1)),
        uvs=(rng.normal(size=(count, 2)) * 1e3,),
        colors=rng.random((count, 4)),
    )
    for light in LIGHTS.values():
        images = rendered(scene, light, brdf=("gltf", "paper")[seed % 2], size=32)
        for name, image in images.items():
            assert np.isfinite(image).all(), name
            assert name == "normal" or image.min() >= 0, name


def test_shade_does_not_leave_float32_between_a_white_metal_and_the_brightest_light():
    value = shade(
        torch.tensor([0.0, 0, 1]),
        torch.tensor([0.0, 0, 1]),
        torch.ones(3),
        torch.tensor(0.0),
        torch.tensor(1.0),
        SphericalGaussians(torch.tensor([[0.0, 0, 1]]), torch.tensor([250.0]), torch.full((1, 3), 1e30)),
    )
    assert torch.isfinite(value).all()
