"""Run gdtool import-views on folders as Wonder3D, NeRF tools and a user write them."""

import json

import numpy as np
import pytest

from gdtool.cameras import camera_at, rig
from gdtool.core.folder import open_folder
from gdtool.folders.adapters import ADAPTERS, adapter
from gdtool.folders.records import write_cameras
from gdtool.folders.surface import read_surface
from gdtool.folders.views import read_views
from gdtool.images.color import encode_normal, srgb_from_linear
from gdtool.images.io import write_exr, write_png
from tests.fields.shapes import sphere, views_of

SIZE = 64


def lopsided(points):
    """Measure the distance to a ball with a smaller one in front at the upper right, which has no symmetry."""
    return np.minimum(sphere(points, 0.3), sphere(points - [0.28, 0.18, 0.22], 0.15))


@pytest.fixture(scope="module")
def wonder3d_pictures():
    return views_of(lopsided, SIZE, 2, rig("wonder3d", SIZE))


@pytest.fixture(scope="module")
def turntable():
    cameras = [camera_at(45 * i, 25, name=f"{i:03d}", size=SIZE, distance=3, fov_degrees=30) for i in range(8)]
    return views_of(lopsided, SIZE, 2, cameras)


def rgba(images, mask, k):
    return np.concatenate([srgb_from_linear(np.clip(images["color"][k], 0, 1)), mask[k][..., None]], -1)


@pytest.fixture
def wonder3d(tmp_path, wonder3d_pictures):
    folder = tmp_path / "owl"
    folder.mkdir()
    cameras, images, mask = wonder3d_pictures
    for k, camera in enumerate(cameras):
        # The front camera's axes, which are this world's.
        write_png(
            folder / f"normals_000_{camera.name}.png",
            np.concatenate([encode_normal(images["normal"][k]), mask[k][..., None]], -1),
        )
        write_png(folder / f"rgb_000_{camera.name}.png", rgba(images, mask, k))
    return folder


