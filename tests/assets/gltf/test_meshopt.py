"""Decode EXT_meshopt_compression; the package meshopt also encodes the files."""

from __future__ import annotations

import numpy as np
import pytest

from gdtool.assets.gltf.read import read_gltf
from gdtool.core.errors import InputError
from tests.assets.gltf.files import QUAD, QUAD_FACES, Builder

meshopt = pytest.importorskip("meshopt", reason="the extra codecs is not installed")


def packed(builder: Builder, content: bytes, count: int, stride: int, mode: str, accessor: dict, **extra) -> int:
    """Append a compressed buffer view with an accessor and return the accessor's index."""
    source = builder.view(content)
    where = builder.document["bufferViews"][source]
    extension = {
        "buffer": 0,
        "byteOffset": where["byteOffset"],
        "byteLength": len(content),
        "byteStride": stride,
        "count": count,
        "mode": mode,
        **extra,
    }
    builder.document["bufferViews"][source] = {
        "buffer": 0,
        "byteLength": count * stride,
        "extensions": {"EXT_meshopt_compression": extension},
    }
    builder.document["accessors"].append({"bufferView": source, "count": count, **accessor})
    return len(builder.document["accessors"]) - 1


def scene_of(tmp_path, index_type=np.uint32, mode="TRIANGLES", normals=None):
    """Read a quad whose positions, indices and perhaps normals are compressed."""
    builder = Builder()
    builder.document |= {
        "extensionsUsed": ["EXT_meshopt_compression"],
        "extensionsRequired": ["EXT_meshopt_compression"],
    }
    attributes = {
        "POSITION": packed(
            builder,
            meshopt.encode_vertex_buffer_level(QUAD, 2, 0),
            4,
            12,
            "ATTRIBUTES",
            {"componentType": 5126, "type": "VEC3"},
        )
    }
    if normals is not None:
        content = meshopt.encode_vertex_buffer_level(normals, 2, 0)
        attributes["NORMAL"] = packed(
            builder,
            content,
            4,
            4,
            "ATTRIBUTES",
            {"componentType": 5120, "type": "VEC3", "normalized": True},
            filter="OCTAHEDRAL",
        )
    content = meshopt.encode_gltf_buffer(QUAD_FACES.astype(np.uint32), mode)
    size = np.dtype(index_type).itemsize
    indices = packed(
        builder, content, len(QUAD_FACES), size, mode, {"componentType": {2: 5123, 4: 5125}[size], "type": "SCALAR"}
    )
    builder.primitive(attributes, indices)
    return read_gltf(builder.write(tmp_path / "a.glb"))


@pytest.mark.parametrize("index_type", [np.uint16, np.uint32])
@pytest.mark.parametrize("mode", ["TRIANGLES", "INDICES"])
def test_vertices_and_indices_are_decoded(tmp_path, index_type, mode):
    scene = scene_of(tmp_path, index_type, mode)
    np.testing.assert_array_equal(scene.vertices, QUAD)
    corners = scene.vertices[scene.faces]  # the codec may turn a face about its corners
    np.testing.assert_allclose(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), [[0, 0, 1]] * 2)
    assert sorted(map(sorted, scene.faces.tolist())) == [[0, 1, 2], [0, 2, 3]]


def test_octahedral_normals_are_decoded(tmp_path):
    """The file stores x, y and 1 in 8 bits; the decoder computes z."""
    stored = np.array([[0, 0, 127, 0], [127, 0, 127, 0], [0, -127, 127, 0], [0, 0, 127, 0]], np.int8)
    scene = scene_of(tmp_path, normals=stored)
    np.testing.assert_allclose(scene.normals, [[0, 0, 1], [1, 0, 0], [0, -1, 0], [0, 0, 1]], atol=1e-6)


def test_exponential_floats_are_decoded(tmp_path):
    """A float is stored as a 24-bit integer and an 8-bit exponent of two: 4 · 2⁻² is 1."""
    stored = ((QUAD * 4).astype(np.int64) | (0x100 - 2) << 24).astype(np.uint32)
    builder = Builder()
    content = meshopt.encode_vertex_buffer_level(stored, 2, 0)
    builder.primitive(
        {
            "POSITION": packed(
                builder, content, 4, 12, "ATTRIBUTES", {"componentType": 5126, "type": "VEC3"}, filter="EXPONENTIAL"
            )
        },
        builder.add(QUAD_FACES),
    )
    np.testing.assert_array_equal(read_gltf(builder.write(tmp_path / "a.glb")).vertices, QUAD)


def test_a_damaged_stream_is_refused(tmp_path, monkeypatch):
    good = meshopt.encode_vertex_buffer_level
    monkeypatch.setattr(meshopt, "encode_vertex_buffer_level", lambda *a: good(*a)[:6])
    with pytest.raises(InputError, match="meshopt stream"):
        scene_of(tmp_path)
