"""benchmarks/train/mean_weights.py: the mean of two models' weights, as a model that validates."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from benchmarks.train.curve import chain
from gdtool.core.folder import open_folder
from tests.stages.dataset import write_spheres

SCRIPT = Path(__file__).parents[2] / "benchmarks/train/mean_weights.py"
SMALLER = {"channels": [8, 16], "head_width": 8, "encoder_width": 16, "image_size": 16}


@pytest.fixture
def trained(gdtool, tmp_path):
    spheres = write_spheres(tmp_path / "spheres", size=16)

    def train(name, seed, start=None, **changes):
        (tmp_path / f"{name}.json").write_text(json.dumps({"model": SMALLER | changes}))
        begun = ["--start", start] if start else []
        result = gdtool(
            "train",
            spheres,
            "--preset",
            "tiny",
            "--threads",
            1,
            "--config",
            f"{name}.json",
            *begun,
            "--steps",
            2,
            "--seed",
            seed,
            "-o",
            name,
        )
        assert result.returncode == 0, result.stderr
        return tmp_path / name

    return train


def mean(*models, output):
    return subprocess.run([sys.executable, SCRIPT, *models, "-o", output], capture_output=True, text=True)


def test_the_mean_of_two_models_validates(gdtool, trained, tmp_path):
    one, other = trained("one", 1), trained("other", 2)
    result = mean(one, other, output=tmp_path / "both")
    assert result.returncode == 0, result.stderr
    weights = [load_file(folder / "model.safetensors") for folder in (one, other, tmp_path / "both")]
    assert any((weights[0][name] != weights[1][name]).any() for name in weights[0])
    for name, value in weights[2].items():
        expected = (weights[0][name].astype(np.float64) + weights[1][name]) / 2
        np.testing.assert_allclose(value, expected, rtol=1e-3, atol=1e-7)
    assert gdtool("validate", "both").returncode == 0


def test_models_of_other_shapes_are_refused(trained, tmp_path):
    result = mean(trained("one", 1), trained("wide", 1, encoder_width=32), output=tmp_path / "both")
    assert result.returncode != 0
    assert "other weights" in result.stderr
    assert not (tmp_path / "both").exists()


@pytest.mark.slow
def test_the_curve_of_a_mean_goes_back_over_its_last_model(gdtool, trained, tmp_path):
    one = trained("one", 1)
    other = trained("other", 2, start=one)
    assert mean(one, other, output=tmp_path / "both").returncode == 0
    last = trained("last", 3, start=tmp_path / "both")
    assert mean(tmp_path / "both", last, output=tmp_path / "final").returncode == 0
    found = chain(tmp_path / "final")
    assert [path.resolve().name for path, _ in found] == ["one", "both", "final"]
    minutes = [float(open_folder(path, ("model",)).content.report["training_minutes"]) for path in (one, other, last)]
    np.testing.assert_allclose([total for _, total in found], np.cumsum(minutes))
