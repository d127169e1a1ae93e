"""Read the geometry of glTF files: buffers, accessors, nodes, skins, compression."""

import base64
import json

import numpy as np
import pytest

from gdtool.assets.gltf.read import read_gltf
from gdtool.assets.load import load_scene
from gdtool.assets.scene import DEFAULT_MATERIAL
from gdtool.core.errors import InputError, ResourceError
from gdtool.images.io import encode_png
from tests.assets.gltf.files import QUAD, QUAD_FACES, Builder, quad


def area_vector(scene) -> np.ndarray:
    """Sum the area vectors of the faces: for a flat shape the direction that it faces, times its area."""
    a, b, c = (scene.vertices[scene.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a).sum(0) / 2


def test_a_quad_is_read_with_its_attributes(tmp_path):
    scene = read_gltf(quad().write(tmp_path / "quad.glb"))
    np.testing.assert_array_equal(scene.vertices, QUAD)
    np.testing.assert_array_equal(scene.faces.ravel(), QUAD_FACES)
    np.testing.assert_allclose(scene.normals, [[0, 0, 1]] * 4)
    np.testing.assert_allclose(scene.uvs[0], [[0, 1], [1, 1], [1, 0], [0, 0]])
    assert scene.materials == (DEFAULT_MATERIAL,)
    assert scene.name == "quad"
    assert scene.colors is None
    assert scene.tangents is None


def test_buffers_in_files_and_data_uris_equal_the_binary_chunk(tmp_path):
    builder = quad()
    truth = read_gltf(builder.write(tmp_path / "a.glb"))
    for uri in (
        "its%20buffer.bin",
        "data:application/octet-stream;base64," + base64.b64encode(builder.binary).decode(),
    ):
        (tmp_path / "its buffer.bin").write_bytes(builder.binary)
        document = {**builder.document, "buffers": [{"byteLength": len(builder.binary), "uri": uri}]}
        (tmp_path / "a.gltf").write_text(json.dumps(document))
        scene = read_gltf(tmp_path / "a.gltf")
        np.testing.assert_array_equal(scene.vertices, truth.vertices)
        np.testing.assert_array_equal(scene.faces, truth.faces)


@pytest.mark.parametrize(
    "uri",
    [
        "/etc/passwd",
        "file:///etc/passwd",
        "http://example.com/x.bin",
        "C:/x.bin",
        "\\\\host\\x.bin",
        "missing.bin",
        "data:application/octet-stream;base64,***",
    ],
)
def test_absolute_missing_and_malformed_buffer_uris_are_refused(tmp_path, uri):
    builder = quad()
    document = {**builder.document, "buffers": [{"byteLength": len(builder.binary), "uri": uri}]}
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(InputError, match="buffer 0"):
        read_gltf(tmp_path / "a.gltf")


def test_a_sparse_accessor_replaces_the_elements_it_lists(tmp_path):
    builder = quad()
    where, values = (
        builder.view(np.uint16([1, 3]).tobytes()),
        builder.view(np.float32([[5, 0, 0], [0, 7, 0]]).tobytes()),
    )
    builder.document["accessors"][0]["sparse"] = {
        "count": 2,
        "indices": {"bufferView": where, "componentType": 5123},
        "values": {"bufferView": values},
    }
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(scene.vertices, [[0, 0, 0], [5, 0, 0], [1, 1, 0], [0, 7, 0]])
    builder.document["accessors"][0]["sparse"]["count"] = 9
    with pytest.raises(InputError, match="overrides 9 of its 4"):
        read_gltf(builder.write(tmp_path / "a.glb"))


def test_a_sparse_accessor_without_a_buffer_view_starts_from_zeros(tmp_path):
    builder = quad()
    where, values = builder.view(np.uint8([1, 2]).tobytes()), builder.view(np.float32([[1, 0, 0], [1, 1, 0]]).tobytes())
    record = builder.document["accessors"][0]
    del record["bufferView"]
    record["sparse"] = {
        "count": 2,
        "indices": {"bufferView": where, "componentType": 5121},
        "values": {"bufferView": values},
    }
    np.testing.assert_array_equal(read_gltf(builder.write(tmp_path / "a.glb")).vertices[:3], QUAD[:3])


def test_quantised_positions_are_integers_and_normalised_attributes_fractions(tmp_path):
    builder = Builder()
    builder.document |= {"extensionsRequired": ["KHR_mesh_quantization"], "extensionsUsed": ["KHR_mesh_quantization"]}
    builder.document["nodes"][0]["scale"] = [0.001, 0.001, 0.001]
    attributes = {
        "POSITION": builder.add((QUAD * 1000).astype(np.int16)),
        "NORMAL": builder.add(np.int8([[0, 0, 127]] * 4), normalized=True),
        "TEXCOORD_0": builder.add((QUAD[:, :2] * 65535).astype(np.uint16), normalized=True),
    }
    builder.primitive(attributes, builder.add(QUAD_FACES))
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(scene.vertices, QUAD, atol=1e-12)
    np.testing.assert_allclose(scene.uvs[0], QUAD[:, :2])
    np.testing.assert_allclose(scene.normals, [[0, 0, 1]] * 4)


def test_the_lowest_normalised_signed_byte_is_minus_one(tmp_path):
    builder = Builder()
    builder.primitive({"POSITION": builder.add(np.int8([[-128, 0, 0], [127, 0, 0], [0, 127, 0]]), normalized=True)})
    np.testing.assert_allclose(
        read_gltf(builder.write(tmp_path / "a.glb")).vertices, [[-1, 0, 0], [1, 0, 0], [0, 1, 0]]
    )


def test_interleaved_attributes_are_read(tmp_path):
    builder = Builder()
    rows = np.concatenate([QUAD, np.tile(np.float32([0, 0, 1]), (4, 1)), QUAD[:, :2]], 1)
    view = builder.view(rows.tobytes(), byteStride=32)
    for offset, kind in ((0, "VEC3"), (12, "VEC3"), (24, "VEC2")):
        builder.document["accessors"].append(
            {"bufferView": view, "byteOffset": offset, "componentType": 5126, "count": 4, "type": kind}
        )
    builder.primitive({"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, builder.add(QUAD_FACES))
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(scene.vertices, QUAD)
    np.testing.assert_array_equal(scene.uvs[0], QUAD[:, :2])


@pytest.mark.parametrize(
    ("mode", "indices"), [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3]), (5, [0, 1, 3, 2, 2])]
)
def test_triangle_lists_strips_and_fans_have_one_winding(tmp_path, mode, indices):
    builder = Builder()
    builder.primitive({"POSITION": builder.add(QUAD)}, builder.add(np.array(indices, np.uint8)), mode=mode)
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(area_vector(scene), [0, 0, 1])
    assert len(scene.faces) == 2


def test_a_primitive_without_indices_uses_its_vertices_in_order(tmp_path):
    builder = Builder()
    builder.primitive({"POSITION": builder.add(QUAD[[0, 1, 2, 0, 2, 3]])})
    np.testing.assert_allclose(area_vector(read_gltf(builder.write(tmp_path / "a.glb"))), [0, 0, 1])


def test_points_and_lines_are_left_out_and_noted(tmp_path):
    builder = quad()
    builder.primitive({"POSITION": builder.add(QUAD)}, mode=1)
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    assert len(scene.faces) == 2
    assert any("lines" in note for note in scene.notes)


def test_transforms_of_nested_nodes_are_applied(tmp_path):
    builder = quad()
    half = np.sqrt(0.5)
    builder.document["nodes"] = [
        {"children": [1], "translation": [10, 0, 0]},
        {"mesh": 0, "rotation": [0, half, 0, half], "scale": [2, 2, 2]},
    ]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    # a quarter turn about +Y takes +X to -Z and +Z to +X
    np.testing.assert_allclose(scene.vertices, [[10, 0, 0], [10, 0, -2], [10, 2, -2], [10, 2, 0]], atol=1e-12)
    np.testing.assert_allclose(scene.normals, [[1, 0, 0]] * 4, atol=1e-12)
    matrix = np.eye(4)
    matrix[:3, :3] = [[0, 0, 2], [0, 2, 0], [-2, 0, 0]]
    builder.document["nodes"][1] = {"mesh": 0, "matrix": matrix.T.ravel().tolist()}  # columns first
    np.testing.assert_allclose(read_gltf(builder.write(tmp_path / "b.glb")).vertices, scene.vertices, atol=1e-12)


def test_a_mirroring_node_reverses_the_winding_and_keeps_the_bitangent(tmp_path):
    builder = quad(normalTexture={"index": 0})
    builder.document["images"] = [{"bufferView": builder.view(encode_png(np.full((2, 2, 3), 0.5)))}]
    builder.document["textures"] = [{"source": 0}]
    builder.document["meshes"][0]["primitives"][0]["attributes"]["TANGENT"] = builder.add(
        np.tile(np.float32([1, 0, 0, 1]), (4, 1))
    )
    builder.document["nodes"][0]["scale"] = [-1, 1, 1]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    np.testing.assert_allclose(area_vector(scene), [0, 0, 1])
    np.testing.assert_allclose(scene.normals, [[0, 0, 1]] * 4)
    bitangent = scene.tangents[:, 3:] * np.cross(scene.normals, scene.tangents[:, :3])
    np.testing.assert_allclose(scene.tangents[:, :3], [[-1, 0, 0]] * 4)
    np.testing.assert_allclose(bitangent, [[0, 1, 0]] * 4)


def test_normals_stay_perpendicular_under_non_uniform_scale(tmp_path):
    builder = Builder()
    slope = np.float32([[0, 1, 0], [1, 0, 0], [0, 1, 1]])
    normal = np.tile(np.float32([1, 1, 0]) / np.float32(np.sqrt(2)), (3, 1))
    builder.primitive({"POSITION": builder.add(slope), "NORMAL": builder.add(normal)})
    builder.document["nodes"][0]["scale"] = [2, 1, 1]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    edges = scene.vertices[1:] - scene.vertices[:1]
    np.testing.assert_allclose(edges @ scene.normals[0], 0, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(scene.normals, axis=1), 1)


def test_a_skinned_mesh_follows_its_joints(tmp_path):
    builder = quad()
    weights, joints = np.zeros((4, 4), np.float32), np.zeros((4, 4), np.uint8)
    weights[:, 0], joints[2:, 0] = 1, 1  # the upper edge follows the second joint
    attributes = builder.document["meshes"][0]["primitives"][0]["attributes"]
    attributes |= {"JOINTS_0": builder.add(joints), "WEIGHTS_0": builder.add(weights)}
    inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    inverse[1, 3, 1] = -1  # stored by columns: the second joint was bound at y = 1
    builder.document["skins"] = [{"joints": [1, 2], "inverseBindMatrices": builder.add(inverse)}]
    builder.document["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},
        {"children": [2]},
        {"translation": [0, 3, 0]},
    ]
    builder.document["scenes"] = [{"nodes": [0, 1]}]
    scene = read_gltf(builder.write(tmp_path / "a.glb"))
    # the mesh's own node does not move a skinned mesh
    np.testing.assert_allclose(scene.vertices, [[0, 0, 0], [1, 0, 0], [1, 3, 0], [0, 3, 0]])
    builder.document["skins"][0]["joints"] = [1]
    with pytest.raises(InputError, match="joint out of range"):
        read_gltf(builder.write(tmp_path / "a.glb"))


def test_morph_targets_are_added_at_their_default_weights(tmp_path):
    builder = quad()
    builder.document["meshes"][0]["primitives"][0]["targets"] = [
        {"POSITION": builder.add(np.tile(np.float32([0, 0, 4]), (4, 1)))}
    ]
    builder.document["meshes"][0]["weights"] = [0.25]
    np.testing.assert_allclose(read_gltf(builder.write(tmp_path / "a.glb")).vertices[:, 2], 1)
    builder.document["nodes"][0]["weights"] = [0.5]
    np.testing.assert_allclose(read_gltf(builder.write(tmp_path / "a.glb")).vertices[:, 2], 2)


def test_attributes_that_only_some_primitives_have_are_filled_in(tmp_path):
    builder = quad(name="red", pbrMetallicRoughness={"baseColorFactor": [1, 0, 0, 1]})
    colors = np.uint8([[255, 0, 0], [0, 255, 0], [0, 0, 255], [51, 51, 51]])
    builder.primitive(
        {
            "POSITION": builder.add(QUAD + np.float32([2, 0, 0])),
            "COLOR_0": builder.add(colors, normalized=True),
            "TEXCOORD_1": builder.add(QUAD[:, :2]),
        },
        builder.add(QUAD_FACES),
        material=0,
    )
    builder.primitive({"POSITION": builder.add(QUAD + np.float32([4, 0, 0]))}, builder.add(QUAD_FACES))
    scene = load_scene(builder.write(tmp_path / "a.glb"))
    assert [m.name for m in scene.materials] == ["red", "default"]
    np.testing.assert_array_equal(scene.material_idx, [0, 0, 0, 0, 1, 1])
    np.testing.assert_allclose(scene.normals, np.tile([0, 0, 1], (len(scene.vertices), 1)))  # flat where none are given
    assert scene.uvs[0].shape == scene.uvs[1].shape == (len(scene.vertices), 2)
    corner = scene.colors[scene.faces]
    np.testing.assert_allclose(corner[0], 1)
    np.testing.assert_allclose(corner[2], [[1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])
    np.testing.assert_allclose(corner[3, 2], [0.2, 0.2, 0.2, 1])


def test_only_the_vertices_that_a_primitive_uses_are_read(tmp_path):
    builder = Builder()
    positions = builder.add(np.random.default_rng(0).random((1000, 3)).astype(np.float32))
    for k in range(3):
        builder.primitive({"POSITION": positions}, builder.add(np.uint16([k, k + 10, k + 20])))
    assert len(read_gltf(builder.write(tmp_path / "a.glb")).vertices) == 9


def test_draco_primitives_are_decoded_and_damaged_ones_refused(tmp_path):
    codec = pytest.importorskip("DracoPy")
    builder = Builder()
    builder.document |= {
        "extensionsRequired": ["KHR_draco_mesh_compression"],
        "extensionsUsed": ["KHR_draco_mesh_compression"],
    }
    packed = codec.encode(QUAD, QUAD_FACES.reshape(-1, 3).astype(np.uint32), quantization_bits=14)
    view = builder.view(packed)
    builder.document["accessors"] = [
        {"componentType": 5126, "count": 4, "type": "VEC3"},
        {"componentType": 5125, "count": 6, "type": "SCALAR"},
    ]
    identity = codec.decode(packed).attributes[0]["unique_id"]
    extension = {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": identity}}}
    builder.primitive({"POSITION": 0}, 1, extensions=extension)
    np.testing.assert_allclose(area_vector(read_gltf(builder.write(tmp_path / "a.glb"))), [0, 0, 1], atol=1e-3)
    builder.binary = builder.binary[:6] + b"\xff" * (len(builder.binary) - 6)
    with pytest.raises(InputError, match="Draco stream"):
        read_gltf(builder.write(tmp_path / "b.glb"))


def test_draco_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    builder = Builder()
    builder.document["accessors"] = [{"componentType": 5126, "count": 4, "type": "VEC3"}]
    builder.primitive(
        {"POSITION": 0},
        extensions={
            "KHR_draco_mesh_compression": {"bufferView": builder.view(b"DRACO"), "attributes": {"POSITION": 0}}
        },
    )
    with pytest.raises(ResourceError, match="DracoPy"):
        read_gltf(builder.write(tmp_path / "a.glb"))


def test_meshopt_without_its_package_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "meshopt", None)
    builder = quad()
    builder.document["bufferViews"][0]["extensions"] = {
        "EXT_meshopt_compression": {"buffer": 0, "byteLength": 16, "byteStride": 12, "count": 4, "mode": "ATTRIBUTES"}
    }
    with pytest.raises(ResourceError, match="pip install meshopt"):
        read_gltf(builder.write(tmp_path / "a.glb"))
