"""Refuse damaged and foreign model folders before any code in them could run."""

import json
import pickle
import shutil
import struct

import pytest
from safetensors.numpy import load_file, save_file

from gdtool.images.io import write_png
from tests.faults.files import lines_of
from tests.faults.test_images import ball
from tests.stages.test_sample_views import tiny_model, write_manifest  # noqa: F401  (a fixture)


class Trap:
    """Create a folder when it is unpickled."""

    def __reduce__(self):
        import os

        return os.mkdir, ("trap-sprung",)


def weights(folder):
    """Find the safetensors file of a model folder."""
    return next(folder.glob("*.safetensors"))


def as_pickle(folder):
    """Replace the weights by a pickle."""
    weights(folder).write_bytes(pickle.dumps(Trap()))


def only_pickle(folder):
    """Leave only a pickle."""
    (folder / "model.bin").write_bytes(pickle.dumps(Trap()))
    weights(folder).unlink()


def truncated(folder):
    """Cut the weights short."""
    path = weights(folder)
    path.write_bytes(path.read_bytes()[:-100])


def overlapping(folder):
    """Let two tensors share bytes."""
    path = weights(folder)
    content = path.read_bytes()
    size = struct.unpack("<Q", content[:8])[0]
    header = json.loads(content[8 : 8 + size])
    names = [name for name in header if name != "__metadata__"]
    first, second = sorted(names, key=lambda n: header[n]["data_offsets"])[:2]
    header[second]["data_offsets"][0] -= 4
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + content[8 + size :])


def changed(change):
    """Make a damage that changes one tensor."""

    def damage(folder):
        tensors = load_file(weights(folder))
        name = sorted(tensors)[0]
        tensors[name] = change(tensors[name])
        save_file(tensors, weights(folder))

    return damage


@pytest.mark.parametrize(
    "damage, word",
    [
        (as_pickle, "safetensors"),
        (only_pickle, "safetensors"),
        (truncated, ""),
        (overlapping, ""),
        (changed(lambda x: x * float("nan")), "finite"),
        (changed(lambda x: x.reshape(-1)[:1]), "shape"),
    ],
    ids=["pickle", "only pickle", "truncated", "overlapping", "nan", "shape"],
)
def test_a_damaged_model_folder_is_refused_in_one_line(gdtool, tmp_path, tiny_model, damage, word):  # noqa: F811
    shutil.copytree(tiny_model, tmp_path / "model")
    damage(tmp_path / "model")
    write_manifest(tmp_path / "model")
    write_png(tmp_path / "ball.png", ball() / 255)
    done = gdtool("sample-views", "ball.png", "--model", "model", "--steps", 1, "-q")
    errors = lines_of(done.stderr)
    assert done.returncode == 3, done.stderr
    assert len(errors) == 1, done.stderr
    assert "model" in errors[0], done.stderr
    assert word in errors[0], done.stderr
    assert not (tmp_path / "trap-sprung").exists()
    assert not (tmp_path / "ball.asset/views").exists()