@pytest.fixture
def nerf(tmp_path, turntable):
    folder = tmp_path / "lego"
    folder.mkdir()
    cameras, images, mask = turntable
    z_up = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    frames = []
    for k, camera in enumerate(cameras):
        pose = z_up @ camera.world_from_camera
        pose[:3, 3] = 2 * pose[:3, 3] + (3, 1, -2)  # another scale, off the origin
        write_png(folder / f"r_{k}.png", rgba(images, mask, k))
        frames.append({"file_path": f"./r_{k}", "transform_matrix": pose.tolist()})
    (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": float(np.radians(30)), "frames": frames}))
    return folder


@pytest.fixture
def plain(tmp_path, turntable):
    folder = tmp_path / "plain"
    (folder / "depth").mkdir(parents=True)
    cameras, images, mask = turntable
    write_cameras(folder / "cameras.json", cameras)
    for k, camera in enumerate(cameras):
        write_png(folder / f"{camera.name}.png", rgba(images, mask, k))
        write_exr(folder / "depth" / f"{camera.name}.exr", images["depth"][k])
    return folder


def error(vertices, source_from_world):
    """Measure the mean distance of vertices from the solid, in the frame of the fixtures."""
    m = np.array(source_from_world).reshape(4, 4)
    return np.abs(lopsided(vertices @ m[:3, :3].T + m[:3, 3])).mean()


def reconstructed(gdtool, folder):
    done = gdtool("import-views", folder)
    assert done.returncode == 0, done.stderr
    views = done.stdout.strip()
    assert gdtool("validate", views).returncode == 0
    done = gdtool("reconstruct", stdin=done.stdout)
    assert done.returncode == 0, done.stderr
    opened = open_folder(done.stdout.strip())
    return open_folder(views), read_surface(opened), opened.content.source_from_world


def test_wonder3d_is_neither_mirrored_nor_turned(gdtool, wonder3d):
    views, surface, back = reconstructed(gdtool, wonder3d)
    assert views.path.name == "views"
    assert views.path.parent.name == "owl.asset"
    assert views.content.domains == ("color", "normal")
    assert error(surface.vertices, back) < 0.013  # normals and silhouettes alone; a mirrored one is off by far more
    assert all(error(surface.vertices * flip, back) > 0.02 for flip in ((-1, 1, 1), (1, -1, 1), (1, 1, -1)))
    assert np.ptp(surface.vertices, axis=0).max() == pytest.approx(1, abs=0.04)
    front = read_views(views)
    k = front.names.index("front")
    middle = front.images["normal"][k][SIZE // 2, SIZE // 3]
    assert middle @ lopsided_normal(np.array([-0.2, 0.0, 0.22])) > 0.9


def lopsided_normal(point):
    return point / np.linalg.norm(point)


def test_nerf_world_is_turned_scaled_and_centred(gdtool, nerf):
    views, surface, back = reconstructed(gdtool, nerf)
    assert views.content.domains == ("color",)
    m = np.array(back).reshape(4, 4)
    source = surface.vertices @ m[:3, :3].T + m[:3, 3]
    in_fixture_frame = (source - (3, 1, -2)) / 2  # the inverse of what the fixture did, Z up
    in_fixture_frame = np.stack([in_fixture_frame[:, 0], in_fixture_frame[:, 2], -in_fixture_frame[:, 1]], -1)
    # Silhouettes alone: a hull, around the solid.
    assert np.abs(lopsided(in_fixture_frame)).mean() < 0.03
    assert np.abs(surface.vertices.max(0) + surface.vertices.min(0)).max() < 0.1


def test_plain_folder_keeps_depth_in_units(gdtool, plain):
    views, surface, back = reconstructed(gdtool, plain)
    assert set(views.content.domains) == {"color", "depth"}
    assert error(surface.vertices, back) < 0.008
    as_it_was = gdtool("import-views", plain, "--no-normalize", "-o", "same")
    assert as_it_was.returncode == 0
    assert np.allclose(open_folder("same").content.source_from_world, np.eye(4).ravel())


def test_up_to_date_dry_run_json_and_changed_picture(gdtool, plain, tmp_path):
    done = gdtool("import-views", plain, "--dry-run")
    assert done.returncode == 0
    assert not (tmp_path / "plain.asset").exists()
    done = gdtool("import-views", plain, "--json")
    assert done.returncode == 0
    assert json.loads(done.stdout)["folder"].endswith("views")
    assert "up to date" in gdtool("import-views", plain).stderr
    (plain / "000.png").write_bytes((plain / "001.png").read_bytes())
    assert "source changed" in gdtool("import-views", plain).stderr


def test_bad_input_is_one_line_and_leaves_nothing(gdtool, wonder3d, nerf, plain, tmp_path):
    (tmp_path / "nothing").mkdir()
    (wonder3d / "normals_000_back.png").unlink()
    record = json.loads((nerf / "transforms.json").read_text())
    (nerf / "transforms.json").write_text(json.dumps(record | {"k1": 0.3}))
    (plain / "cameras.json").write_text("{}")
    for folder, word in (
        (tmp_path / "nothing", "transforms.json"),
        (wonder3d, "back"),
        (nerf, "distorted"),
        (plain, "cameras.json"),
        (tmp_path / "missing", "does not exist"),
    ):
        done = gdtool("import-views", folder, "--quiet")
        assert done.returncode == 3, done.stderr
        assert word in done.stderr, done.stderr
        assert done.stdout == "", done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
        assert "Traceback" not in done.stderr
        assert not (tmp_path / f"{folder.name}.asset" / "views").exists()
    assert gdtool("import-views").returncode == 2
    assert gdtool("import-views", nerf, "--format", "obj").returncode == 2


def test_every_adapter_has_the_interface(tmp_path):
    for name in ADAPTERS:
        module = __import__(f"gdtool.folders.adapters.{name}", fromlist=["read"])
        assert callable(module.read)
        assert not module.recognises(tmp_path)
        assert module.LOOKS_LIKE
    with pytest.raises(Exception, match="transforms.json"):
        adapter(tmp_path)
