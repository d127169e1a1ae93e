"""Read materials of glTF files: factors, textures, extensions."""

import numpy as np

from gdtool.assets.gltf.read import read_gltf
from tests.assets.gltf.files import quad, with_textures


def test_every_material_property_is_read(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (4, 4, 4), np.uint8)
    builder = with_textures(color=pixels, orm=pixels[..., :3], grey=pixels[..., :1])
    builder.document["extensionsUsed"] = [
        "KHR_texture_transform",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_specular",
        "KHR_materials_unlit",
        "KHR_materials_clearcoat",
    ]
    builder.document["samplers"] = [{"magFilter": 9728, "wrapS": 33071, "wrapT": 33648}]
    builder.document["textures"][0]["sampler"] = 0
    builder.document["materials"] = [
        {
            "name": "all",
            "alphaMode": "MASK",
            "alphaCutoff": 0.25,
            "doubleSided": True,
            "emissiveFactor": [1, 0.5, 0],
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.1, 0.2, 0.3, 0.4],
                "metallicFactor": 0.5,
                "roughnessFactor": 0.25,
                "baseColorTexture": {
                    "index": 0,
                    "extensions": {
                        "KHR_texture_transform": {
                            "offset": [0.5, 0.25],
                            "rotation": 1.5,
                            "scale": [2, 3],
                            "texCoord": 0,
                        }
                    },
                },
                "metallicRoughnessTexture": {"index": 1},
            },
            "normalTexture": {"index": 2, "scale": 0.5},
            "occlusionTexture": {"index": 1, "strength": 0.75},
            "emissiveTexture": {"index": 2},
            "extensions": {
                "KHR_materials_emissive_strength": {"emissiveStrength": 4},
                "KHR_materials_ior": {"ior": 1.3},
                "KHR_materials_specular": {"specularFactor": 0.5},
                "KHR_materials_unlit": {},
                "KHR_materials_clearcoat": {"clearcoatFactor": 1},
            },
        }
    ]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    m = scene.materials[0]
    assert (m.name, m.base_color, m.metallic, m.roughness) == ("all", (0.1, 0.2, 0.3, 0.4), 0.5, 0.25)
    assert (m.alpha_mode, m.alpha_cutoff, m.double_sided, m.unlit, m.ior, m.specular) == (
        "MASK",
        0.25,
        True,
        True,
        1.3,
        0.5,
    )
    assert m.emissive == (4, 2, 0)
    assert m.normal_scale == 0.5
    assert m.occlusion_strength == 0.75
    t = m.base_color_texture
    assert (t.encoding, t.offset, t.rotation, t.scale) == ("srgb", (0.5, 0.25), 1.5, (2, 3))
    assert (t.wrap_u, t.wrap_v, t.filter) == ("clamp", "mirror", "nearest")
    np.testing.assert_array_equal(t.image, pixels)
    assert m.metallic_roughness_texture.encoding == "linear"
    assert m.metallic_roughness_texture.wrap_u == "repeat"
    assert m.occlusion_texture.image is m.metallic_roughness_texture.image
    # Grey is grey in all colours.
    np.testing.assert_array_equal(m.normal_texture.image, np.repeat(pixels[..., :1], 3, -1))
    assert any("KHR_materials_clearcoat" in note for note in scene.notes)


def test_an_empty_material_has_the_defaults_of_the_format(tmp_path):
    m = read_gltf(quad(name="bare").write(tmp_path / "a.glb")).materials[0]
    assert (m.base_color, m.metallic, m.roughness, m.alpha_mode, m.double_sided) == (
        (1, 1, 1, 1),
        1,
        1,
        "OPAQUE",
        False,
    )


def test_specular_glossiness_factors_become_the_same_dielectric_or_metal(tmp_path):
    builder = quad(
        extensions={
            "KHR_materials_pbrSpecularGlossiness": {
                "diffuseFactor": [0.5, 0.25, 0.1, 1],
                "specularFactor": [0.04, 0.04, 0.04],
                "glossinessFactor": 0.7,
            }
        }
    )
    dielectric = read_gltf(builder.write(tmp_path / "a.glb")).materials[0]
    np.testing.assert_allclose(dielectric.base_color, [0.5, 0.25, 0.1, 1])
    np.testing.assert_allclose([dielectric.metallic, dielectric.roughness], [0, 0.3])
    builder.document["materials"][0]["extensions"]["KHR_materials_pbrSpecularGlossiness"] = {
        "diffuseFactor": [0, 0, 0, 1],
        "specularFactor": [0.9, 0.6, 0.3],
        "glossinessFactor": 0.5,
    }
    metal = read_gltf(builder.write(tmp_path / "a.glb")).materials[0]
    np.testing.assert_allclose(metal.base_color[:3], [0.9, 0.6, 0.3], atol=0.01)
    np.testing.assert_allclose([metal.metallic, metal.roughness], [1, 0.5], atol=0.01)


def test_specular_glossiness_maps_are_converted_pixel_by_pixel(tmp_path):
    diffuse = np.zeros((2, 2, 4), np.uint8)
    diffuse[0] = (188, 120, 60, 255)
    diffuse[1] = (0, 0, 0, 255)
    gloss = np.zeros((4, 4, 4), np.uint8)
    gloss[:2] = (57, 57, 57, 255)  # 0.04 in sRGB, full gloss
    gloss[2:] = (230, 200, 150, 51)
    builder = with_textures(diffuse=diffuse, gloss=gloss)
    builder.document["materials"][0]["extensions"] = {
        "KHR_materials_pbrSpecularGlossiness": {
            "diffuseTexture": {"index": 0},
            "specularGlossinessTexture": {"index": 1},
        }
    }
    m = read_gltf(builder.write(tmp_path / "a.glb")).materials[0]
    color, surface = m.base_color_texture.image.astype(int), m.metallic_roughness_texture.image.astype(int)
    assert color.shape == (4, 4, 4)
    np.testing.assert_allclose(color[0, 0], [188, 120, 60, 255], atol=2)
    np.testing.assert_allclose(color[3, 0], [230, 200, 150, 255], atol=3)
    np.testing.assert_allclose(surface[0, 0, 1:], [0, 0], atol=3)
    np.testing.assert_allclose(surface[3, 0, 1:], [204, 255], atol=3)
