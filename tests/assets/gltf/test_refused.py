"""Refuse faulty glTF files with a line that names the file and the fault."""

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.core.errors import InputError, ResourceError
from tests.assets.gltf.files import QUAD, Builder, pack, quad, with_textures


def edited(change) -> bytes:
    """Make the GLB of a quad after a change to its document."""
    builder = quad(name="m")
    change(builder)
    return builder.glb()


def set_in(*path, value):
    """Make a change that sets a value in the document."""

    def change(builder: Builder) -> None:
        item = builder.document
        for key in path[:-1]:
            item = item[key]
        item[path[-1]] = value

    return change


def nan_vertex(builder: Builder) -> None:
    """Replace the positions by some with NaN."""
    positions = QUAD.copy()
    positions[2, 1] = np.nan
    builder.document["meshes"][0]["primitives"][0]["attributes"]["POSITION"] = builder.add(positions)


def vertex_count(builder: Builder) -> None:
    """Give the mesh fewer normals than positions."""
    builder.document["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = builder.add(QUAD[:3])


def index_out_of_range(builder: Builder) -> None:
    """Let a face refer to a vertex that does not exist."""
    builder.document["meshes"][0]["primitives"][0]["indices"] = builder.add(np.uint16([0, 1, 4]))


@pytest.mark.parametrize(
    ("content", "fact"),
    [
        (edited(set_in("extensionsRequired", value=["KHR_texture_basisu"])), "KHR_texture_basisu"),
        (edited(set_in("nodes", value=[{"mesh": 0, "children": [1]}, {"children": [0]}])), "cycle"),
        (edited(set_in("nodes", value=[{"mesh": 0, "children": [0]}])), "tree"),
        (edited(set_in("nodes", value=[{"children": [2]}, {"children": [2]}, {"mesh": 0}])), "two parents"),
        (edited(set_in("nodes", 0, "children", value=[7])), "refers to node 7"),
        (edited(set_in("nodes", 0, "rotation", value=[0, 0, 0, 0])), "quaternion"),
        (edited(set_in("nodes", 0, "mesh", value=3)), "refers to mesh 3"),
        (edited(set_in("asset", "version", value="1.0")), "glTF 1.0"),
        (edited(set_in("asset", value={})), "version"),
        (edited(set_in("accessors", 0, "count", value=5)), "past the end"),
        (edited(set_in("accessors", 0, "byteOffset", value=8)), "past the end"),
        (edited(set_in("accessors", 0, "count", value="four")), "accessors"),
        (edited(set_in("accessors", 0, "componentType", value=5124)), "accessors"),
        (edited(set_in("accessors", 0, "bufferView", value=99)), "buffer view 99"),
        (edited(set_in("bufferViews", 0, "byteLength", value=10_000)), "past the end of its buffer"),
        (edited(set_in("bufferViews", 0, "buffer", value=1)), "buffer 1"),
        (edited(set_in("meshes", 0, "primitives", 0, "material", value=4)), "material 4"),
        (edited(set_in("materials", 0, "normalTexture", value={"index": 0})), "texture 0"),
        (edited(nan_vertex), "vertex 2 is not finite"),
        (edited(vertex_count), "NORMAL has 3"),
        (edited(index_out_of_range), "refers to vertex 4"),
        (edited(set_in("nodes", value=[{}])), "has no faces"),
        (quad().glb()[:-8], "says it has"),
        (quad().glb() + b"\0\0\0\0", "says it has"),
        (quad().glb()[:15], "cut short"),
        (b"glTF" + b"\1\0\0\0" + quad().glb()[8:], "binary glTF 1"),
        (pack(b"{]", b""), "is not glTF"),
        (pack(b"[" * 100_000, b""), "is not"),
        (b"", "is not glTF"),
        (b"\xff\xfe{}", "is not glTF"),
    ],
)
def test_a_fault_is_named_in_one_line_with_the_file(tmp_path, content, fact):
    path = tmp_path / "x.glb"
    path.write_bytes(content)
    with pytest.raises(InputError, match=fact) as caught:
        load_scene(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_accessor_larger_than_the_memory_is_a_resource_error(tmp_path):
    builder = quad()
    del builder.document["accessors"][0]["bufferView"]
    builder.document["accessors"][0]["count"] = 2**31
    builder.document["accessors"][0]["type"] = "MAT4"
    with pytest.raises(ResourceError, match="GiB"):
        load_scene(builder.write(tmp_path / "x.glb"))


def test_a_texture_of_a_uv_set_that_no_mesh_has_is_refused(tmp_path):
    builder = with_textures(color=np.zeros((2, 2, 3), np.uint8))
    builder.document["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": {"index": 0, "texCoord": 3}}
    with pytest.raises(InputError, match="texture coordinates 3"):
        load_scene(builder.write(tmp_path / "x.glb"))


def test_an_image_that_does_not_decode_is_named(tmp_path):
    builder = quad(pbrMetallicRoughness={"baseColorTexture": {"index": 0}})
    builder.document["images"] = [
        {"bufferView": builder.view(b"no picture here, just words of text"), "mimeType": "image/png"}
    ]
    builder.document["textures"] = [{"source": 0}]
    with pytest.raises(InputError, match="x.glb: image 0: is not an image"):
        load_scene(builder.write(tmp_path / "x.glb"))
