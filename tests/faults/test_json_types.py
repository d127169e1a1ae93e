"""Refuse JSON of wrong types, too deep or too long, with one InputError that names the place."""

import json

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.core.errors import InputError
from gdtool.core.references import referred_files
from gdtool.folders.adapters import nerf
from gdtool.folders.records import read_cameras, read_light
from gdtool.images.io import write_png

GLTF = '{"asset": {"version": "2.0"}, %s}'
DEEP = "[" * 100_000 + "]" * 100_000
LONG = "9" * 5000

DOCUMENTS = {
    '"buffers": 5': "buffers",
    '"buffers": null': "buffers",
    '"buffers": [null]': "buffers",
    '"buffers": [5]': "buffers",
    '"buffers": {"a": 1}': "buffers",
    '"buffers": [{"byteLength": "4"}]': "byteLength",
    '"buffers": [{"byteLength": 4, "uri": 7}]': "uri",
    '"images": null': "images",
    '"images": [{"uri": ["a"]}]': "uri",
    '"images": "x"': "images",
    '"nodes": [[]]': "nodes",
    '"scene": "0"': "scene",
    '"scene": -1': "scene",
    '"scene": 1.5': "scene",
    f'"scene": {LONG}': "scene",
    f'"scene": {"9" * 400}': "scene",
    '"nodes": [{"scale": [1, 1, 1e999]}]': "scale",
    '"nodes": [{"scale": [1, 1, NaN]}]': "glTF",
    '"nodes": [{"scale": [1, 1, Infinity]}]': "glTF",
    f'"extras": {DEEP}': "glTF",
    f'"nodes": {DEEP}': "glTF",
    '"materials": [{"name": "\\ud800"}]': "glTF",
    '"images": [{"uri": "\\udc00.png"}]': "glTF",
    '"meshes": [{"primitives": []}]': "primitives",
    '"accessors": [{"componentType": 5126, "count": true, "type": "VEC3"}]': "count",
}


@pytest.mark.parametrize("part", DOCUMENTS, ids=lambda part: part[:40])
def test_a_gltf_of_wrong_types_is_refused_with_the_place(tmp_path, part):
    path = tmp_path / "x.gltf"
    path.write_text(GLTF % part)
    with pytest.raises(InputError, match=DOCUMENTS[part]) as caught:
        load_scene(path)
    assert caught.value.subject == str(path)
    assert caught.value.cure
    assert len(str(caught.value)) < 400
    assert "\n" not in str(caught.value)
    assert referred_files(path) == []  # what the digest asks does not fail


@pytest.mark.parametrize(
    "name", [f"TEXCOORD_{LONG}", "TEXCOORD_²", "TEXCOORD_\n"], ids=["long", "superscript", "line break"]
)
def test_a_malformed_attribute_name_is_no_uv_set(tmp_path, name):
    from tests.assets.gltf.files import quad

    builder = quad()
    attributes = builder.document["meshes"][0]["primitives"][0]["attributes"]
    attributes[name] = attributes["TEXCOORD_0"]
    assert len(load_scene(builder.write(tmp_path / "x.glb")).uvs) == 1


@pytest.mark.parametrize("seed", [LONG, "²", "-1", "1.5", ""])
def test_a_procedural_seed_must_be_a_64_bit_number(seed):
    with pytest.raises(InputError, match="procedural:SEED"):
        load_scene(f"procedural:{seed}")


FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
INTRINSICS = {"w": 4, "h": 4, "fl_x": 5.0, "fl_y": 5.0, "cx": 2.0, "cy": 2.0}
LAST = [0, 0, 0, 1]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("w", value) for value in (0, -4, "4", None, True, [4], 1e300, 1e-300)),
        ("h", 0),
        ("h", -1),
        ("fl_x", 0),
        ("fl_x", -5.0),
        ("fl_x", "5"),
        ("fl_x", {}),
        ("fl_y", 0),
        ("fl_y", 1e-200),
        ("cx", "2"),
        ("cy", 1e300),
        ("k1", "0"),
        ("camera_angle_x", "1"),
        ("transform_matrix", None),
        ("transform_matrix", "x"),
        ("transform_matrix", [[["1"] * 4] * 4]),
        ("transform_matrix", [["1", 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], LAST]),
        ("transform_matrix", [[1e300, 0, 0, 0], [0, 1e300, 0, 0], [0, 0, 1e300, 0], LAST]),
        ("transform_matrix", [[True, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], LAST]),
        ("transform_matrix", [[1, 0, 0], [0, 1, 0]]),
        ("transform_matrix", [[0, 0, 0, 0]] * 4),
        ("file_path", 5),
        ("file_path", None),
    ],
)
def test_an_invalid_value_of_transforms_json_is_named(tmp_path, key, value):
    write_png(tmp_path / "a.png", np.pad(np.full((2, 2, 4), 0.5), ((1, 1), (1, 1), (0, 0))))
    record = INTRINSICS | {"frames": [FRAME]}
    assert len(read_transforms(tmp_path, record)) == 1
    if key in FRAME:
        record["frames"] = [FRAME | {key: value}]
    else:
        record[key] = value
    with pytest.raises(InputError, match=key) as caught:
        read_transforms(tmp_path, record)
    assert caught.value.subject == str(tmp_path / "transforms.json")
    assert caught.value.cure


def read_transforms(folder, record):
    """Write a transforms.json and read its cameras."""
    (folder / "transforms.json").write_text(json.dumps(record))
    return nerf.read(folder).cameras


@pytest.mark.parametrize(
    "text",
    [
        "5",
        "null",
        '{"frames": 5}',
        '{"frames": [5]}',
        '{"frames": []}',
        "{",
        f'{{"w": {LONG}}}',
        '{"w": NaN}',
        DEEP,
        '{"w": 1, "w": 2}',
        '{"frames": [{"file_path": "\\ud800"}]}',
    ],
    ids=lambda text: text[:30],
)
def test_a_transforms_json_of_another_structure_is_refused(tmp_path, text):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(InputError, match="transforms.json"):
        nerf.read(tmp_path)


CAMERA = {
    "name": "a",
    "projection": "orthographic",
    "width": 8,
    "height": 8,
    "world_from_camera": np.eye(4).ravel().tolist(),
    "half_width": 1.0,
    "near": 1.0,
    "far": 3.0,
}


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 1 << 40),
        ("width", 0),
        ("height", "8"),
        ("name", "a\n"),
        ("name", ".."),
        ("near", "1"),
        ("half_width", None),
        ("world_from_camera", 5),
        ("world_from_camera", [1e300] * 16),
        ("projection", 1),
    ],
)
def test_an_invalid_value_of_cameras_json_is_named(tmp_path, key, value):
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": [CAMERA]}))
    assert len(read_cameras(path)) == 1
    path.write_text(json.dumps({"cameras": [CAMERA | {key: value}]}))
    with pytest.raises(InputError) as caught:
        read_cameras(path)
    assert caught.value.cure
    assert key in caught.value.fact or "camera" in caught.value.fact


@pytest.mark.parametrize(
    "text",
    [
        "5",
        '{"axes": 5}',
        '{"axes": [[1, 0]], "sharpness": [1], "amplitudes": [[1, 1, 1]]}',
        '{"axes": [], "sharpness": [-1], "amplitudes": []}',
        '{"axes": [[0, 0, 1]], "sharpness": [], "amplitudes": []}',
        '{"axes": [[0, 0, 1e999]], "sharpness": [1], "amplitudes": [[1, 1, 1]]}',
    ],
)
def test_a_light_json_of_another_structure_is_refused(tmp_path, text):
    (tmp_path / "light.json").write_text(text)
    with pytest.raises(InputError, match="light.json") as caught:
        read_light(tmp_path / "light.json")
    assert caught.value.cure
