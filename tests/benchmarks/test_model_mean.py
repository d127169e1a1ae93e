"""benchmarks/model_mean.py: the mean of two models' weights, as a model that validates."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from tests.stages.dataset import write_spheres

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "model_mean.py"
SMALLER = {"channels": [8, 16], "head_width": 8, "encoder_width": 16, "image_size": 16}


@pytest.fixture
def trained(gdtool, tmp_path):
    spheres = write_spheres(tmp_path / "spheres", size=16)

    def train(name, seed, **changes):
        (tmp_path / f"{name}.json").write_text(json.dumps({"model": SMALLER | changes}))
        result = gdtool("train", spheres, "--preset", "tiny", "--threads", 1, "--config", f"{name}.json", "--steps", 2, "--seed", seed, "-o", name)
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
    assert result.returncode != 0 and "other weights" in result.stderr and not (tmp_path / "both").exists()
