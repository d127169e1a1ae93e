"""Check before any work what a run would need only at its end."""

import dataclasses
import importlib
import importlib.util
import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from gdtool.core.errors import ResourceError
from gdtool.core.stage import Inputs
from gdtool.images.io import write_exr, write_png
from gdtool.stages import bake, early, relight, remesh, render_dataset, sample_views, train
from tests.faults.files import leftovers, lines_of, quad_cube


@pytest.fixture
def no_work(monkeypatch):
    """Fail the test if a stage begins to work."""
    for stage in (bake, relight, remesh, render_dataset, sample_views, train):

        def run(*_):
            pytest.fail("the run has begun")

        monkeypatch.setattr(
            importlib.import_module("gdtool.commands." + stage.__name__.rpartition(".")[2]),
            "command",
            importlib.import_module("gdtool.commands._stage_command").stage_command(
                dataclasses.replace(stage.STAGE, run=run), "x"
            ),
        )


@pytest.fixture
def files(tmp_path):
    """Make the sources and options' files in the working folder."""
    quad_cube(tmp_path / "cube.obj", 4)
    write_png(tmp_path / "ball.png", np.full((64, 64, 4), 200, np.uint8))
    write_png(tmp_path / "small.png", np.full((32, 40), 255, np.uint8))
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    write_exr(tmp_path / "light.exr", np.ones((8, 16, 3), np.float32))
    write_exr(tmp_path / "black.exr", np.zeros((8, 16, 3), np.float32))
    (tmp_path / "text.exr").write_text("no picture")
    (tmp_path / "notes.txt").write_text("no model")
    (tmp_path / "wrong.json").write_text('{"model": {"patch": "four"}}')
    os.mkfifo(tmp_path / "pipe.exr")
    return tmp_path


@pytest.mark.parametrize(
    "line, code, words",
    [
        ("relight cube.obj --env nothing.exr", 3, "nothing.exr: does not exist; use dark, mid, bright"),
        ("relight cube.obj --env square.exr", 3, "square.exr: is 8x8"),
        ("relight cube.obj --env text.exr", 3, "text.exr"),
        ("relight cube.obj --env ball.png", 3, "ball.png: is not a high dynamic range image"),
        ("relight cube.obj --env pipe.exr", 3, "pipe.exr: is a FIFO"),
        ("relight cube.obj --env .", 3, "is a folder"),
        ("relight cube.obj --env random:x", 2, "--env random:x: is not random:NUMBER"),
        (f"relight cube.obj --env random:{2**64}", 2, "64-bit number"),
        ("relight cube.obj --fov 1e-9", 2, "use --fov 0, which is orthographic"),
        ("relight cube.obj --budget 1 --target-psnr 30", 2, "leave one of them out"),
        ("render-dataset cube.obj --light nothing.exr", 3, "nothing.exr: does not exist"),
        ("render-dataset cube.obj --domains colour", 2, "choose from color"),
        ("remesh cube.obj --quad-size 1e-300", 2, "is smaller than 1e-05"),
        ("bake cube.obj --device cuda", 5, "gdtool: --device cuda: is not there; use --device cpu"),
        ("bake cube.obj --model nothing.glb", 3, "nothing.glb: does not exist; check the path that --model gives"),
        ("bake cube.obj --model notes.txt", 3, "notes.txt: does not have the suffix of a model file"),
        ("bake cube.obj", 3, "name one with --surface or --model"),
        ("bake cube.obj --surface nothing", 3, "nothing: does not exist"),
        (
            "sample-views ball.png --mask nothing.png",
            3,
            "nothing.png: does not exist; check the path that --mask gives",
        ),
        ("sample-views ball.png --mask small.png", 3, "small.png: is 40x32, the image 64x64; scale it to 64x64"),
        ("sample-views ball.png --mask text.exr", 3, "text.exr"),
        (
            "sample-views ball.png --matting nothing.onnx",
            3,
            "nothing.onnx: does not exist; check the path that --matting gives",
        ),
        ("sample-views ball.png --model nothing", 3, "nothing: does not exist"),
    ],
    ids=lambda value: value if isinstance(value, str) and " " in value and ":" not in value else "",
)
def test_options_used_only_at_the_end_are_checked_before_any_work(
    gdtool_here, no_work, files, monkeypatch, line, code, words
):
    import torch

    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    before = sorted(files.iterdir())
    done = gdtool_here(*line.split(), "-o", "out")
    assert done.returncode == code, done.stderr
    assert words in done.stderr, done.stderr
    assert done.stdout == "", done.stderr
    assert len(lines_of(done.stderr)) == 1
    assert sorted(files.iterdir()) == before
    assert leftovers(files) == []


