"""Write each kind of folder and read it again, to the precision that its page promises."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gdtool.cameras import camera_at, rig
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.manifest import Manifest
from gdtool.core.stage import Output
from gdtool.folders.mesh import read_obj, write_obj
from gdtool.folders.records import read_cameras, read_light, write_cameras, write_light
from gdtool.folders.surface import Surface, read_surface, write_surface, write_surface_ply
from gdtool.folders.views import Views, read_views, write_views
from gdtool.geometry.meshes import QuadMesh
from gdtool.geometry.topology import triangulated

CUBE = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float) - 0.5
QUADS = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]], np.int32)


def written(kind, write):
    path = Path(kind)
    path.mkdir()
    out = Output(path, Path("work"), 1, "cpu")
    write(out)
    return Folder(path, Manifest(kind=kind, name="x", stage="test", content=out.content, files=()))


def random_views(size=16):
    rng = np.random.default_rng(0)
    cameras = rig("six", size)
    mask = (rng.random((6, size, size)) > 0.3).astype(np.float32)
    normal = rng.standard_normal((6, size, size, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    images = {
        "color": rng.random((6, size, size, 3)),
        "normal": normal,
        "depth": rng.uniform(1.2, 2.8, (6, size, size)),
        "albedo": rng.random((6, size, size, 3)),
        "roughness": rng.random((6, size, size)),
        "metallic": rng.random((6, size, size)),
    }
    images = {k: (v * (mask[..., None] if v.ndim == 4 else mask)).astype(np.float32) for k, v in images.items()}
    light = {"axes": np.eye(3), "sharpness": [1.0, 10.0, 100.0], "amplitudes": np.ones((3, 3)), "environment": "mid"}
    return Views(cameras, images, mask, light)


def test_views_are_read_as_written_within_their_quantisation():
    views = random_views()
    folder = written("views", lambda out: write_views(out, views, exposure=2.0))
    assert folder.content.domains == ("color", "normal", "depth", "albedo", "roughness", "metallic")
    assert folder.content.exposure == 2
    back = read_views(folder)
    inside = views.mask > 0
    assert np.array_equal(back.mask, views.mask)
    assert np.array_equal(back.images["depth"], views.images["depth"])
    cosine = (back.images["normal"] * views.images["normal"]).sum(-1)[inside]
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.05
    for domain, bound in (("roughness", 0.5 / 255), ("metallic", 0.5 / 255), ("albedo", 0.005), ("color", 0.005)):
        assert np.abs(back.images[domain] - views.images[domain]).max() <= bound + 1e-6, domain
    assert np.allclose(back.light["sharpness"], [1, 10, 100])
    assert set(read_views(folder, ("depth",)).images) == {"depth"}


def test_views_of_another_size_than_their_camera_are_refused():
    folder = written("views", lambda out: write_views(out, random_views()))
    write_cameras(folder.file("cameras.json"), rig("six", 32))
    with pytest.raises(InputError, match="is 16x16, its camera 32x32"):
        read_views(folder)


def test_cameras_are_read_as_written_and_bad_ones_refused():
    cameras = [camera_at(20, 10, name="a", size=8, fov_degrees=40), *rig("wonder3d", 8)]
    write_cameras(Path("c.json"), cameras)
    for before, after in zip(cameras, read_cameras(Path("c.json")), strict=True):
        assert np.allclose(before.world_from_camera, after.world_from_camera, atol=1e-15)
        assert before.fx == after.fx
        assert before.name == after.name
    text = Path("c.json").read_text()
    for old, new, words in (
        ('"near": 1.0', '"near": 9.0', "near 9 is not below far"),
        ('"half_width": 0.675', '"half_width": 0.0', "half_width"),
        ('"name": "left"', '"name": "right"', "one name"),
        ('"projection": "ortho', '"projection": "fish', "projection"),
    ):
        Path("bad.json").write_text(text.replace(old, new, 1))
        with pytest.raises(InputError, match=words):
            read_cameras(Path("bad.json"))


def test_light_is_read_as_written():
    light = {
        "axes": np.eye(3)[:2],
        "sharpness": np.array([0.0, 5.0]),
        "amplitudes": np.ones((2, 3)),
        "fit_error": {"rms": 0.1},
    }
    write_light(Path("l.json"), light)
    assert np.array_equal(read_light(Path("l.json"))["axes"], light["axes"])
    assert read_light(Path("l.json"))["fit_error"] == {"rms": 0.1}


def test_surfaces_are_read_as_written_and_missing_properties_get_defaults():
    triangles = triangulated(QUADS)[0]
    n = len(CUBE)
    surface = Surface(
        CUBE,
        triangles,
        np.linspace(0, 1, n * 3).reshape(n, 3),
        np.linspace(0, 1, n),
        np.linspace(1, 0, n),
        np.full(n, 0.5),
    )
    folder = written("surface", lambda out: write_surface(out, surface, watertight=True))
    back = read_surface(folder)
    assert np.allclose(back.vertices, CUBE)
    assert np.array_equal(back.faces, triangles)
    assert np.abs(back.albedo - surface.albedo).max() < 0.005
    assert np.allclose(back.roughness, surface.roughness)
    # A cube's corners point outward.
    assert np.allclose(back.normals, CUBE / np.linalg.norm(CUBE, axis=1, keepdims=True), atol=1e-6)
    assert back.views is None
    assert back.residual is None
    seen = replace(surface, views=np.arange(n), residual=np.linspace(0, 0.7, n, dtype=np.float32))
    write_surface_ply(folder.file("surface.ply"), seen)
    back = read_surface(folder)
    assert np.array_equal(back.views, seen.views)
    assert np.array_equal(back.residual, seen.residual)
    assert np.allclose(back.confidence, 0.5)
    bare = (
        b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float "
        b"z\n"
        b"element face 1\nproperty list uchar uint vertex_indices\nend_header\n"
        + CUBE[:3].astype("<f4").tobytes()
        + b"\x03"
        + np.arange(3, dtype="<u4").tobytes()
    )
    folder.file("surface.ply").write_bytes(bare)
    back = read_surface(folder)
    assert back.normals is None
    assert np.allclose(back.albedo, 0.8)
    assert back.roughness[0] == 0.5
    assert back.confidence[0] == 0
    folder.file("surface.ply").write_bytes(bare[:-2])
    with pytest.raises(InputError, match="length"):
        read_surface(folder)


def test_quads_are_read_as_written_with_texture_coordinates():
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    mesh = QuadMesh(CUBE, QUADS, uv, np.tile(np.arange(4, dtype=np.int32), (6, 1)))
    write_obj(Path("m.obj"), mesh)
    assert "vt 0 1" in Path("m.obj").read_text()  # the image's top left is OBJ's (0, 1)
    back = read_obj(Path("m.obj"))
    assert np.array_equal(back.faces, QUADS)
    assert np.array_equal(back.face_uvs, mesh.face_uvs)
    assert np.allclose(back.uv, uv)
    mixed = QuadMesh(CUBE, np.concatenate([QUADS[:5], [[1, 3, 7, -1], [1, 7, 5, -1]]]).astype(np.int32))
    write_obj(Path("m.obj"), mixed)
    assert np.array_equal(read_obj(Path("m.obj")).faces, mixed.faces)


@pytest.mark.parametrize(
    "text, words",
    [
        ("v 0 0 0\nf 1 2 3\n", "out of range"),
        ("v 0 0\n", "line 1"),
        ("v 0 0 0\n", "no faces"),
        ("v 0 0 nan\nv 0 0 0\nv 1 0 0\nf 1 2 3\n", "not finite"),
    ],
)
def test_faulty_obj_is_refused(text, words):
    Path("m.obj").write_text(text)
    with pytest.raises(InputError, match=words):
        read_obj(Path("m.obj"))
