"""Refuse small files that would take much memory, with a prediction and before they take it."""

import contextlib
import gzip
import io
import json
import subprocess
import sys
import tarfile
import tracemalloc

import numpy as np
import pytest

from gdtool.assets.gltf.document import GltfFile
from gdtool.assets.gltf.geometry_size import predicted_geometry
from gdtool.assets.gltf.nodes import visible_nodes
from gdtool.assets.gltf.read import read_gltf
from gdtool.assets.load import load_scene
from gdtool.core import memory
from gdtool.core.errors import InputError, ResourceError
from gdtool.core.folder import open_folder
from gdtool.diffusion.data import archives
from gdtool.diffusion.data.archives import object_count, unpack_views
from gdtool.folders.views import read_views
from gdtool.images import io as image_io
from gdtool.images.io import read_image, write_exr, write_png
from gdtool.shading.lights.load import load_environment
from tests.assets.gltf.files import QUAD, QUAD_FACES, Builder, quad
from tests.conftest import ROOT
from tests.fields.shapes import torus, views_folder
from tests.fields.shapes import views_of as seen


@pytest.fixture
def little_memory(monkeypatch):
    """Limit one input to 64 MiB, whatever machine the test runs on."""
    monkeypatch.setattr(memory, "max_input_bytes", lambda: 64 << 20)


