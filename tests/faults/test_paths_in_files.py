"""Keep names inside files from leading to files outside the folder that they belong to."""

import io
import json
import tarfile

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.core.errors import InputError
from gdtool.core.folder import open_folder
from gdtool.core.sources import digest
from gdtool.diffusion.data.archives import object_count, unpack_views
from gdtool.folders.adapters import nerf, plain
from gdtool.folders.views import read_views
from gdtool.images.io import encode_png, write_png
from tests.assets.gltf.files import QUAD, QUAD_FACES, Builder, with_textures
from tests.fields.shapes import torus, views_folder
from tests.fields.shapes import views_of as seen

FACE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
RED, BLUE = (np.full((2, 2, 3), color, np.uint8) for color in ((255, 0, 0), (0, 0, 255)))


@pytest.fixture
def model_folder(tmp_path):
    """Make an empty folder two levels below a picture, a buffer and a library that no model in it may read."""
    write_png(tmp_path / "secret.png", RED)
    (tmp_path / "secret.bin").write_bytes(QUAD.tobytes() + QUAD_FACES.tobytes())
    (tmp_path / "secret.mtl").write_text("newmtl m\nKd 1 0 0\n")
    folder = tmp_path / "deep" / "inside" / "model"
    folder.mkdir(parents=True)
    return folder


def gltf(folder, buffer="m.bin", image=None):
    """Write a model.gltf whose buffer and, where given, image have these URIs."""
    builder = Builder()
    extra = {}
    if image is not None:
        builder.document |= {
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
            "textures": [{"source": 0}],
            "images": [{"uri": image}],
        }
        extra = {"material": 0}
    builder.primitive(
        {"POSITION": builder.add(QUAD), "TEXCOORD_0": builder.add(QUAD[:, :2].copy())}, builder.add(QUAD_FACES), **extra
    )
    (folder / "m.bin").write_bytes(builder.binary)
    builder.document["buffers"] = [{"byteLength": len(builder.binary), "uri": buffer}]
    (folder / "model.gltf").write_text(json.dumps(builder.document))
    return folder / "model.gltf"


def outside_uris(target):
    """Write a path to a file outside the folder in twelve ways."""
    path = str(target)
    return [
        path,
        path.replace("/", "%2F"),
        "%2e%2e/" * 3 + target.name,
        "../" * 3 + target.name,
        "..%5C" * 3 + target.name,
        "file://" + path,
        "x/../../" + target.name,
        "%66ile:" + path,
        "http://example.com/" + target.name,
        "\\" + path,
        "a\0b",
        "%00",
    ]


@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("kind", ["buffer", "image"])
def test_a_gltf_reads_nothing_outside_its_folder(model_folder, tmp_path, kind, number):
    target = tmp_path / ("secret.bin" if kind == "buffer" else "secret.png")
    path = gltf(model_folder, **{kind: outside_uris(target)[number]})
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert caught.value.cure
    assert "exist" not in caught.value.fact
    assert "\n" not in str(caught.value)


