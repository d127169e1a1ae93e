"""Run gdtool relight on small generated meshes."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from gdtool.images.io import read_image, write_exr

SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nf 1 2 3 4\n"
FAST = ("--size", "32", "--samples", "4", "--light-samples", "8")


@pytest.fixture
def square(tmp_path):
    (tmp_path / "square.obj").write_text(SQUARE)
    return tmp_path / "square.obj"


@pytest.fixture
def gdtool(gdtool_here):
    """Run commands within this process, except in tests that ask for the command itself."""
    return gdtool_here


@pytest.mark.parametrize("light", ["sampled", "prefiltered", "sg"])
def test_writes_frames_that_validate_and_skips_when_up_to_date(gdtool, square, tmp_path, light):
    done = gdtool("relight", square, *FAST, "--views", "3", "--light", light)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "square.asset/renders\n"
    path = tmp_path / "square.asset/renders"
    assert gdtool("validate", path).returncode == 0
    content = json.loads((path / "manifest.json").read_text())["content"]
    assert (content["frames"], content["environment"], content["light"]) == (3, "mid", light)
    frame = read_image(path / "000.png")
    assert frame.shape == (32, 32, 4)
    assert frame[16, 16, 3] == 255
    assert frame[0, 0, 3] == 0
    assert frame[16, 16, :3].min() > 0
    assert "up to date" in gdtool("relight", square, *FAST, "--views", "3", "--light", light).stderr


def test_light_from_one_side_falls_on_that_side(gdtool, square, tmp_path):
    """The square faces +Z and fills three quarters of the image: light from there reaches its front, not its back."""
    image = np.zeros((32, 64, 3), np.float32)
    image[12:20, 44:52] = (20, 10, 5)
    write_exr(tmp_path / "front.exr", image)
    done = gdtool("relight", square, *FAST, "--views", "2", "--env", "front.exr", "--elevation", "0")
    assert done.returncode == 0, done.stderr
    front, back = (read_image(tmp_path / f"square.asset/renders/{k:03d}.png")[16, 16].astype(int) for k in (0, 1))
    assert front[0] > front[1] > front[2] > 60
    assert back[:3].max() < 5


@pytest.mark.parametrize("light", ["sampled", "prefiltered", "sg"])
def test_either_reflection_model(gdtool, square, tmp_path, light):
    """A rough dielectric differs between the models by Disney's diffuse term; both are finite and recorded."""
    frames = {}
    for brdf in ("gltf", "paper"):
        assert (
            gdtool("relight", square, *FAST, "--views", "1", "--light", light, "--brdf", brdf, "-o", brdf).returncode
            == 0
        )
        assert json.loads((tmp_path / brdf / "manifest.json").read_text())["options"]["brdf"] == brdf
        frames[brdf] = read_image(tmp_path / brdf / "000.png").astype(int)
    assert (frames["gltf"] != frames["paper"]).any()
    assert np.abs(frames["gltf"] - frames["paper"]).max() < 60


def test_works_in_a_pipe_and_bad_input_exits_3(gdtool, square, tmp_path):
    # The command itself, with a true pipe.
    done = subprocess.run(
        [sys.executable, "-m", "gdtool", "relight", *FAST, "--light", "sg"],
        input=f"{square}\n",
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0
    assert done.stdout == "square.asset/renders\n"
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    bad = gdtool("relight", "bad.glb", *FAST)
    assert bad.returncode == 3
    assert "bad.glb" in bad.stderr
    assert "Traceback" not in bad.stderr
    assert gdtool("relight", square, *FAST, "--env", "none.exr", "-o", "x").returncode == 3
    assert not (tmp_path / "x").exists()


def test_a_target_or_a_budget_instead_of_samples(gdtool, square, tmp_path):
    """A low target is met. A high one is not met within a short budget, but the picture is there."""
    small = ("--size", "32", "--light-samples", "2")
    for target in (25, 45):
        assert gdtool("relight", square, *small, "--target-psnr", str(target), "-o", f"t{target}").returncode == 0
    few, many = (json.loads((tmp_path / f"t{t}/manifest.json").read_text())["content"]["report"] for t in (25, 45))
    assert few["estimated_psnr"] >= 25
    assert many["estimated_psnr"] >= 45
    assert many["samples"] > few["samples"]
    assert gdtool("relight", square, *small, "--budget", "0.3", "-o", "b").returncode == 0
    assert read_image(tmp_path / "b/000.png")[16, 16, :3].min() > 0
    assert gdtool("relight", square, *small, "--budget", "1", "--target-psnr", "40", "-o", "c").returncode == 2
    assert gdtool("relight", square, *small, "--light", "sg", "--budget", "1", "-o", "c").returncode == 2
    assert gdtool("relight", square, "--light-samples", "0", "-o", "c").returncode == 2
