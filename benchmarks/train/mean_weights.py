"""The mean of models' weights: of runs from one start it is near to the better of them in each figure.

    python -m benchmarks.train.mean_weights one-run the-next-run -o model

Wortsman et al. 2022, "Model soups". The configuration, the loss curve and all else are those of the last one, which
every other one must fit. What it is worth is for benchmarks/train/quality.py to say."""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import msgspec
import torch

from gdtool.core.errors import InputError
from gdtool.core.folder import MANIFEST, open_folder
from gdtool.core.runner import Settings, run_one
from gdtool.core.stage import Inputs, Output, Stage


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """None."""


def run(inputs: Inputs, options: Options, out: Output) -> None:
    from gdtool.diffusion.checkpoint.weights import load_model, save_model

    models = [load_model(folder.path) for folder in inputs.all]
    last = inputs.all[-1]
    weights = [model.state_dict() for model in models]
    for folder, other in zip(inputs.all, weights, strict=True):
        if {name: x.shape for name, x in other.items()} != {name: x.shape for name, x in weights[-1].items()}:
            raise InputError(
                folder.path, f"it has other weights than {last.path}", "means are of models of one configuration"
            )
    for path in sorted(p for p in last.path.rglob("*") if p.is_file() and p.name != MANIFEST):
        shutil.copyfile(path, out.path(str(path.relative_to(last.path))))
    save_model(
        out.path,
        models[-1].config,
        {name: torch.stack([w[name].float() for w in weights]).mean(0) for name in weights[-1]},
    )
    out.content = last.content


STAGE = Stage(name="mean", version=1, reads=("model",), writes="model", Options=Options, run=run, gathers=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path, help="model folders; the last one gives all but the weights")
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    run_one(
        STAGE,
        [open_folder(path, ("model",)) for path in arguments.models],
        Options(),
        {},
        Settings(output=arguments.output),
    )


if __name__ == "__main__":
    main()
