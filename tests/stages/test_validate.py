"""gdtool validate: what is right, what is wrong, and what cannot be told here."""

import base64
import json
import shutil
import struct

import pytest
from PIL import Image

from tests.fields.shapes import torus, views_folder, views_of


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return views_folder(tmp_path_factory.mktemp("good") / "views", *views_of(torus, 32)).absolute()


def large(path):
    """A glTF triangle with a texture of more pixels a side than gdtool opens."""
    Image.new("RGB", (16_400, 1)).save(path.with_suffix(".png"))
    points = struct.pack("<9f", 1, 0, 0, 0, 1, 0, 0, 0, 1)
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    path.write_text(json.dumps({
        "asset": {"version": "2.0"}, "buffers": [{"byteLength": 36, "uri": "data:;base64," + base64.b64encode(points).decode()}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}], "images": [{"uri": path.with_suffix(".png").name}], "textures": [{"source": 0}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 1]},
                      {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC2"}],
        "materials": [material], "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}))
    return path


def test_a_right_folder_is_said_to_be(gdtool, good):
    done = gdtool("validate", good)
    assert (done.returncode, done.stdout) == (0, f"valid: {good}\n")


def test_each_source_is_checked_and_the_first_faults_are_named(gdtool, good, tmp_path):
    bad = shutil.copytree(good, tmp_path / "bad")
    (bad / "mask" / "front.png").write_bytes(b"no picture")
    done = gdtool("validate", "--json", bad, good)
    first, second = (json.loads(line) for line in done.stdout.splitlines())
    assert done.returncode == 3 and not first["valid"] and "mask/front.png" in first["faults"][0] and second["valid"]


def test_what_cannot_be_read_here_is_not_called_faulty(gdtool, good, tmp_path):
    done = gdtool("validate", large(tmp_path / "x.gltf"), good)
    assert done.returncode == 5 and "x.png" in done.stderr and "16400" in done.stderr
    assert done.stdout == f"valid: {good}\n"
