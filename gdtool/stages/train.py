"""Train the multi-view PBR diffusion model on rendered objects.

It takes a dataset folder of render-dataset, or any views folders with all six domains, also in .tar files, plain or in
WebDataset's naming. It writes a model folder for sample-views: weights, configuration, card, loss curve and validation
images.

Use it to train the small configuration on a processor, to go on from a model you have (--start; with --size, at a
larger size), or, with --preset paper, to extend Stable Diffusion to six domains. A training may be killed at any time:
the same command resumes it. `torchrun --nproc_per_node N -m -- gdtool train …` trains in N processes (GDTOOL_SHARD=1
splits the weights as well). --plan predicts the cost of a configuration, without data.

Example:
  gdtool render-dataset procedural:0..99 --size 64 -o objects && gdtool train objects --minutes 60 -o my-model
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core import log
from gdtool.core.errors import UsageError
from gdtool.core.stage import FILE, MOST_SEED, Inputs, Output, SecondInput, Stage

MOST_STEPS = 10**9
MOST_MINUTES = 525_600.0  # a year
HELD_OUT = 4  # objects; all but one where there are fewer


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Hold the options of `gdtool train`."""

    preset: Annotated[
        Literal["volume", "small", "tiny", "paper"],
        Meta(description="volume: the shape first, then views on it. small, paper: views alone. tiny: for tests."),
    ] = "small"
    part: Annotated[
        Literal["views", "shape"],
        Meta(description="Part of the model to train. The other part stays as it is in --start."),
    ] = "views"
    ablation: Annotated[
        Literal["none", "no_cross_domain", "one_way", "two_way", "no_pbr", "color_normal"],
        Meta(description="Part of the method to leave out or change; color_normal: Wonder3D's two domains."),
    ] = "none"
    config: Annotated[
        str | None,
        Meta(description='JSON file of changes to the preset: {"model": {...}, "train": {...}}.', extra=FILE),
    ] = None
    size: (
        Annotated[
            int,
            Meta(
                ge=16,
                le=1024,
                description="Width and height of a view, pixels. Patches grow in proportion, so that a step costs the "
                "same. A smaller model of --start is grown to it.",
            ),
        ]
        | None
    ) = None
    steps: Annotated[int, Meta(ge=1, le=MOST_STEPS, description="Optimiser steps; without it the preset's.")] | None = (
        None
    )
    minutes: (
        Annotated[
            float,
            Meta(
                gt=0,
                le=MOST_MINUTES,
                description="Stop after so many minutes of training; the learning rate has fallen by then.",
            ),
        ]
        | None
    ) = None
    batch: Annotated[int, Meta(ge=1, le=65536, description="Objects per step; without it the preset's.")] | None = None
    precision: Annotated[
        Literal["auto", "float32", "bfloat16"],
        Meta(description="Number format of the network's products; auto: the faster one on this machine."),
    ] = "auto"
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="Seed of weights, data order and noise.")] = 0
    held_out: Annotated[
        int,
        Meta(
            ge=0,
            le=1_000_000,
            description="Number of objects, the last of the data, that validation images show and training leaves out.",
        ),
    ] = HELD_OUT
    checkpoint_every: Annotated[int, Meta(ge=1, le=MOST_STEPS, description="Steps between checkpoints.")] = 100
    validate_every: Annotated[int, Meta(ge=1, le=MOST_STEPS, description="Steps between validation images.")] = 500
    tensorboard: Annotated[
        bool,
        Meta(
            description="Also write TensorBoard's event files, into the run's workspace and the model (needs "
            "gdtool[tensorboard])."
        ),
    ] = False


def check(inputs: Inputs, options: Options) -> None:
    """Refuse, before the run, a bad --config, --tensorboard without its package, and too many --held-out."""
    from gdtool.diffusion.configure import chosen_configuration
    from gdtool.stages import early

    chosen_configuration(options)
    if options.tensorboard:
        early.require_package(
            "torch.utils.tensorboard", "--tensorboard", "pip install 'gdtool[tensorboard]', or leave it out"
        )
    from gdtool.diffusion.data.sources import count_views_folders

    count = count_views_folders(inputs.on_disk)
    # With fewer objects than the default holds out, one is left to train on: the user did not ask for that number.
    if options.held_out >= count and options.held_out != HELD_OUT:
        raise UsageError(
            f"--held-out {options.held_out}",
            f"leaves none of the {count} objects to train on",
            f"hold out at most {count - 1}",
        )


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Train and write a model folder. Raises InputError for data or a configuration that does not fit."""
    import torch

    from gdtool.diffusion.configure import chosen_configuration
    from gdtool.diffusion.data.objects import decode_dataset
    from gdtool.diffusion.data.sources import count_views_folders, views_folders
    from gdtool.diffusion.reports.record import Recorder, write_results
    from gdtool.diffusion.training import distributed
    from gdtool.diffusion.training.arithmetic import with_arithmetic
    from gdtool.diffusion.training.loop import RunOptions
    from gdtool.diffusion.training.worker import Order, execute

    torch.set_num_threads(out.threads)
    model_config, train_config = chosen_configuration(options)
    train_config, arithmetic = with_arithmetic(train_config, out.device)
    log.say(f"  training in {arithmetic.precision}: {arithmetic.reason}")
    with out.step("decode"):
        folders, count = views_folders(inputs.on_disk, out.workspace), count_views_folders(inputs.on_disk)
        objects = decode_dataset(folders, count, model_config, out.workspace, warn=out.warn)
    used = len(objects) - min(options.held_out, len(objects) - 1)
    held_out_objects, objects = objects.part(slice(used, None)), objects.part(slice(used))
    recorder = Recorder(out.workspace, held_out_objects, train_config, options.tensorboard)
    distributed.start()
    run_options = RunOptions(
        options.seed, options.minutes, options.checkpoint_every, options.validate_every, out.device
    )
    workspace = out.workspace.absolute()
    order = Order(model_config, train_config, inputs.second_path("start"), workspace, used, run_options)
    distributed.send(order)
    with out.step("train"):
        state = execute(order, objects, recorder.observers(out))
    with out.step("validate"):
        recorder.validate(state)
    write_results(out, recorder, state, objects, order, options.preset, options.ablation)


def follow(threads: int) -> None:
    """Train in a process of torchrun other than the first: wait until the first process sends its options, and train
    with it.
    """
    from gdtool.diffusion.training import worker

    worker.follow(threads)


def dismiss() -> None:
    """Tell the other processes of torchrun to end; the first process calls this last."""
    from gdtool.diffusion.training import distributed

    distributed.leave()


def plan(options: Options, as_json: bool) -> str:
    """Predict what the training would cost, as text or as one JSON object."""
    from gdtool.diffusion.configure import chosen_configuration
    from gdtool.diffusion.reports.plan import format_plan, make_plan

    report = make_plan(*chosen_configuration(options))
    return msgspec.json.encode(report).decode() if as_json else format_plan(report)


STAGE = Stage(
    name="train",
    version=3,
    reads=("dataset", "views", "archive-file"),
    networks=True,
    writes="model",
    Options=Options,
    run=run,
    check=check,
    checkpoint="checkpoint.safetensors",
    gathers=True,
    second_inputs={"start": SecondInput("model", search=False, help="Model folder whose weights to start from.")},
)
