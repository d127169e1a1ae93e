"""Bake meshes that are hard: thin walls, mirrored and missing texture area, one face, tiny and huge coordinates."""

import json
from pathlib import Path

import numpy as np
import pytest

from gdtool.assets.gltf.write import write_glb
from gdtool.assets.scene import Material, Scene, Texture
from gdtool.core.folder import open_folder
from gdtool.folders.mesh import write_obj
from gdtool.geometry.meshes import QuadMesh
from gdtool.images.io import read_image

FAST = ("--size", 64, "--ao-rays", 4)


def slab(thickness=0.001):
    """Make a closed plate, 1 x 1 x thickness: vertices (8, 3), quads (6, 4), a texture rectangle for each quad."""
    x = np.array([-0.5, 0.5])
    vertices = np.array([[a, b, c] for a in x for b in x for c in x * thickness])
    # Front and back first.
    quads = np.array([[1, 5, 7, 3], [0, 2, 6, 4], [4, 6, 7, 5], [0, 1, 3, 2], [2, 3, 7, 6], [0, 4, 5, 1]])
    corner = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])
    uv = np.concatenate([(corner * 0.8 + 0.1 + (k % 3, k // 3)) / 3 for k in range(6)])
    return vertices, quads, uv, np.arange(24).reshape(6, 4)


def colored(vertices, quads, uv, corners, colors):
    """Make a Scene whose quads have the texture colors (6, 3), 8 bits, in their rectangles."""
    image = np.zeros((48, 48, 3), np.uint8)
    for k, color in enumerate(colors):
        image[k // 3 * 16 : k // 3 * 16 + 16, k % 3 * 16 : k % 3 * 16 + 16] = color
    flat = vertices[quads].reshape(-1, 3)
    faces = np.stack([corners[:, :3], corners[:, [0, 2, 3]]], 1).reshape(-1, 3)
    return Scene(
        flat, faces.astype(np.int32), (Material(base_color_texture=Texture(image, "srgb"), metallic=0.0),), uvs=(uv,)
    )


RED, BLUE, GRAY = (200, 30, 30), (30, 30, 200), (90, 90, 90)
COLORS = (RED, BLUE, GRAY, GRAY, GRAY, GRAY)


def bake(gdtool, mesh, scene, *options):
    """Bake, and return the asset's base color (s, s, 3) and manifest content."""
    write_obj(Path("low.obj"), mesh)
    write_glb(Path("high.glb"), scene)
    done = gdtool("bake", "low.obj", "--model", "high.glb", *(options or FAST), "-o", "out")
    assert done.returncode == 0, done.stderr
    assert gdtool("validate", "out").returncode == 0
    folder = open_folder(Path("out"))
    return read_image(folder.path / "base_color.png"), folder, done


def middle(image, k):
    """Return the texel in the middle of the k-th rectangle."""
    size = len(image)
    return image[int((k // 3 + 0.5) / 3 * size), int((k % 3 + 0.5) / 3 * size)]


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_thin_walls_keep_their_sides_at_any_scale(gdtool, scale):
    vertices, quads, uv, corners = slab()
    far = np.array([3.0, -2.0, 7.0]) * scale  # not about the origin
    image, _, _ = bake(
        gdtool,
        QuadMesh(vertices * scale + far, quads, uv, corners),
        colored(vertices * scale + far, quads, uv, corners, COLORS),
    )
    np.testing.assert_allclose(middle(image, 0), RED, atol=1)
    np.testing.assert_allclose(middle(image, 1), BLUE, atol=1)


def test_mirrored_texture_coordinates_bake_the_same_picture_the_other_way_round(gdtool):
    vertices, quads, uv, corners = slab(0.3)
    scene = colored(vertices, quads, uv, corners, COLORS)
    plain, _, _ = bake(gdtool, QuadMesh(vertices, quads, uv, corners), scene, *FAST, "--no-ao")
    mirrored, folder, _ = bake(
        gdtool, QuadMesh(vertices, quads, uv * (-1, 1) + (1, 0), corners), scene, *FAST, "--no-ao"
    )
    np.testing.assert_allclose(mirrored[:, ::-1].astype(int), plain, atol=1)
    assert folder.manifest.warnings == ()


def test_faces_without_area_in_the_map_leave_the_others_whole(gdtool):
    vertices, quads, uv, corners = slab(0.3)
    scene = colored(vertices, quads, uv, corners, COLORS)
    for what in ("point", "line"):
        flat = uv.copy()
        flat[8:12] = uv[8] if what == "point" else np.linspace(uv[8], uv[9], 4)
        image, _, _ = bake(gdtool, QuadMesh(vertices, quads, flat, corners), scene)
        np.testing.assert_allclose(middle(image, 0), RED, atol=1)


def test_one_face_is_enough(gdtool):
    vertices, uv = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0.1, 0.9], [0.9, 0.9], [0.1, 0.1]])
    faces = np.array([[0, 1, 2, -1]])
    image = np.zeros((8, 8, 3), np.uint8)
    image[:, :4], image[:, 4:] = RED, BLUE
    scene = Scene(
        vertices, faces[:, :3].astype(np.int32), (Material(base_color_texture=Texture(image, "srgb")),), uvs=(uv,)
    )
    baked, folder, _ = bake(gdtool, QuadMesh(vertices, faces, uv, faces), scene, *FAST, "--lods", 3)
    np.testing.assert_allclose(baked[50, 10], RED, atol=1)
    np.testing.assert_allclose(baked[55, 45], BLUE, atol=1)
    # A triangle has no coarser level; that is said, and nothing breaks.
    assert folder.content.lods == () or all((folder.path / name).exists() for name in folder.content.lods)


def test_a_source_inside_out_is_turned_with_a_warning(gdtool):
    vertices, quads, uv, corners = slab(0.3)
    scene = colored(vertices, quads[:, ::-1], uv.reshape(6, 4, 2)[:, ::-1].reshape(-1, 2), corners, COLORS)
    image, folder, done = bake(gdtool, QuadMesh(vertices, quads, uv, corners), scene)
    np.testing.assert_allclose(middle(image, 0), RED, atol=1)
    np.testing.assert_allclose(middle(image, 1), BLUE, atol=1)
    assert "inside out" in done.stderr
    assert json.loads((folder.path / "manifest.json").read_text())["warnings"]


def test_a_failed_bake_keeps_the_asset_that_was_there(gdtool):
    vertices, quads, uv, corners = slab(0.3)
    mesh = QuadMesh(vertices, quads, uv, corners)
    bake(gdtool, mesh, colored(vertices, quads, uv, corners, COLORS))
    before = Path("out/asset.glb").read_bytes()
    write_obj(Path("low.obj"), QuadMesh(vertices, quads, uv * 1e-7, corners))
    done = gdtool("bake", "low.obj", "--model", "high.glb", *FAST, "-o", "out")
    assert done.returncode == 3
    assert Path("out/asset.glb").read_bytes() == before
