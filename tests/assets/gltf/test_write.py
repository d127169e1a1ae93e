"""Write scenes as GLB."""

import json
import os
import shutil
import struct
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gdtool.assets.gltf.read import read_gltf
from gdtool.assets.gltf.write import glb_bytes, write_glb
from gdtool.assets.scene import Material, Scene, Texture
from gdtool.core.errors import OutputError

TOOLS = Path(__file__).parents[2] / "tools"


def pixels(channels: int, seed: int = 0) -> np.ndarray:
    """Make a random image of 8 x 8 pixels."""
    return np.random.default_rng(seed).integers(0, 256, (8, 8, channels), np.uint8)


def full_scene() -> Scene:
    """Make two squares with two materials that use everything a Scene can hold."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    vertices = np.concatenate([corners, corners + (2, 0, 0)])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    orm = pixels(3, 1)
    painted = Material(
        name="painted",
        base_color=(0.5, 0.25, 1, 0.75),
        metallic=0.125,
        roughness=0.5,
        emissive=(3, 1.5, 0),
        alpha_mode="MASK",
        alpha_cutoff=0.25,
        double_sided=True,
        ior=1.25,
        specular=0.5,
        normal_scale=0.5,
        occlusion_strength=0.25,
        base_color_texture=Texture(
            pixels(4),
            "srgb",
            offset=(0.5, 0),
            rotation=0.25,
            scale=(2, 1),
            wrap_u="mirror",
            wrap_v="clamp",
            filter="nearest",
        ),
        metallic_roughness_texture=Texture(orm),
        occlusion_texture=Texture(orm),
        normal_texture=Texture(pixels(3, 2)),
        emissive_texture=Texture(pixels(3, 3), "srgb", uv_set=2),
    )
    plain = Material(name="plain", base_color=(0.25, 0.5, 0.75, 1), metallic=0.0, roughness=1.0)
    return Scene(
        vertices,
        faces,
        (painted, Material(name="never used"), plain),
        np.array([0, 0, 2, 2], np.int32),
        normals=np.tile([0, 0, 1.0], (8, 1)),
        tangents=np.tile([1, 0, 0, -1.0], (8, 1)),
        uvs=(vertices[:, :2] / 3, None, vertices[:, 1::-1] / 3),
        colors=np.random.default_rng(4).random((8, 4)),
        name="both",
    )


def document_of(content: bytes) -> dict:
    """Decode the JSON of a GLB."""
    length = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + length])


def test_a_written_scene_is_read_back(tmp_path):
    scene = full_scene()
    write_glb(tmp_path / "both.glb", scene)
    back = read_gltf(tmp_path / "both.glb")
    corner, read_back = scene.faces.ravel(), back.faces.ravel()
    np.testing.assert_allclose(back.vertices[read_back], scene.vertices[corner])
    np.testing.assert_allclose(back.normals[read_back], scene.normals[corner])
    np.testing.assert_allclose(
        back.tangents[back.faces[:2]].reshape(-1, 4), scene.tangents[scene.faces[:2]].reshape(-1, 4)
    )
    np.testing.assert_allclose(back.colors[read_back], scene.colors[corner], atol=1e-7)
    np.testing.assert_allclose(back.uvs[0][read_back], scene.uvs[0][corner], atol=1e-7)
    np.testing.assert_allclose(
        back.uvs[1][read_back], scene.uvs[2][corner], atol=1e-7
    )  # sets are numbered without gaps
    painted, plain = back.materials
    assert plain == scene.materials[2]
    for name in (
        "base_color",
        "metallic",
        "roughness",
        "emissive",
        "alpha_mode",
        "alpha_cutoff",
        "double_sided",
        "ior",
        "specular",
        "normal_scale",
        "occlusion_strength",
    ):
        assert getattr(painted, name) == getattr(scene.materials[0], name), name
    for name in (
        "base_color_texture",
        "metallic_roughness_texture",
        "occlusion_texture",
        "normal_texture",
        "emissive_texture",
    ):
        written, read = getattr(scene.materials[0], name), getattr(painted, name)
        np.testing.assert_array_equal(read.image, written.image)
        assert replace(read, image=0, uv_set=0) == replace(written, image=0, uv_set=0)
    assert painted.emissive_texture.uv_set == 1


def test_the_same_scene_gives_the_same_bytes():
    assert glb_bytes(full_scene()) == glb_bytes(full_scene())


def test_factors_are_always_written_and_shared_maps_once():
    document = document_of(glb_bytes(full_scene(), extras={"by": "a test"}))
    for material in document["materials"]:
        assert {"metallicFactor", "roughnessFactor", "baseColorFactor"} <= material["pbrMetallicRoughness"].keys()
    assert len(document["images"]) == 4  # five textures, two of them the same array
    first = document["materials"][0]
    assert first["occlusionTexture"]["index"] == first["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]
    assert document["asset"]["extras"] == {"by": "a test"}
    assert set(document["extensionsUsed"]) == {
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_specular",
        "KHR_texture_transform",
    }


def test_colour_textures_are_stored_as_srgb_once():
    linear = np.full((2, 2, 4), 0.5)
    scene = replace(full_scene(), materials=(Material(base_color_texture=Texture(linear, "linear")),) * 3)
    back = document_of(glb_bytes(scene))
    assert len(back["images"]) == 1
    from gdtool.images.io import decode_image

    content = glb_bytes(scene)
    view = back["bufferViews"][back["images"][0]["bufferView"]]
    start = 12 + 8 + struct.unpack_from("<I", content, 12)[0] + 8 + view["byteOffset"]
    np.testing.assert_array_equal(
        decode_image(content[start : start + view["byteLength"]], "map")[0, 0], [188, 188, 188, 128]
    )


def test_tangents_are_computed_for_normal_maps(tmp_path):
    scene = replace(full_scene(), tangents=None)
    write_glb(tmp_path / "a.glb", scene)
    back = read_gltf(tmp_path / "a.glb")
    corner = back.tangents[back.faces[:2]].reshape(-1, 4)
    np.testing.assert_allclose(corner[:, :3], [[1, 0, 0]] * 6, atol=1e-6)
    # v grows with y here, while textures count v downward: the bitangent points down the picture's rows
    np.testing.assert_allclose(corner[:, 3], -1)


def test_a_zero_normal_is_replaced(tmp_path):
    scene = full_scene()
    normals = scene.normals.copy()
    normals[0] = 0
    write_glb(tmp_path / "a.glb", replace(scene, normals=normals))
    np.testing.assert_allclose(np.linalg.norm(read_gltf(tmp_path / "a.glb").normals, axis=1), 1)


def test_more_than_65535_vertices_take_32_bit_indices(tmp_path):
    side = 300
    y, x = np.mgrid[:side, :side]
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(float)
    idx = np.arange(side * side).reshape(side, side)
    faces = np.stack([idx[:-1, :-1], idx[:-1, 1:], idx[1:, 1:]], -1).reshape(-1, 3).astype(np.int32)
    write_glb(tmp_path / "a.glb", Scene(vertices, faces))
    back = read_gltf(tmp_path / "a.glb")
    np.testing.assert_allclose(back.vertices[back.faces], vertices[faces])


@pytest.mark.parametrize(
    "broken",
    [
        {"vertices": np.full((8, 3), np.nan)},
        {"faces": np.array([[0, 1, 8]], np.int32)},
        {"faces": np.zeros((0, 3), np.int32)},
        {"colors": np.full((8, 4), np.inf)},
    ],
)
def test_invalid_scenes_are_refused_and_write_nothing(tmp_path, broken):
    with pytest.raises(ValueError):
        write_glb(tmp_path / "a.glb", replace(full_scene(), **broken))
    assert not (tmp_path / "a.glb").exists()


def test_a_path_that_cannot_be_written_is_an_output_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        write_glb(tmp_path / "file" / "a.glb", full_scene())


def validator_path() -> str | None:
    """Find the NODE_PATH under which gltf-validator is installed; None without it."""
    places = [
        TOOLS / "node_modules",
        TOOLS.parents[1] / "node_modules",
        *(Path(p) for p in os.environ.get("NODE_PATH", "").split(":") if p),
    ]
    return next((str(place) for place in places if (place / "gltf-validator").is_dir()), None)


@pytest.mark.skipif(
    shutil.which("node") is None or validator_path() is None,
    reason="needs node and the npm package gltf-validator (npm install in tests/tools)",
)
@pytest.mark.parametrize("tangents", [True, False])
def test_the_khronos_validator_finds_no_error_or_warning(tmp_path, tangents):
    scene = full_scene() if tangents else replace(full_scene(), tangents=None)
    write_glb(tmp_path / "a.glb", scene)
    done = subprocess.run(
        ["node", TOOLS / "validate_gltf.mjs", tmp_path / "a.glb"],
        capture_output=True,
        text=True,
        env={**os.environ, "NODE_PATH": validator_path()},
    )
    report = json.loads(done.stdout)
    serious = [m for m in report["messages"] if m["severity"] < 2]
    assert done.returncode == 0
    assert serious == []
