"""What glTF's fields mean once a file is looked up: transforms, second UV set, vertex colours, both sides, ior and specular."""

from __future__ import annotations

import numpy as np
import pytest

from gdtool.assets.gltf_read import read_gltf
from gdtool.cameras import camera_at
from gdtool.shading.render import render_buffers
from gdtool.shading.surface_points import surface_attributes
from tests.assets.gltf_files import QUAD, QUAD_FACES, quad
from tests.assets.test_gltf_read import with_textures

CORNER = np.array([0]), np.array([[1.0, 0.0, 0.0]])
PIXELS = np.arange(4 * 4 * 3, dtype=np.uint8).reshape(4, 4, 3) * 5


def textured(tmp_path, uv, info, **material):
    """A quad all of whose corners have one place on a nearest-filtered picture of known texels, in both UV sets."""
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
    from gdtool.images.color import linear_from_srgb

    return linear_from_srgb(PIXELS[row, column])


@pytest.mark.parametrize("transform, at", [
    ({"offset": [0.25, 0.5]}, (2, 1)), ({"scale": [3, 1]}, (0, 1)),
    # The specification's matrix: u' = u cos + v sin, v' = v cos − u sin; (1/8, 1/8) turned by 90° is (1/8, −1/8), the last row.
    ({"rotation": np.pi / 2}, (3, 0)), ({"offset": [0.5, 0], "rotation": -np.pi / 2, "scale": [1, 3]}, (0, 0)),
])
def test_texture_transforms_place_the_lookup(tmp_path, transform, at):
    got = textured(tmp_path, [(0.125, 0.125)], {"extensions": {"KHR_texture_transform": transform}})
    np.testing.assert_allclose(got, texel(*at), atol=1e-6)


def test_the_second_uv_set_by_the_field_and_by_the_extension(tmp_path):
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
def test_both_sides_are_seen_with_normals_toward_the_eye(tmp_path, double_sided):
    assert QUAD.shape == (4, 3) and len(QUAD_FACES) == 6
    scene = read_gltf(quad(doubleSided=double_sided).write(tmp_path / "a.glb"))
    for azimuth, z in ((0.0, 1.0), (180.0, -1.0)):
        out = render_buffers(scene, camera_at(azimuth, 0.0, name="v", size=32), 4)
        assert out["mask"].max() == 1
        np.testing.assert_allclose(out["normal"][out["mask"] == 1].mean(0), [0, 0, z], atol=1e-5)


def test_ior_and_specular_set_the_reflectance_at_normal_incidence(tmp_path):
    builder = quad(extensions={"KHR_materials_ior": {"ior": 2.0}, "KHR_materials_specular": {"specularFactor": 0.5}})
    builder.document["extensionsUsed"] = ["KHR_materials_ior", "KHR_materials_specular"]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    assert float(surface_attributes(scene, *CORNER)["f0"][0]) == pytest.approx(0.5 * (1 / 3) ** 2)
