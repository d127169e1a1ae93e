"""Check that two processes started by torchrun train as one does: loss curve, weights, and resuming after a kill."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

SCRIPT = """
import sys
from pathlib import Path
import msgspec, torch
from gdtool.diffusion.training import distributed
from gdtool.diffusion.config import Phase
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.reports.report import append_validation, view_validation
from gdtool.diffusion.training.loop import Observers, RunOptions, run_training
from tests.diffusion.test_training import MODEL, TRAIN, spheres

torch.set_num_threads(1)
distributed.start()
train = msgspec.structs.replace(TRAIN, batch=4, accumulate=int(sys.argv[2]), steps=6, precision="float32", clip=0.5,
                                phases=(Phase(share=0.5, domains=1, views=2), Phase(domains=6, views=2)))
torch.manual_seed(0)
workspace = Path(sys.argv[1])
workspace.mkdir(exist_ok=True)
steps = int(sys.argv[3])

class Stop(Exception):
    pass

def progress(iterable, total, label):
    for i in iterable:
        if i == steps:
            raise Stop  # as a kill between two checkpoints would
        yield i

def validate(state):
    assert distributed.rank() == 0
    append_validation(workspace / "validation.csv", state.step, 0.0, view_validation(state, spheres(1), "float32")[1])

try:
    options = RunOptions(seed=0, checkpoint_every=2, validate_every=3)
    observers = Observers(validate=validate, progress=progress)
    run_training(Model(MODEL), spheres(), train, workspace, options, observers)
except Stop:
    pass
distributed.leave()
"""


def run(tmp_path, name, processes, accumulate=1, shard=False, steps=99):
    script = tmp_path / "run.py"
    script.write_text(SCRIPT)
    start = (
        [sys.executable]
        if processes == 1
        else [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", str(processes)]
    )
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        [*start, str(script), str(tmp_path / name), str(accumulate), str(steps)],
        capture_output=True,
        text=True,
        timeout=300,
        env={
            **os.environ,
            "PYTHONPATH": root,
            "OMP_NUM_THREADS": "1",
            "GDTOOL_SHARD": "1" if shard else "0",
        },
    )
    assert done.returncode == 0, done.stderr[-2000:]
    rows = list(csv.DictReader((tmp_path / name / "loss.csv").read_text().splitlines()))
    return np.array([[float(row[c] or 0) for c in ("loss", "norm", "color")] for row in rows]), load_file(
        tmp_path / name / "checkpoint.safetensors"
    )


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    folder = tmp_path_factory.mktemp("single")
    return *run(folder, "one", 1), folder / "one" / "validation.csv"


@pytest.mark.parametrize(
    "processes, accumulate, shard",
    [(1, 2, False), (2, 1, False), pytest.param(2, 2, True, marks=pytest.mark.slow)],
    ids=["accumulated", "ddp", "fsdp"],
)
def test_the_loss_curve_equals_that_of_one_process(single, tmp_path, processes, accumulate, shard):
    """Train with a global batch of four in two parts, in two processes, and with the weights split over processes."""
    curve, tensors = run(tmp_path, "many", processes, accumulate, shard)
    expected, many = (
        np.genfromtxt(path, delimiter=",", skip_header=1) for path in (single[2], tmp_path / "many" / "validation.csv")
    )
    assert many[:, 0].tolist() == [3, 6]
    np.testing.assert_allclose(many, expected, atol=0.05)
    assert len(curve) == 6
    np.testing.assert_allclose(curve, single[0], rtol=2e-4, atol=1e-6)
    assert tensors.keys() == single[1].keys()
    for name in tensors:
        if name.startswith("average/"):
            np.testing.assert_allclose(tensors[name], single[1][name], atol=2e-3, err_msg=name)


@pytest.mark.slow
def test_two_stopped_processes_resume_bit_for_bit(tmp_path):
    whole = run(tmp_path, "whole", 2)
    run(tmp_path, "stopped", 2, steps=3)
    resumed = run(tmp_path, "stopped", 2)
    assert np.array_equal(whole[0], resumed[0])
    assert all(np.array_equal(whole[1][name], resumed[1][name]) for name in whole[1])
