"""Run gdtool train on three painted spheres."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from tests.stages.dataset import write_spheres

TINY = ("--preset", "tiny", "--threads", 1, "--config", "config.json")
SMALLER = {"model": {"channels": [8, 16], "head_width": 8, "encoder_width": 16, "image_size": 16}}


@pytest.fixture
def spheres(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(SMALLER))
    return write_spheres(tmp_path / "spheres", size=16)


def test_train_writes_a_model_that_validates_and_then_skips(gdtool, spheres, tmp_path):
    first = gdtool("train", spheres, *TINY, "--steps", 4, "--held-out", 1, "-o", "model")
    assert first.returncode == 0, first.stderr
    assert first.stdout == "model\n"
    model = tmp_path / "model"
    manifest = json.loads((model / "manifest.json").read_text())
    assert manifest["kind"] == "model"
    assert manifest["content"]["steps"] == 4
    assert manifest["content"]["report"]["objects"] == 2
    rows = list(csv.DictReader((model / "loss.csv").read_text().splitlines()))
    assert [int(row["step"]) for row in rows] == [1, 2, 3, 4]
    assert all(float(row["loss"]) > 0 for row in rows)
    assert (model / "validation" / "step_000004.png").stat().st_size > 1000
    validation_rows = list(csv.DictReader((model / "validation.csv").read_text().splitlines()))
    assert [row["step"] for row in validation_rows] == ["4"]
    assert 0 < float(validation_rows[0]["color"]) < 60
    assert float(validation_rows[0]["seconds"]) > 0
    assert (model / "loss.png").is_file()
    assert "spheres" not in (model / "card.md").read_text()
    assert not list(model.glob("**/*.pt"))
    assert load_file(model / "model.safetensors")
    assert gdtool("validate", model).returncode == 0
    second = gdtool("train", spheres, *TINY, "--steps", 4, "--held-out", 1, "-o", "model")
    assert second.stdout == "model\n"
    assert "up to date" in second.stderr


def test_tensorboard_has_every_row_of_the_log(gdtool, spheres, tmp_path):
    loader = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    run = gdtool("train", spheres, *TINY, "--steps", 4, "--held-out", 1, "--tensorboard", "-o", "model")
    assert run.returncode == 0, run.stderr
    events = loader.EventAccumulator(str(tmp_path / "model/tensorboard"))
    events.Reload()
    rows = list(csv.DictReader((tmp_path / "model/loss.csv").read_text().splitlines()))
    assert [(event.step, pytest.approx(event.value, rel=1e-4)) for event in events.Scalars("loss")] == [
        (int(row["step"]), float(row["loss"])) for row in rows
    ]
    assert [event.step for event in events.Images("validation")] == [4]


def test_without_the_package_tensorboard_is_refused(gdtool, spheres, tmp_path, monkeypatch):
    (tmp_path / "hidden/tensorboard").mkdir(parents=True)
    (tmp_path / "hidden/tensorboard/__init__.py").write_text("raise ImportError('hidden')\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "hidden"))
    run = gdtool("train", spheres, *TINY, "--steps", 2, "--tensorboard", "-o", "model")
    assert run.returncode == 5
    assert "pip install 'gdtool[tensorboard]'" in run.stderr
    assert not (tmp_path / "model").exists()


def test_same_seed_same_weights(gdtool, spheres, tmp_path):
    for name in ("a", "b"):
        assert gdtool("train", spheres, *TINY, "--steps", 2, "--held-out", 0, "-o", name).returncode == 0
    assert (tmp_path / "a/model.safetensors").read_bytes() == (tmp_path / "b/model.safetensors").read_bytes()


def test_a_killed_training_goes_on_where_it_was(gdtool, spheres, tmp_path):
    line = [str(x) for x in ("train", spheres, *TINY, "--steps", 40, "--checkpoint-every", 2, "--held-out", 0)]
    assert gdtool(*line, "-o", "whole").returncode == 0
    process = subprocess.Popen(
        [sys.executable, "-m", "gdtool", *line, "-o", "killed"],
        cwd=tmp_path,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    deadline = time.monotonic() + 240  # the machine may be busy
    while not list(tmp_path.glob(".*/checkpoint.safetensors")) + list(tmp_path.glob("*/checkpoint.safetensors")):
        assert process.poll() is None, "no checkpoint was written"
        assert time.monotonic() < deadline, "no checkpoint was written"
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "killed").exists()
    assert gdtool(*line, "-o", "killed").returncode == 0
    whole, killed = load_file(tmp_path / "whole/model.safetensors"), load_file(tmp_path / "killed/model.safetensors")
    assert all(np.array_equal(whole[name], killed[name]) for name in whole)


def test_training_goes_on_from_a_model(gdtool, spheres, tmp_path):
    assert gdtool("train", spheres, *TINY, "--steps", 2, "--held-out", 0, "-o", "first").returncode == 0
    after = gdtool(
        "train", spheres, *TINY, "--steps", 1, "--seed", 1, "--held-out", 0, "--start", "first", "-o", "second"
    )
    assert after.returncode == 0, after.stderr
    first, second = load_file(tmp_path / "first/model.safetensors"), load_file(tmp_path / "second/model.safetensors")
    fresh = gdtool("train", spheres, *TINY, "--steps", 1, "--seed", 1, "--held-out", 0, "-o", "fresh")
    assert fresh.returncode == 0
    name = "unet.conv_in.weight"
    distance = [
        np.abs(first[name].astype(float) - x[name]).max()
        for x in (second, load_file(tmp_path / "fresh/model.safetensors"))
    ]
    assert distance[0] < distance[1]


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"model": {"chanels": [8]}}, "chanels"),
        ({"train": {"batch": "many"}}, "batch"),
        ({"weights": {}}, "weights"),
    ],
)
def test_a_wrong_configuration_is_named(gdtool, spheres, tmp_path, changes, words):
    (tmp_path / "config.json").write_text(json.dumps(changes))
    result = gdtool("train", spheres, *TINY, "-o", "model")
    assert result.returncode == 3
    assert words in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "model").exists()


def test_data_without_the_domains_are_refused(gdtool, tmp_path):
    (tmp_path / "config.json").write_text(json.dumps(SMALLER))
    write_spheres(tmp_path / "colors", count=2, size=16, domains=("color", "normal"))
    result = gdtool("train", "colors", *TINY, "-o", "model")
    assert result.returncode == 3
    assert "albedo" in result.stderr
    assert "render-dataset" in result.stderr


def test_a_start_of_another_shape_is_refused(gdtool, spheres, tmp_path):
    assert gdtool("train", spheres, *TINY, "--steps", 1, "--held-out", 0, "-o", "first").returncode == 0
    weights = load_file(tmp_path / "first/model.safetensors")
    assert weights  # the folder was whole before it is damaged
    weights["unet.conv_in.weight"] = weights["unet.conv_in.weight"][:4]
    save_file(weights, tmp_path / "first/model.safetensors")
    result = gdtool("train", spheres, *TINY, "--steps", 1, "--start", "first", "-o", "second")
    assert result.returncode == 3
    assert "first" in result.stderr


def test_a_small_model_is_grown_to_a_larger_size(gdtool, spheres, tmp_path):
    assert gdtool("train", spheres, *TINY, "--steps", 2, "--held-out", 0, "-o", "small").returncode == 0
    large = write_spheres(tmp_path / "large", size=32)
    done = gdtool("train", large, *TINY, "--start", "small", "--size", 32, "--steps", 1, "--held-out", 0, "-o", "grown")
    assert done.returncode == 0, done.stderr
    config = json.loads((tmp_path / "grown/config.json").read_text())
    assert (config["image_size"], config["patch"], config["encoder_patch"]) == (32, 8, 16)
    weights = load_file(tmp_path / "grown/model.safetensors")["unet.conv_in.weight"]
    pixels = weights.astype(np.float32).reshape(8, 7, 8, 8, 3, 3)
    # One small step away.
    assert np.abs(pixels[:, :, 0::2] - pixels[:, :, 1::2]).max() < 0.01 * np.abs(pixels).max() + 0.01
    bad = gdtool("train", large, *TINY, "--size", 24, "--steps", 1, "-o", "bad")
    assert bad.returncode == 3
    assert "neither a multiple" in bad.stderr