def test_existing_environments_pass_the_early_check(files):
    for value in ("dark", "mid", "bright", "random:7", f"random:{2**63 - 1}", "light.exr"):
        early.require_environment("--env", value, ("dark", "mid", "bright"))
    with pytest.raises(Exception, match="black everywhere"):
        from gdtool.shading.lights.load import load_environment

        load_environment("black.exr")
    name = "caf\udce9.exr"
    Path("light.exr").rename(name)
    early.require_environment("--env", name, ())


@pytest.mark.parametrize(
    "line, module, cure",
    [
        (
            "remesh cube.obj --engine quadriflow",
            "pyQuadriFlow",
            "pip install 'gdtool[quadriflow]', or use --engine auto",
        ),
        ("bake cube.obj --usd usda", "pxr.Usd", "pip install 'gdtool[usd]', or leave out --usd"),
        (
            "sample-views ball.png --matting notes.txt",
            "onnxruntime",
            "pip install 'gdtool[matting]', or give a mask with --mask",
        ),
    ],
)
def test_a_package_that_an_option_needs_is_checked_before_any_work(
    gdtool_here, no_work, files, monkeypatch, line, module, cure
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, module, None)
    done = gdtool_here(*line.split(), "-o", "out")
    assert done.returncode == 5, done.stderr
    assert cure in done.stderr, done.stderr
    assert len(lines_of(done.stderr)) == 1, done.stderr
    assert leftovers(files) == [], done.stderr


def test_a_package_whose_library_is_missing_names_the_library(monkeypatch):
    def broken(name):
        raise ImportError("libGL.so.1: cannot open shared object file: No such file or directory", name=name)

    monkeypatch.setattr(early.importlib, "import_module", broken)
    with pytest.raises(ResourceError, match="libGL.so.1: is not installed, and pxr needs it; apt install libgl1"):
        early.require_package("pxr.Usd", "--usd", "x")


def dataset(count):
    """Make a stand-in for a dataset of `count` objects."""
    return types.SimpleNamespace(kind="dataset", content=types.SimpleNamespace(objects=[None] * count))


@pytest.mark.parametrize(
    "count, options, fine",
    [
        (5, {"held_out": 4}, True),
        (5, {"held_out": 5}, False),
        (5, {"held_out": 900}, False),
        (2, {}, True),
        (1, {"held_out": 0}, True),
    ],
)
def test_holding_out_all_objects_is_refused(count, options, fine):
    source = dataset(count)
    inputs = Inputs(source, "x", {"start": None}, (source,))
    if fine:
        train.check(inputs, train.Options(**options))
    else:
        with pytest.raises(
            Exception, match=f"leaves none of the {count} objects to train on; hold out at most {count - 1}"
        ) as caught:
            train.check(inputs, train.Options(**options))
        assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    "content, fact",
    [
        ('{"model": {"patch": "four"}}', "patch"),
        ('{"model": {"patch": 1e999}}', "beyond double precision"),
        ('{"models": {}}', "models"),
        ('{"model": {}, "model": {}}', "appears twice"),
        ("[", "is not JSON"),
        ('{"model": {"no_such": 1}}', "no_such"),
    ],
)
def test_a_wrong_training_configuration_is_refused(tmp_path, content, fact):
    (tmp_path / "c.json").write_text(content)
    source = dataset(9)
    with pytest.raises(Exception, match=fact) as caught:
        train.check(Inputs(source, "x", {"start": None}, (source,)), train.Options(config="c.json"))
    assert caught.value.exit_code == 3
    assert caught.value.cure


def test_the_cache_of_compiled_networks_is_outside_tmpdir(monkeypatch, tmp_path):
    from gdtool.diffusion.inference.compiled import compiler_cache

    monkeypatch.delenv("TORCHINDUCTOR_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with compiler_cache():
        assert os.environ["TORCHINDUCTOR_CACHE_DIR"] == str(tmp_path / "cache/gdtool/torchinductor")
    assert "TORCHINDUCTOR_CACHE_DIR" not in os.environ
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with compiler_cache():
        place = os.environ["TORCHINDUCTOR_CACHE_DIR"]
        assert Path(place).is_dir()
    assert not Path(place).exists()
