"""Render glTF files: texture transforms, UV sets, vertex colours, both sides, index of refraction, specular."""

from __future__ import annotations

import numpy as np
import pytest

from gdtool.assets.gltf.read import read_gltf
from gdtool.cameras import camera_at
from gdtool.core.errors import InputError
from gdtool.shading.lights.environment import Environment
from gdtool.shading.render.direct import DirectLight, LightOptions
from gdtool.shading.render.render import Renderer, render_buffers
from gdtool.shading.render.surface_points import surface_attributes
from tests.assets.gltf.files import QUAD, QUAD_FACES, Builder, quad, with_textures

CORNER = np.array([0]), np.array([[1.0, 0.0, 0.0]])
PIXELS = np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3) * 5


def textured(tmp_path, uv, info, **material):
    """Look up the base colour of a quad whose corners all have the given coordinates, one pair for each UV set."""
    builder = with_textures(color=PIXELS)
    builder.document["extensionsUsed"] = ["KHR_texture_transform"]
    builder.document["samplers"] = [{"magFilter": 9728, "minFilter": 9728}]
    builder.document["textures"][0]["sampler"] = 0
    builder.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **info}}, **material}]
    attributes = builder.document["meshes"][0]["primitives"][0]["attributes"]
    for k, at in enumerate(uv):
        attributes[f"TEXCOORD_{k}"] = builder.add(np.tile(np.float32(at), (4, 1)))
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    return surface_attributes(scene, *CORNER)["albedo"][0]


def texel(row: int, column: int) -> np.ndarray:
    """Return a texel of PIXELS as linear colour."""
    from gdtool.images.color import linear_from_srgb

    return linear_from_srgb(PIXELS[row, column])


@pytest.mark.parametrize(
    "transform, at",
    [
        ({"offset": [0.25, 0.5]}, (2, 1)),
        ({"scale": [3, 1]}, (0, 1)),
        # The specification's matrix: u' = u cos + v sin, v' = v cos − u sin; (1/8, 1/8) turned by 90° is (1/8, −1/8),
        # the last row.
        ({"rotation": np.pi / 2}, (3, 0)),
        ({"offset": [0.5, 0], "rotation": -np.pi / 2, "scale": [1, 3]}, (0, 0)),
    ],
)
def test_texture_transforms_move_the_lookup(tmp_path, transform, at):
    albedo = textured(tmp_path, [(0.125, 0.125)], {"extensions": {"KHR_texture_transform": transform}})
    np.testing.assert_allclose(albedo, texel(*at), atol=1e-6)


def test_a_texture_uses_the_uv_set_of_its_field_or_extension(tmp_path):
    sets = [(0.125, 0.125), (0.625, 0.875)]
    np.testing.assert_allclose(textured(tmp_path, sets, {"texCoord": 1}), texel(3, 2), atol=1e-6)
    # The extension's texCoord overrides the field's.
    info = {"texCoord": 0, "extensions": {"KHR_texture_transform": {"texCoord": 1}}}
    np.testing.assert_allclose(textured(tmp_path, sets, info), texel(3, 2), atol=1e-6)


def test_vertex_colours_multiply_the_base_color(tmp_path):
    builder = quad(pbrMetallicRoughness={"baseColorFactor": [0.5, 1, 0.25, 1]})
    colors = np.tile(np.float32([0.5, 0.25, 1, 1]), (4, 1))
    builder.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = builder.add(colors)
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(surface_attributes(scene, *CORNER)["albedo"][0], [0.25, 0.25, 0.25], atol=1e-6)


@pytest.mark.parametrize("double_sided", [False, True])
def test_both_sides_are_rendered_with_normals_toward_the_camera(tmp_path, double_sided):
    assert QUAD.shape == (4, 3)
    assert len(QUAD_FACES) == 6
    scene = read_gltf(quad(doubleSided=double_sided).write(tmp_path / "a.glb"))
    for azimuth, z in ((0.0, 1.0), (180.0, -1.0)):
        out = render_buffers(scene, camera_at(azimuth, 0.0, name="v", size=32), 4)
        assert out["mask"].max() == 1
        np.testing.assert_allclose(out["normal"][out["mask"] == 1].mean(0), [0, 0, z], atol=1e-5)


def test_ior_and_specular_set_the_reflectance_at_normal_incidence(tmp_path):
    builder = quad(extensions={"KHR_materials_ior": {"ior": 2.0}, "KHR_materials_specular": {"specularFactor": 0.5}})
    builder.document["extensionsUsed"] = ["KHR_materials_ior", "KHR_materials_specular"]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    out = surface_attributes(scene, *CORNER)
    assert float(out["f0"][0]) == pytest.approx(0.5 * (1 / 3) ** 2)
    assert float(out["f90"][0]) == 0.5