def test_the_memory_for_one_input_follows_the_limit_of_the_process():
    """In a child process, because a limit cannot be raised again."""
    code = (
        "import resource; from gdtool.core.memory import max_input_bytes; a = max_input_bytes(); "
        "resource.setrlimit(resource.RLIMIT_AS, (1 << 30,) * 2); print(a > max_input_bytes() == 1 << 29)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT).stdout == "True\n"


def grid(side):
    """Make positions and vertex indices of a square grid of side² vertices."""
    x, y = np.meshgrid(*[np.linspace(0, 1, side, dtype=np.float32)] * 2)
    index = np.arange(side * side, dtype=np.uint32).reshape(side, side)
    corners = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    return np.stack([x, y, x * y], -1).reshape(-1, 3), np.stack([corners[i] for i in (0, 1, 2, 0, 2, 3)], -1).reshape(
        -1
    )


def instances(side, count, normals="all", skin=False):
    """Build a grid shown by `count` nodes, with normals on "all", on "half" or on "none" of them."""
    builder = Builder()
    positions, indices = grid(side)
    attributes = {"POSITION": builder.add(positions), "TEXCOORD_0": builder.add(positions[:, :2].copy())}
    if skin:
        attributes |= {
            "JOINTS_0": builder.add(np.zeros((len(positions), 4), np.uint8)),
            "WEIGHTS_0": builder.add(np.tile(np.float32([1, 0, 0, 0]), (len(positions), 1))),
        }
        builder.document["skins"] = [{"joints": [0]}]
    normal = {} if normals == "none" else {"NORMAL": builder.add(np.tile(np.float32([0, 0, 1]), (len(positions), 1)))}
    builder.primitive(attributes | normal, faces := builder.add(indices))
    builder.document["meshes"].append({"primitives": [{"attributes": attributes, "indices": faces}]})
    builder.document["nodes"] = [
        {"mesh": int(normals == "half" and i % 2), "translation": [i, 0, 0], **({"skin": 0} if skin else {})}
        for i in range(count)
    ]
    builder.document["scenes"] = [{"nodes": list(range(count))}]
    return builder


@pytest.mark.parametrize(
    ("side", "count", "normals", "skin"),
    [
        (150, 16, "all", False),
        (150, 16, "none", False),
        (150, 16, "half", False),
        (300, 1, "all", False),
        (300, 1, "all", True),
        (4, 500, "all", False),
    ],
)
def test_the_predicted_memory_of_a_gltf_bounds_what_reading_takes(tmp_path, side, count, normals, skin):
    path = instances(side, count, normals, skin).write(tmp_path / "x.glb")
    file = GltfFile(path)
    predicted = predicted_geometry(file, visible_nodes(file))
    del file
    tracemalloc.start()
    scene = read_gltf(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert predicted.faces == len(scene.faces)
    assert predicted.parts == count
    if normals != "half":  # parts without normals then get vertices of their own
        assert predicted.vertices == len(scene.vertices)
    assert peak < predicted.size < 3.5 * peak


@pytest.mark.parametrize("name", ["x.glb", "x.gltf"])
def test_many_instances_are_refused_before_a_buffer_is_read(tmp_path, little_memory, name):
    """The buffer of the .gltf does not exist: opening it would be another error."""
    builder = instances(64, 2000)
    path = tmp_path / name
    if name == "x.glb":
        builder.write(path)
    else:
        builder.document["buffers"] = [{"byteLength": len(builder.binary), "uri": "absent.bin"}]
        path.write_text(json.dumps(builder.document))
    with pytest.raises(
        ResourceError, match=r"8,192,000 vertices, 15,876,000 faces in 2,000 instances\) would take \d+\.\d GiB"
    ) as caught:
        load_scene(path)
    assert caught.value.cure


def test_accessors_without_buffer_views_count_towards_the_prediction(tmp_path, little_memory):
    builder = quad()
    for accessor in builder.document["accessors"]:
        del accessor["bufferView"]
        accessor["count"] = 2_000_000
    with pytest.raises(ResourceError, match="GiB"):
        load_scene(builder.write(tmp_path / "x.glb"))


def test_a_json_of_too_many_objects_is_refused(tmp_path, little_memory):
    path = tmp_path / "x.gltf"
    path.write_text('{"asset": {"version": "2.0"}, "nodes": [' + "{}," * 200_000 + "{}]}")
    with pytest.raises(ResourceError, match="200,003 objects"):
        load_scene(path)


@pytest.mark.parametrize(
    "roots", [[0] * 100_000, list(range(20_000))], ids=["one root again and again", "each node of a chain"]
)
def test_a_scene_that_reaches_a_node_twice_is_refused(tmp_path, roots):
    """Otherwise 20,000 nodes would be visited 200 million times."""
    builder = quad()
    builder.document["nodes"] = [{"mesh": 0, "children": [i + 1]} for i in range(19_999)] + [{"mesh": 0}]
    builder.document["scenes"] = [{"nodes": roots}]
    with pytest.raises(InputError, match="twice"):
        load_scene(builder.write(tmp_path / "x.glb"))


def test_overlapping_buffer_views_are_not_copied(tmp_path):
    """A hundred buffer views of the same 8 MiB take 8 MiB."""
    builder = Builder()
    whole = builder.view(QUAD.tobytes() + QUAD_FACES.tobytes() + bytes(8 << 20))
    length = builder.document["bufferViews"][whole]["byteLength"]
    for i in range(100):
        builder.document["bufferViews"].append({"buffer": 0, "byteOffset": 0, "byteLength": length})
        builder.document["accessors"] += [
            {"bufferView": i, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": i, "byteOffset": QUAD.nbytes, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ]
        builder.primitive({"POSITION": 2 * i}, 2 * i + 1)
    path = builder.write(tmp_path / "x.glb")
    tracemalloc.start()
    assert len(load_scene(path).faces) == 200
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40 << 20


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.stl"])
def test_a_file_too_large_for_the_memory_is_not_read(tmp_path, little_memory, name):
    with (tmp_path / name).open("wb") as file:
        file.truncate(200 << 20)
    with pytest.raises(ResourceError, match="GiB"):
        load_scene(tmp_path / name)


def test_the_memory_of_all_textures_of_a_model_is_summed(tmp_path, little_memory):
    (tmp_path / "x.obj").write_text(
        "mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\n" + "".join(f"usemtl m{i}\nf 1/1 2/1 3/1\n" for i in range(8))
    )
    (tmp_path / "x.mtl").write_text("".join(f"newmtl m{i}\nmap_Kd {i}.png\n" for i in range(8)))
    for i in range(8):
        write_png(tmp_path / f"{i}.png", np.full((2048, 2048, 3), i, np.uint8))
    with pytest.raises(ResourceError, match=r"the texture 5.png and those before it"):
        load_scene(tmp_path / "x.obj")


def test_merging_a_high_and_a_wide_map_is_refused_when_the_result_is_too_large(tmp_path, little_memory):
    write_png(tmp_path / "high.png", np.zeros((4096, 1), np.uint8))
    write_png(tmp_path / "wide.png", np.zeros((1, 4096), np.uint8))
    (tmp_path / "x.obj").write_text("mtllib x.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl m\nf 1/1 2/1 3/1\n")
    (tmp_path / "x.mtl").write_text("newmtl m\nmap_Pr high.png\nmap_Pm wide.png\n")
    with pytest.raises(ResourceError, match="4096x4096"):
        load_scene(tmp_path / "x.obj")


def exr(path, width, height, names, kind="float", value=0.5):
    """Write an EXR of one value with channels of the given names."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(width, height, len(names), kind)
    spec.channelnames = tuple(names)
    spec["compression"] = "zip"
    out = oiio.ImageOutput.create(str(path))
    rows = np.full((256, width, len(names)), value, np.float32)
    assert out.open(str(path), spec)
    assert all(out.write_scanlines(y, min(y + 256, height), 0, rows[: height - y]) for y in range(0, height, 256))
    assert out.close()


@pytest.mark.parametrize(
    ("names", "kind", "most"),
    [
        ("RGBA", "float", 1.5),
        ("RGBA", "half", 1.5),
        ("Y", "float", 1.5),
        (["R", "G", "B", *(f"layer.{i}" for i in range(20))], "float", 1.8),
    ],
    ids=["RGBA", "half", "grey", "layers"],
)
def test_reading_an_exr_takes_little_more_memory_than_its_pixels(tmp_path, names, kind, most):
    """In a child process, for its peak memory; most: that peak over the bytes of the picture."""
    width = 2048 if len(names) > 4 else 4096
    exr(tmp_path / "x.exr", width, width // 2, list(names), kind)
    code = (
        "import resource, sys, numpy, OpenImageIO; from gdtool.images.io import read_image; size = lambda: "
        "resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024\n"
        "before = size(); image = read_image(sys.argv[1]); print((size() - before) / image.nbytes)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "x.exr")], capture_output=True, text=True, cwd=ROOT
    )
    extra = 30e6 / (width * width // 2 * min(len(names), 4 if "A" in names else 3) * 4)  # what the library itself takes
    assert float(done.stdout) < most + extra, done.stderr


def test_only_the_colour_channels_of_an_exr_are_read(tmp_path):
    exr(tmp_path / "x.exr", 64, 32, ["Z.depth", "B", "G", "R", "A", "extra"])
    exr(tmp_path / "y.exr", 64, 32, "RGBA")
    assert np.array_equal(read_image(tmp_path / "x.exr"), read_image(tmp_path / "y.exr"))
    assert read_image(tmp_path / "x.exr").shape == (32, 64, 4)


def test_the_memory_of_reading_a_picture_is_predicted(tmp_path, little_memory, monkeypatch):
    write_exr(tmp_path / "x.exr", np.zeros((1200, 2048, 4), np.float32))
    with pytest.raises(ResourceError, match=r"2048x1200 pixels in 4 channels would take 0\.1 GiB of memory"):
        read_image(tmp_path / "x.exr")
    monkeypatch.setattr(memory, "max_input_bytes", lambda: 1 << 40)
    monkeypatch.setattr(image_io, "MAX_HELD", 32 << 20)
    with pytest.raises(ResourceError, match=r"more than the 0\.0 GiB"):
        read_image(tmp_path / "x.exr")


def test_channels_that_are_not_read_count_towards_the_limit_of_bytes(tmp_path, monkeypatch):
    exr(tmp_path / "x.exr", 256, 256, ["R", "G", "B", *(f"c{i}" for i in range(80))])
    assert read_image(tmp_path / "x.exr").shape == (256, 256, 3)
    monkeypatch.setattr(image_io, "MAX_BYTES", 16 << 20)
    with pytest.raises(ResourceError, match="larger than gdtool reads|83 channels"):
        read_image(tmp_path / "x.exr")


def test_an_environment_too_large_for_the_memory_is_refused(tmp_path, little_memory):
    write_exr(tmp_path / "x.exr", np.full((768, 1536, 3), 0.5, np.float32))
    with pytest.raises(ResourceError, match="light of 1536x768 pixels"):
        load_environment(tmp_path / "x.exr")


def test_the_memory_of_all_views_of_a_folder_is_summed(tmp_path, monkeypatch):
    folder = open_folder(views_folder(tmp_path / "a.asset" / "views", *seen(torus, 32)))
    monkeypatch.setattr(memory, "max_input_bytes", lambda: 1 << 19)
    with pytest.raises(ResourceError, match="6 views of 32x32 pixels"):
        read_views(folder)


def packed(path, members, mode="w", **how):
    """Write a tar of (name, content) pairs."""
    with tarfile.open(path, mode, **how) as tar:
        for name, content in members:
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return path


def refused(archive, work, kind, fact):
    """Check that counting and unpacking both refuse an archive in one line, and that nothing is left in `work`."""
    for use in (lambda: object_count(archive), lambda: list(unpack_views(archive, work))):
        with pytest.raises(kind, match=fact) as caught:
            use()
        assert caught.value.cure
        assert "\n" not in str(caught.value)
    assert list(work.iterdir()) == []


@pytest.fixture
def work(tmp_path):
    (tmp_path / "work").mkdir()
    return tmp_path / "work"


def test_an_archive_with_a_sparse_member_is_refused(tmp_path, work):
    """The archive of some kilobytes would unpack to 1 GiB of zeros."""
    with (tmp_path / "manifest.json").open("wb") as file:
        file.truncate(1 << 30)
    subprocess.run(["tar", "-c", "--sparse", "-f", "a.tar", "manifest.json"], check=True, cwd=tmp_path)
    assert (tmp_path / "a.tar").stat().st_size < 100_000
    refused(tmp_path / "a.tar", work, InputError, "sparse")


def test_an_archive_of_high_compression_ratio_is_refused(tmp_path, work):
    packed(tmp_path / "a.tar", [("a/views/manifest.json", bytes(100 << 20))], "w:gz")
    assert (tmp_path / "a.tar").stat().st_size < 200_000
    refused(tmp_path / "a.tar", work, ResourceError, "times its own size")


def test_an_archive_of_too_many_members_is_refused(tmp_path, work, monkeypatch):
    packed(tmp_path / "a.tar", [(f"a/views/color/{i}.png", b"") for i in range(30)])
    monkeypatch.setattr(archives, "MAX_MEMBERS", 20)
    refused(tmp_path / "a.tar", work, ResourceError, "20 members")
    monkeypatch.setattr(archives, "MAX_MEMBERS", 100)
    monkeypatch.setattr(archives, "MAX_OBJECT_MEMBERS", 20)
    with pytest.raises(ResourceError, match="20 files"):
        list(unpack_views(tmp_path / "a.tar", work))


def test_an_object_of_too_many_bytes_is_refused_before_it_is_unpacked(tmp_path, work, monkeypatch):
    packed(tmp_path / "a.tar", [("a/views/color/0.png", bytes(1000)), ("a/views/color/1.png", bytes(1000))])
    monkeypatch.setattr(archives, "MAX_OBJECT_BYTES", 1500)
    with pytest.raises(ResourceError, match="unpack more than"):
        list(unpack_views(tmp_path / "a.tar", work))
    assert list(work.iterdir()) == []


def header(name, kind, size):
    """Make the header of an archive's member."""
    member = tarfile.TarInfo(name)
    member.type, member.size = kind, size
    return member.tobuf(tarfile.GNU_FORMAT)


def test_a_large_extended_header_of_an_archive_is_not_read(tmp_path, work):
    with gzip.open(tmp_path / "a.tar", "wb") as file:
        file.write(header("x", tarfile.GNUTYPE_LONGNAME, 1 << 30))
        for _ in range(64):
            file.write(bytes(1 << 20))
    tracemalloc.start()
    refused(tmp_path / "a.tar", work, InputError, "extended header")
    assert tracemalloc.get_traced_memory()[1] < 20 << 20
    tracemalloc.stop()


MALFORMED = {
    "empty": b"",
    "text": b"no tar at all" * 100,
    "zeros then text": bytes(700) + b"x" * 900,
    "half a header": header("a", tarfile.REGTYPE, 5)[:300],
    "cut content": header("a/views/manifest.json", tarfile.REGTYPE, 5000) + b"x" * 700,
    "bad checksum": header("a", tarfile.REGTYPE, 5).replace(b"a", b"b", 1),
    "negative size": header("a", tarfile.REGTYPE, 5).replace(b"00000000005", b"-0000000005"),
    "chain of headers": header("a", tarfile.XHDTYPE, 0) * 3000,
    "cut gzip": gzip.compress(header("a/views/manifest.json", tarfile.REGTYPE, 5000) + bytes(6000))[:60],
    "bad gzip": b"\x1f\x8b\x08\x00" + b"x" * 900,
    "bad xz": b"\xfd7zXZ\x00" + b"x" * 900,
    "bad bzip2": b"BZh9" + b"x" * 900,
    "PAX words": header("p", tarfile.XHDTYPE, 20) + b"99999999 path=x\n    " + bytes(492),
    "PAX size": header("p", tarfile.XHDTYPE, 20)
    + b"20 size=notanumber\n\0"
    + bytes(492)
    + header("a", tarfile.REGTYPE, 5),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_a_malformed_archive_is_refused_in_one_line(tmp_path, work, name):
    """Unpacking without counting first is refused too, or finds no object."""
    (tmp_path / "a.tar").write_bytes(MALFORMED[name])
    with pytest.raises(InputError, match="a.tar: (is not a whole tar file|holds no views folder)") as caught:
        object_count(tmp_path / "a.tar")
    assert caught.value.cure
    assert "\n" not in str(caught.value)
    with contextlib.suppress(InputError):
        assert list(unpack_views(tmp_path / "a.tar", work)) == []
    assert list(work.iterdir()) == []
