"""Refuse FIFOs, devices and sockets as inputs, without opening them: reading one may never end."""

import contextlib
import json
import os
import shutil
import signal
import socket

import numpy as np
import pytest

from gdtool.assets.load import load_scene
from gdtool.core.errors import InputError
from gdtool.core.folder import open_folder
from gdtool.core.sources import digest
from gdtool.diffusion.data.archives import object_count
from gdtool.folders.adapters import nerf, plain
from gdtool.folders.mesh import read_obj
from gdtool.folders.records import write_cameras
from gdtool.folders.views import read_views
from gdtool.images.io import read_image
from gdtool.shading.lights.load import load_environment
from tests.faults.test_paths_in_files import gltf, obj
from tests.fields.shapes import torus, views_folder, views_of

SECONDS = 10  # a reader that has opened a FIFO waits for ever


@pytest.fixture(autouse=True)
def ends():
    """Fail a test that hangs."""

    def late(*_):
        raise TimeoutError(f"still reading after {SECONDS} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@contextlib.contextmanager
def special(path, kind):
    """Put a FIFO, a link to an endless device, or a socket at a path."""
    if kind == "a FIFO":
        os.mkfifo(path)
        yield
    elif kind == "a device":
        path.symlink_to("/dev/zero")
        yield
    else:
        with socket.socket(socket.AF_UNIX) as listener:
            listener.bind(os.path.relpath(path))  # an address has a hundred characters at most
            yield


KINDS = ["a FIFO", "a device", "a socket"]
READERS = {
    "m.glb": load_scene,
    "m.gltf": load_scene,
    "m.obj": load_scene,
    "m.ply": load_scene,
    "m.stl": load_scene,
    "quads.obj": read_obj,
    "x.png": read_image,
    "x.exr": load_environment,
    "x.hdr": load_environment,
    "x.tar": object_count,
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", READERS)
def test_readers_refuse_special_files_without_opening_them(tmp_path, kind, name):
    with special(tmp_path / name, kind), pytest.raises(InputError, match=f"is {kind}, not a file") as caught:
        READERS[name](tmp_path / name)
    assert caught.value.cure


@pytest.mark.parametrize("kind", KINDS)
def test_digests_do_not_open_special_files(tmp_path, kind):
    for name in ("m.gltf", "m.obj"):
        with special(tmp_path / name, kind):
            digest(tmp_path / name)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["model.bin", "m.mtl", "t.png", "textures/t.png", "image.png"])
def test_special_files_that_a_model_refers_to_are_refused(tmp_path, kind, name):
    if name == "model.bin":
        path = gltf(tmp_path, buffer=name)
    elif name == "image.png":
        path = gltf(tmp_path, image=name)
    else:
        path = obj(tmp_path, texture="t.png")
    (tmp_path / name).unlink(missing_ok=True)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    with special(tmp_path / name, kind):
        with pytest.raises(InputError, match="link that leaves" if kind == "a device" else f"is {kind}, not a file"):
            load_scene(path)
        digest(path)


@pytest.mark.parametrize("name", ["color/front.png", "mask/front.png", "cameras.json", "depth/front.exr"])
def test_special_files_in_a_views_folder_are_refused(tmp_path, name):
    folder = views_folder(tmp_path / "a.asset" / "views", *views_of(torus, 16))
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(InputError, match="a FIFO"):
        read_views(open_folder(folder, check=False))


def test_special_files_in_folders_of_other_programs_are_refused(tmp_path):
    cameras, *_ = views_of(torus, 16)
    for name, read in (("plain", plain.read), ("nerf", nerf.read)):
        folder = tmp_path / name
        folder.mkdir()
        if name == "plain":
            write_cameras(folder / "cameras.json", cameras)
            (folder / "color").mkdir()
            os.mkfifo(folder / "color" / f"{cameras[0].name}.png")
        else:
            frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
            (folder / "transforms.json").write_text(json.dumps({"camera_angle_x": 1.0, "frames": frames}))
            os.mkfifo(folder / "a.png")
        with pytest.raises(InputError, match="a FIFO"):
            read(folder)
        shutil.rmtree(folder)
