"""Read OBJ files with their MTL materials."""

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.assets.obj.polygons import triangulate
from gdtool.assets.obj.read import read_obj
from gdtool.core.errors import InputError
from gdtool.images.io import write_png

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def read(tmp_path, text: str, library: str | None = None):
    """Read an OBJ of the given text, with an MTL library where one is given."""
    (tmp_path / "x.obj").write_text(text)
    if library is not None:
        (tmp_path / "x.mtl").write_text(library)
    return load_scene(tmp_path / "x.obj")


def area_vector(scene) -> np.ndarray:
    """Sum the area vectors of the faces."""
    a, b, c = (scene.vertices[scene.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a).sum(0) / 2


@pytest.mark.parametrize("face", ["f 1 2 3 4", "f -4 -3 -2 -1", "f 1 2 3\nf 1 3 4", "f 1 2 \\\n3 4"])
def test_one_square_in_four_notations_is_the_same_square(tmp_path, face):
    scene = read(tmp_path, SQUARE + face + "\n")
    np.testing.assert_allclose(area_vector(scene), [0, 0, 1])
    assert len(scene.faces) == 2
    assert scene.normals is None
    assert scene.materials[0].roughness == 0.5


def test_texture_coordinates_are_flipped_and_split_vertices(tmp_path):
    scene = read(
        tmp_path, SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 0 0 2\nf 1/1/1 2/2/1 3/3/1\nf 1/4/1 3/3/1 4/4/1\n"
    )
    np.testing.assert_allclose(scene.uvs[0][scene.faces[0]], [[0, 1], [1, 1], [1, 0]])
    np.testing.assert_allclose(scene.normals, [[0, 0, 1]] * len(scene.vertices))
    assert len(scene.vertices) == 5  # vertex 1 has two texture coordinates


def test_vertex_colours_are_decoded_from_srgb(tmp_path):
    text = "v 0 0 0 1 0 0\nv 1 0 0 0 0.5 0\nv 0 1 0 0 0 1\nf 1 2 3\n"
    scene = read(tmp_path, text)
    np.testing.assert_allclose(scene.colors, [[1, 0, 0, 1], [0, 0.2140411, 0, 1], [0, 0, 1, 1]], atol=1e-6)
    assert scene.materials[0].base_color == (1, 1, 1, 1)
    scene = read(tmp_path, text.replace("0.5", "127.5").replace("1 0 0\nv 1", "255 0 0\nv 1"))
    np.testing.assert_allclose(scene.colors[1], [0, 0.2140411, 0, 1], atol=1e-6)


def test_concave_polygons_are_triangulated_without_flipped_faces(tmp_path):
    # an L of six corners, area 3, from every first corner; and an arrow-shaped quad, area 1
    ring = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], float)
    for turn in range(6):
        corners = np.roll(ring, turn, 0)
        text = "".join(f"v {x} 0 {-y}\n" for x, y in corners) + "f 1 2 3 4 5 6\n"
        scene = read(tmp_path, text)
        np.testing.assert_allclose(area_vector(scene), [0, 3, 0], atol=1e-12)
        a, b, c = (scene.vertices[scene.faces[:, i]] for i in range(3))
        assert (np.cross(b - a, c - a)[:, 1] >= 0).all()  # no triangle is turned over
    arrow = np.array([[0, 0, 0], [2, -1, 0], [1, 0, 0], [2, 1, 0]], float)
    for turn in range(4):
        corners, sizes = np.arange(4), np.array([4])
        points = np.roll(arrow, turn, 0)
        triangles, owner = triangulate(points, corners, sizes)
        a, b, c = (points[triangles[:, i]] for i in range(3))
        cross = np.cross(b - a, c - a)[:, 2]
        assert (cross > 0).all()
        assert np.isclose(cross.sum() / 2, 1)
        assert (owner == 0).all()


MATERIALS = SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nmtllib x.mtl\nusemtl a\nf 1/1 2/2 3/3 4/4\n"


def test_material_statements_become_metallic_roughness(tmp_path):
    full = read(tmp_path, MATERIALS, "newmtl a\nKd 0.1 0.2 0.3\nd 0.5\nPr 0.7\nPm 0.9\nKe 2 1 0\n").materials[0]
    assert (full.base_color, full.roughness, full.metallic, full.alpha_mode, full.emissive) == (
        (0.1, 0.2, 0.3, 0.5),
        0.7,
        0.9,
        "BLEND",
        (2, 1, 0),
    )
    shiny = read(tmp_path, MATERIALS, "newmtl a\nKd 1 1 1\nKs 0.5 0.5 0.5\nNs 198\n").materials[0]
    assert shiny.roughness == pytest.approx(0.01**0.25)
    assert shiny.metallic == 0
    assert shiny.alpha_mode == "OPAQUE"
    dull = read(tmp_path, MATERIALS, "newmtl a\nKd 1 1 1\nKs 0 0 0\nNs 198\n").materials[0]
    assert dull.roughness == 0.5


