"""Run gdtool validate on valid folders, on faulty ones, and where it cannot check."""

import base64
import json
import shutil
import struct

import numpy as np
import pytest
from PIL import Image

from gdtool.assets.gltf.write import glb_bytes
from gdtool.assets.scene import Material, Scene
from gdtool.core.errors import InputError
from gdtool.core.folder import dataset_objects, open_folder
from gdtool.core.runner import Settings, run_all
from gdtool.images.io import write_exr
from gdtool.stages import relight, remesh, validate
from tests.faults.files import CUBE, QUADS, quad_cube
from tests.fields.shapes import torus, views_folder, views_of


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return views_folder(tmp_path_factory.mktemp("good") / "views", *views_of(torus, 32)).absolute()


def large(path):
    """Write a glTF triangle with a texture of more pixels a side than gdtool opens."""
    Image.new("RGB", (16_400, 1)).save(path.with_suffix(".png"))
    points = struct.pack("<9f", 1, 0, 0, 0, 1, 0, 0, 0, 1)
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    path.write_text(
        json.dumps(
            {
                "asset": {"version": "2.0"},
                "buffers": [{"byteLength": 36, "uri": "data:;base64," + base64.b64encode(points).decode()}],
                "bufferViews": [{"buffer": 0, "byteLength": 36}],
                "images": [{"uri": path.with_suffix(".png").name}],
                "textures": [{"source": 0}],
                "accessors": [
                    {
                        "bufferView": 0,
                        "componentType": 5126,
                        "count": 3,
                        "type": "VEC3",
                        "min": [0, 0, 0],
                        "max": [1, 1, 1],
                    },
                    {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC2"},
                ],
                "materials": [material],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
                "nodes": [{"mesh": 0}],
                "scenes": [{"nodes": [0]}],
            }
        )
    )
    return path


def test_a_valid_folder_is_reported_as_valid(gdtool, good):
    done = gdtool("validate", good)
    assert (done.returncode, done.stdout) == (0, f"valid: {good}\n")


def test_each_source_is_checked_and_the_first_faults_are_named(gdtool, good, tmp_path):
    bad = shutil.copytree(good, tmp_path / "bad")
    (bad / "mask" / "front.png").write_bytes(b"no picture")
    done = gdtool("validate", "--json", bad, good)
    first, second = (json.loads(line) for line in done.stdout.splitlines())
    assert done.returncode == 3
    assert not first["valid"]
    assert "mask/front.png" in first["faults"][0]
    assert second["valid"]


def test_a_missing_resource_is_an_error_and_not_a_fault(gdtool, good, tmp_path):
    done = gdtool("validate", large(tmp_path / "x.gltf"), good)
    assert done.returncode == 5
    assert "x.png" in done.stderr
    assert "16400" in done.stderr
    assert done.stdout == f"valid: {good}\n"


def result(tmp_path):
    quad_cube(tmp_path / "cube.obj", 2)
    (done,) = run_all(remesh.STAGE, ("cube.obj",), remesh.Options(faces=24), {}, Settings(output=tmp_path / "mesh"))
    return done.path


def test_options_that_do_not_match_the_key_are_a_fault(tmp_path):
    folder = result(tmp_path)
    assert list(validate.faults(folder)) == []
    record = json.loads((folder / "manifest.json").read_text())
    record["options"]["faces"] = 5000
    (folder / "manifest.json").write_text(json.dumps(record))
    (fault,) = validate.faults(folder)
    assert "not those that the key was made of" in fault
    assert "gdtool remesh" in fault


def test_inputs_that_do_not_match_the_key_are_a_fault(tmp_path):
    folder = result(tmp_path)
    record = json.loads((folder / "manifest.json").read_text())
    record["inputs"][0]["digest"] = "0" * 64
    (folder / "manifest.json").write_text(json.dumps(record))
    assert "not those that the key was made of" in list(validate.faults(folder))[0]


def test_a_key_follows_the_content_of_a_file_option(tmp_path):
    """The digest of the file is part of the key; without the file the key cannot be checked."""
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32))
    options = relight.Options(env="sky.exr", views=1, size=16, samples=1, light_samples=1)
    triangles = np.concatenate([QUADS[:, [0, 1, 2]], QUADS[:, [0, 2, 3]]]).astype(np.int32)
    (tmp_path / "cube.glb").write_bytes(glb_bytes(Scene(CUBE, triangles, (Material(),))))
    (done,) = run_all(relight.STAGE, ("cube.glb",), options, {}, Settings(output=tmp_path / "renders"))
    assert list(validate.faults(done.path)) == []
    write_exr(tmp_path / "sky.exr", 2 * np.ones((8, 16, 3), np.float32))
    assert "the key was made of" in list(validate.faults(done.path))[0]
    (tmp_path / "sky.exr").unlink()
    assert list(validate.faults(done.path)) == []


def dataset(tmp_path, good, entry):
    root = tmp_path / "data"
    shutil.copytree(good, root / "ring.asset/views")
    shutil.copytree(good, tmp_path / "outside/views")
    content = {"objects": [entry]}
    (root / "manifest.json").write_text(
        json.dumps({"kind": "dataset", "name": "data", "stage": "mine", "content": content, "files": []})
    )
    return root


def test_a_dataset_that_lists_a_folder_outside(tmp_path, good):
    right = open_folder(good).manifest.digest
    assert list(validate.faults(dataset(tmp_path, good, {"path": "ring.asset/views", "digest": right}))) == []
    shutil.rmtree(tmp_path / "data")
    shutil.rmtree(tmp_path / "outside")
    (fault,) = validate.faults(dataset(tmp_path, good, {"path": "../outside/views", "digest": right}))
    assert "leaves its folder" in fault


def test_a_dataset_that_lists_another_folder_by_its_digest(tmp_path, good):
    root = dataset(tmp_path, good, {"path": "ring.asset/views", "digest": "0" * 64})
    (fault,) = validate.faults(root)
    assert "not the folder that the dataset lists" in fault
    with pytest.raises(InputError, match="not the folder that the dataset lists"):
        list(dataset_objects(open_folder(root)))


def test_a_dataset_that_lists_a_link_out_of_it(tmp_path, good):
    root = dataset(tmp_path, good, {"path": "link", "digest": open_folder(good).manifest.digest})
    (root / "link").symlink_to(tmp_path / "outside/views")
    assert "link that leaves" in list(validate.faults(root))[0]