def rendered(scene, *, azimuth=0.0, elevation=0.0, size=32, light=1.0, samples=16) -> dict[str, np.ndarray]:
    """Render a view of a scene under a uniform light, without shadows."""
    renderer = Renderer(scene, 1)
    direct = DirectLight(
        renderer,
        Environment(np.full((8, 16, 3), light, np.float32), "uniform"),
        samples,
        0,
        options=LightOptions(shadows=False),
    )
    return renderer.buffers(camera_at(azimuth, elevation, name="v", size=size), 4, direct.color())


def centred(builder) -> object:
    """Build the quad centred at the origin."""
    builder.document["nodes"] = [{"mesh": 0, "translation": [-0.5, -0.5, 0]}]
    return builder


@pytest.mark.parametrize("azimuth", [0.0, 80.0])
def test_specular_zero_reflects_nothing_also_at_grazing_angles(tmp_path, azimuth):
    """specularFactor scales f90 too: at 0 a white surface is a Lambert surface, 1 under uniform light at any angle."""
    material = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 0.3}}
    brightness = []
    for specular in (0.0, 1.0):
        builder = centred(quad(**material, extensions={"KHR_materials_specular": {"specularFactor": specular}}))
        builder.document["extensionsUsed"] = ["KHR_materials_specular"]
        images = rendered(read_gltf(builder.write(tmp_path / "a.glb")), azimuth=azimuth, samples=64)
        brightness.append(images["color"][images["mask"] == 1].mean())
    assert brightness[0] == pytest.approx(1.0, abs=5e-3)
    if azimuth:
        assert brightness[1] > brightness[0] + 0.05  # the model is not energy-conserving at grazing angles


def test_an_unlit_material_shows_its_base_color_under_any_light(tmp_path):
    builder = centred(
        quad(pbrMetallicRoughness={"baseColorFactor": [0.25, 0.5, 1, 1]}, extensions={"KHR_materials_unlit": {}})
    )
    builder.document["extensionsUsed"] = ["KHR_materials_unlit"]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    for light in (0.0, 7.0):
        images = rendered(scene, light=light)
        np.testing.assert_allclose(
            images["color"][images["mask"] == 1],
            np.broadcast_to([0.25, 0.5, 1], ((images["mask"] == 1).sum(), 3)),
            atol=1e-6,
        )