def test_texture_statements_become_maps(tmp_path):
    rng = np.random.default_rng(0)
    color, orm = rng.integers(0, 256, (8, 8, 3), np.uint8), rng.integers(0, 256, (4, 4, 3), np.uint8)
    rough = rng.integers(0, 256, (8, 8, 1), np.uint8)
    flat = np.full((4, 4, 3), (128, 128, 255), np.uint8)
    for name, image in (("my color.png", color), ("orm.png", orm), ("rough.png", rough), ("flat.png", flat)):
        write_png(tmp_path / name, image)
    m = read(
        tmp_path,
        MATERIALS,
        "newmtl a\nKd 0 0 0\nmap_Kd -s 1 1 1 -clamp on my color.png\nmap_Pr rough.png\nmap_Pm -imfchan b orm.png\n"
        "map_Bump -bm 1 flat.png\n",
    ).materials[0]
    np.testing.assert_array_equal(m.base_color_texture.image, color)
    assert m.base_color_texture.encoding == "srgb"
    assert m.base_color == (1, 1, 1, 1)
    assert (m.roughness, m.metallic) == (1, 1)
    packed = m.metallic_roughness_texture.image
    np.testing.assert_array_equal(packed[..., 1], rough[..., 0])
    np.testing.assert_array_equal(packed[..., 2], np.repeat(np.repeat(orm[..., 2], 2, 0), 2, 1))
    np.testing.assert_array_equal(m.normal_texture.image, flat)
    height = read(tmp_path, MATERIALS, "newmtl a\nmap_Bump my color.png\n")
    assert height.materials[0].normal_texture is None
    assert any("height map" in note for note in height.notes)


def test_missing_libraries_materials_and_textures_are_noted(tmp_path):
    assert any("x.mtl is missing" in note for note in read(tmp_path, MATERIALS).notes)
    assert any("'a' is not defined" in note for note in read(tmp_path, MATERIALS, "newmtl b\n").notes)
    scene = read(tmp_path, MATERIALS, "newmtl a\nmap_Kd none.png\n")
    assert any("none.png" in note for note in scene.notes)
    assert scene.materials[0].base_color_texture is None


def test_faces_keep_their_materials_and_unused_ones_are_left_out(tmp_path):
    text = SQUARE + "mtllib x.mtl\nusemtl b\nf 1 2 3 4\nusemtl a\nf 1 2 3\nusemtl unused\n"
    scene = read(tmp_path, text, "newmtl a\nPr 0.1\nnewmtl b\nPr 0.2\nnewmtl unused\n")
    assert [scene.materials[i].roughness for i in scene.material_idx] == [0.2, 0.2, 0.1]
    assert len(scene.materials) == 2


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("v 0 0 0\n", "has no faces"),
        ("", "has no faces"),
        (SQUARE + "f 1 2 9\n", "refers to vertex 9"),
        (SQUARE + "f 1 2 -5\n", "line 5"),
        (SQUARE + "f 1 2 0\n", "line 5"),
        (SQUARE + "f 1 2\n", "line 5"),
        (SQUARE + "f 1/1 2/2 3/3\n", "texture coordinate 3"),
        (SQUARE.replace("v 1 1 0", "v nan 1 0") + "f 1 2 3\n", "vertex 3 is not finite"),
        (SQUARE.replace("v 1 1 0", "v inf 1 0") + "f 1 2 3\n", "vertex 3 is not finite"),
        (SQUARE.replace("v 1 1 0", "v 1 one 0") + "f 1 2 3\n", "line 3"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "without area"),
        ("v 5 5 5\nv 5 5 5\nv 5 5 5\nf 1 2 3\n", "one point"),
    ],
)
def test_a_fault_is_named_with_its_line(tmp_path, text, fact):
    with pytest.raises(InputError, match=fact):
        read(tmp_path, text)


@pytest.mark.parametrize("scale", [1e20, 1e-20])
def test_very_large_and_small_coordinates_are_read(tmp_path, scale):
    text = "".join(f"v {x * scale!r} {y * scale!r} 0\n" for x, y in ((0, 0), (1, 0), (1, 1))) + "f 1 2 3\n"
    np.testing.assert_allclose(area_vector(read(tmp_path, text)) / scale**2, [0, 0, 0.5])


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_obj(tmp_path / "none.obj")