def test_a_gltf_follows_no_link_out_of_its_folder(model_folder, tmp_path):
    (model_folder / "t.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="link that leaves"):
        load_scene(gltf(model_folder, image="t.png"))
    (model_folder / "textures").symlink_to(tmp_path)
    with pytest.raises(InputError, match="link that leaves"):
        load_scene(gltf(model_folder, image="textures/secret.png"))


@pytest.mark.parametrize(
    "uri", ["maps/a b.png", "maps/a%20b.png", "./maps/a%20b.png", "maps/../maps/a%20b.png", "maps%5Ca%20b.png"]
)
def test_a_gltf_reads_images_inside_its_folder(model_folder, uri):
    write_png(model_folder / "maps" / "a b.png", BLUE)
    scene = load_scene(gltf(model_folder, image=uri))
    assert np.array_equal(scene.materials[0].base_color_texture.image, BLUE)


def obj(folder, library="m.mtl", texture=None):
    """Write a model.obj with an .mtl, naming these files."""
    (folder / "model.obj").write_text(f"mtllib {library}\n{FACE}")
    (folder / "m.mtl").write_text("newmtl m\n" + (f"map_Kd {texture}\n" if texture is not None else ""))
    return folder / "model.obj"


@pytest.mark.parametrize(
    "texture",
    [
        "../../../secret.png",
        "..\\..\\..\\secret.png",
        "a/../../../../secret.png",
        "-s 1 1 1 ../../../secret.png",
        "x\0y.png",
    ],
)
def test_an_mtl_reads_nothing_two_folders_above_the_model(model_folder, texture):
    with pytest.raises(InputError) as caught:
        load_scene(obj(model_folder, texture=texture))
    assert caught.value.subject.endswith("m.mtl")
    assert caught.value.cure


def test_an_obj_reads_no_library_two_folders_above_itself(model_folder):
    with pytest.raises(InputError, match="leaves its folder"):
        load_scene(obj(model_folder, library="../../../secret.mtl"))


def test_an_mtl_follows_no_link_out_of_its_folder(model_folder, tmp_path):
    (model_folder / "t.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="link that leaves"):
        load_scene(obj(model_folder, texture="t.png"))


def test_an_absolute_texture_path_of_an_mtl_is_searched_beside_the_model(model_folder, tmp_path):
    path = obj(model_folder, texture=tmp_path / "secret.png")
    assert any("secret.png" in note for note in load_scene(path).notes)
    write_png(model_folder / "secret.png", BLUE)
    assert np.array_equal(load_scene(path).materials[0].base_color_texture.image, BLUE)


@pytest.mark.parametrize(
    ("texture", "place"),
    [
        ("../textures/t.png", "../textures"),
        ("t.png", "../materials/textures"),
        ("..\\t.png", ".."),
        ("a/../t.png", "."),
    ],
)
def test_textures_one_folder_above_an_obj_are_read(model_folder, texture, place):
    (model_folder / "a").mkdir()
    write_png((model_folder / place / "t.png").resolve(), BLUE)
    assert np.array_equal(load_scene(obj(model_folder, texture=texture)).materials[0].base_color_texture.image, BLUE)


@pytest.mark.parametrize("texture", [".", "", '""'])
def test_a_texture_without_a_name_is_noted(model_folder, texture):
    scene = load_scene(obj(model_folder, texture=texture))
    assert any("texture" in note and "left out" in note for note in scene.notes)


def test_a_digest_depends_on_exactly_the_files_that_are_read(model_folder, tmp_path):
    for make, names in (
        (gltf, {"image": "../../../secret.png"}),
        (obj, {"texture": tmp_path / "secret.png"}),
        (obj, {"texture": "../../../secret.png"}),
        (obj, {"library": "../../../secret.mtl"}),
        (gltf, {"image": "%2e%2e/" * 3 + "secret.png"}),
    ):
        path = make(model_folder, **names)
        before = digest(path)
        write_png(tmp_path / "secret.png", np.random.default_rng(0).integers(0, 255, (2, 2, 3), np.uint8))
        (tmp_path / "secret.mtl").write_text("newmtl m\nKd 0 1 0\n")
        assert digest(path) == before, names
        write_png(tmp_path / "secret.png", RED)
        (tmp_path / "secret.mtl").write_text("newmtl m\nKd 1 0 0\n")
    path = obj(model_folder, texture=tmp_path / "secret.png")
    before = digest(path)
    write_png(model_folder / "secret.png", BLUE)  # the last part of an absolute name, which is what is read
    assert digest(path) != before


@pytest.mark.parametrize("name", ["../../../secret", "%2e%2e/" * 3 + "secret", "/etc/hostname", "a\0b"])
def test_transforms_json_reads_no_picture_outside_its_folder(model_folder, name):
    (model_folder / "transforms.json").write_text(
        json.dumps({"camera_angle_x": 1.0, "frames": [{"file_path": name, "transform_matrix": np.eye(4).tolist()}]})
    )
    with pytest.raises(InputError) as caught:
        nerf.read(model_folder)
    assert caught.value.subject.endswith("transforms.json")
    assert "exist" not in caught.value.fact


@pytest.mark.parametrize("name", ["..", "../../secret", "a/b", "x" * 300])
def test_cameras_json_reads_no_picture_outside_its_folder(model_folder, name):
    camera = {
        "name": name,
        "projection": "orthographic",
        "width": 2,
        "height": 2,
        "world_from_camera": np.eye(4).ravel().tolist(),
        "half_width": 1.0,
        "near": 1.0,
        "far": 3.0,
    }
    (model_folder / "cameras.json").write_text(json.dumps({"cameras": [camera]}))
    with pytest.raises(InputError, match="cameras.json"):
        plain.read(model_folder)


def test_a_views_folder_follows_no_link_out_of_it(tmp_path):
    """Also for files that the manifest does not list."""
    path = views_folder(tmp_path / "a.asset" / "views", *seen(torus, 16))
    (path / "color").rename(tmp_path / "elsewhere")
    (path / "color").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="link that leaves"):
        read_views(open_folder(path, check=False))


@pytest.mark.parametrize(
    "name",
    [
        "../../../out.png",
        "/tmp/out.png",
        "a.asset/views/../../../../out.png",
        "a.asset/views/color/a\\b.png",
        "a.asset/views/color/\x07.png",
        "a.asset/views/" + "x" * 300 + ".png",
    ],
)
def test_an_archive_writes_nothing_outside_the_workspace(tmp_path, name):
    archive, work = tmp_path / "a.tar", tmp_path / "deep" / "work"
    work.mkdir(parents=True)
    content = encode_png(RED)
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as tar:
        for member_name in ("a.asset/views/manifest.json", name):
            member = tarfile.TarInfo(member_name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    before = sorted(tmp_path.rglob("*"))
    for use in (lambda: object_count(archive), lambda: list(unpack_views(archive, work))):
        with pytest.raises(InputError, match="a.tar"):
            use()
    assert sorted(tmp_path.rglob("*")) == before


def test_an_embedded_texture_of_a_glb_is_read(tmp_path):
    scene = load_scene(_with_color(tmp_path))
    assert np.array_equal(scene.materials[0].base_color_texture.image, BLUE)


def _with_color(tmp_path):
    """Write a GLB with an embedded texture."""
    builder = with_textures(color=BLUE)
    builder.document["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0}}
    return builder.write(tmp_path / "x.glb")