def test_emission_is_factor_times_texture_times_strength(tmp_path):
    builder = with_textures(glow=np.full((2, 2, 3), 188, np.uint8))  # sRGB 188 is 0.503 linear
    builder.document["extensionsUsed"] = ["KHR_materials_emissive_strength"]
    builder.document["materials"] = [
        {
            "emissiveFactor": [1, 0.5, 0],
            "emissiveTexture": {"index": 0},
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}},
            "pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]},
        }
    ]
    images = rendered(read_gltf(centred(builder).write(tmp_path / "a.glb")), light=0.0)
    linear = ((188 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(images["color"][images["mask"] == 1].mean(0), [4 * linear, 2 * linear, 0], rtol=1e-4)


@pytest.mark.parametrize(
    "mode, alpha, visible",
    [("OPAQUE", 0.1, 1), ("MASK", 0.3, 1), ("MASK", 0.2, 0), ("BLEND", 0.6, 1), ("BLEND", 0.4, 0)],
)
def test_alpha_of_factor_texture_and_vertices_multiplies(tmp_path, mode, alpha, visible):
    """MASK is visible from its cutoff of 0.25 on, BLEND from 0.5 on. Alpha is never decoded as sRGB."""
    pixels = np.full((2, 2, 4), 255, np.uint8)
    pixels[..., 3] = 204  # 0.8
    builder = with_textures(color=pixels)
    builder.document["materials"] = [
        {
            "alphaMode": mode,
            **({"alphaCutoff": 0.25} if mode == "MASK" else {}),
            "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, alpha / 0.4], "baseColorTexture": {"index": 0}},
        }
    ]
    if alpha / 0.4 > 1:
        builder.document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"][3] = 1
    vertex = np.tile(np.float32([1, 1, 1, 0.5 if alpha / 0.4 <= 1 else alpha / 0.8]), (4, 1))
    builder.document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = builder.add(vertex)
    scene = read_gltf(centred(builder).write(tmp_path / "a.glb"))
    if mode != "OPAQUE":
        assert float(surface_attributes(scene, *CORNER)["alpha"][0]) == pytest.approx(alpha, abs=1e-6)
    assert render_buffers(scene, camera_at(0.0, 0.0, name="v", size=32), 4)["mask"].max() == visible


@pytest.mark.parametrize("wrap, at", [(10497, 1), (33071, 3), (33648, 2)])
@pytest.mark.parametrize("axis", [0, 1])
def test_samplers_wrap_each_axis_by_its_own_mode(tmp_path, wrap, at, axis):
    """At 1.375 of a row of four texels: repeating reads texel 1, clamping texel 3, mirroring texel 2."""
    builder = with_textures(color=PIXELS)
    builder.document["samplers"] = [{"magFilter": 9728, "wrapS" if axis == 0 else "wrapT": wrap}]
    builder.document["textures"][0]["sampler"] = 0
    builder.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    place = [0.125, 0.125]
    place[axis] = 1.375
    builder.document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = builder.add(
        np.tile(np.float32(place), (4, 1))
    )
    albedo = surface_attributes(read_gltf(builder.write(tmp_path / "a.glb")), *CORNER)["albedo"][0]
    np.testing.assert_allclose(albedo, texel(*((0, at) if axis == 0 else (at, 0))), atol=1e-6)


def test_filters_blend_linear_values_or_take_the_nearest_texel(tmp_path):
    """Look up a quarter of the way from a black to a white texel: linear filtering blends in linear light."""
    pixels = np.zeros((1, 2, 3), np.uint8)
    pixels[0, 1] = 255
    values = {}
    for name, code in (("nearest", 9728), ("linear", 9729)):
        builder = with_textures(color=pixels)
        builder.document["samplers"] = [{"magFilter": code, "wrapS": 33071}]
        builder.document["textures"][0]["sampler"] = 0
        builder.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        builder.document["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"] = builder.add(
            np.tile(np.float32([0.375, 0.5]), (4, 1))
        )
        values[name] = float(surface_attributes(read_gltf(builder.write(tmp_path / "a.glb")), *CORNER)["albedo"][0, 0])
    assert values == {"nearest": 0.0, "linear": pytest.approx(0.25, abs=1e-6)}


def test_small_renders_read_coarser_mip_levels_of_odd_sizes(tmp_path):
    """Render a fine chequerboard, dozens of texels a sample: its coarser levels are grey, the finest black or white."""
    checker = (np.indices((301, 299)).sum(0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, 2)
    builder = with_textures(color=checker)
    builder.document["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    images = render_buffers(
        read_gltf(centred(builder).write(tmp_path / "a.glb")), camera_at(0.0, 0.0, name="v", size=16), 4
    )
    inside = images["albedo"][images["mask"] == 1]
    assert len(inside) > 80
    assert np.abs(inside - 0.5).max() < 0.02


def test_every_attribute_may_be_quantised(tmp_path):
    """KHR_mesh_quantization allows bytes and shorts, normalised or not; a node's scale undoes that of the positions."""
    plain = read_gltf(quad(name="m").write(tmp_path / "a.glb"))
    builder = Builder()
    builder.document |= {
        "extensionsUsed": ["KHR_mesh_quantization", "KHR_texture_transform"],
        "extensionsRequired": ["KHR_mesh_quantization"],
    }
    attributes = {
        "POSITION": builder.add((QUAD * 1000).astype(np.uint16)),
        "NORMAL": builder.add(np.tile(np.int8([0, 0, 127]), (4, 1)), normalized=True),
        "TANGENT": builder.add(np.tile(np.int16([32767, 0, 0, -32767]), (4, 1)), normalized=True),
        "TEXCOORD_0": builder.add(np.rint((QUAD[:, :2] * (1, -1) + (0, 1)) * 65535).astype(np.uint16), normalized=True),
        "TEXCOORD_1": builder.add((QUAD[:, :2] * 100).astype(np.int8)),
    }
    builder.primitive(attributes, builder.add(QUAD_FACES.astype(np.uint8)))
    builder.document["nodes"] = [{"mesh": 0, "scale": [1e-3, 1e-3, 1e-3]}]
    scene = read_gltf(builder.write(tmp_path / "b.glb"))
    np.testing.assert_allclose(scene.vertices, plain.vertices, atol=1e-9)
    np.testing.assert_allclose(scene.normals, plain.normals, atol=1e-6)
    np.testing.assert_allclose(scene.uvs[0], plain.uvs[0], atol=1e-5)
    np.testing.assert_allclose(scene.uvs[1], QUAD[:, :2] * 100)
    np.testing.assert_allclose(scene.tangents, np.tile([1.0, 0, 0, -1], (4, 1)), atol=1e-6)
    np.testing.assert_array_equal(scene.faces, plain.faces)


def test_unknown_optional_extensions_are_noted_and_required_ones_refused(tmp_path):
    names = ["KHR_materials_transmission", "MY_own_thing"]
    builder = quad()
    builder.document["extensionsUsed"] = names
    notes = read_gltf(builder.write(tmp_path / "a.glb")).notes
    assert all(any(name in note and "ignored" in note for note in notes) for name in names)
    for name in names:
        builder.document["extensionsRequired"] = [name]
        with pytest.raises(InputError, match=name):
            read_gltf(builder.write(tmp_path / "b.glb"))
