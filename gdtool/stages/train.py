"""Train the multi-view PBR diffusion model on rendered objects.

Takes a dataset folder (or any views folders with all six domains) of render-dataset and writes a model folder for
sample-views: weights, configuration, card, loss curve and validation images. Use it to train the small configuration on
a processor, to go on from a model you have (--start; with --size, at a larger size), or, with --preset paper, to grow
Stable Diffusion to six domains. Killed at any time, the same line goes on where it was. Sources may be .tar files of
views folders, plain or in WebDataset's naming. `torchrun --nproc_per_node N -m -- gdtool train …` trains in N processes
(GDTOOL_SHARD=1 splits the weights as well). --plan tells what a configuration costs, without data.

Example:
  gdtool render-dataset procedural:0..99 --size 64 -o objects && gdtool train objects --minutes 60 -o my-model
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from gdtool.core.errors import InputError, UsageError
from gdtool.core.reading import read_json
from gdtool.core.stage import MOST_SEED, Inputs, Output, SecondInput, Stage, file_option

MOST_STEPS = 10**9
MOST_MINUTES = 525_600.0  # a year
HELD_OUT = 4  # objects, or all but one where there are no more


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    preset: Annotated[Literal["small", "tiny", "paper"], Meta(description="Configuration to start from.")] = "small"
    ablation: Annotated[
        Literal["none", "no_cross_domain", "one_way", "two_way", "no_pbr", "color_normal"],
        Meta(description="Part of the method to leave out or change; color_normal: Wonder3D's two domains."),
    ] = "none"
    config: file_option('JSON file of changes to it: {"model": {...}, "train": {...}}.') = None
    size: (
        Annotated[
            int,
            Meta(
                ge=16,
                le=1024,
                description="Width and height of a view in pixels, patches in proportion, so at the same cost; a smaller model of --start is grown to it.",
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
                description="Stop after so many minutes of training; the learning rate falls accordingly.",
            ),
        ]
        | None
    ) = None
    batch: Annotated[int, Meta(ge=1, le=65536, description="Objects per step; without it the preset's.")] | None = None
    seed: Annotated[int, Meta(ge=0, le=MOST_SEED, description="Seed of weights, data order and noise.")] = 0
    held_out: Annotated[
        int,
        Meta(
            ge=0,
            le=1_000_000,
            description="Last objects of the data that are not trained on but shown in validation images.",
        ),
    ] = HELD_OUT
    checkpoint_every: Annotated[int, Meta(ge=1, le=MOST_STEPS, description="Steps between checkpoints.")] = 100
    validate_every: Annotated[int, Meta(ge=1, le=MOST_STEPS, description="Steps between validation images.")] = 500
    tensorboard: Annotated[
        bool,
        Meta(
            description="Write TensorBoard's event files as well, into the run's workspace and the model (needs tensorboard)."
        ),
    ] = False


def check(inputs: Inputs, options: Options) -> None:
    """Raise what --config, --tensorboard and --held-out would stop the run with."""
    from gdtool.stages import early

    configured(options)
    if options.tensorboard:
        early.require_package(
            "torch.utils.tensorboard", "--tensorboard", "pip install 'gdtool[tensorboard]', or leave it out"
        )
    count = _object_count(inputs)
    # Of fewer objects than the default holds out, one is left to train on: that is no mistake of the user's.
    if options.held_out >= count and options.held_out != HELD_OUT:
        raise UsageError(
            f"--held-out {options.held_out}",
            f"leaves none of the {count} objects to train on",
            f"hold out at most {count - 1}",
        )


def run(inputs: Inputs, options: Options, out: Output) -> None:
    """Train and write a model folder. Raises InputError for data or a configuration that does not fit."""
    import shutil

    import torch

    from gdtool.core.kinds import ModelContent
    from gdtool.diffusion.checkpoint.weights import save_model
    from gdtool.diffusion.data.objects import Objects, decode_dataset, from_bytes
    from gdtool.diffusion.inference import familiarity
    from gdtool.diffusion.network.model import parameter_count
    from gdtool.diffusion.reports.curve import draw_curve
    from gdtool.diffusion.reports.report import append_validation, card, validation
    from gdtool.diffusion.training import distributed
    from gdtool.diffusion.training.tensorboard import Events
    from gdtool.images.io import write_png

    torch.set_num_threads(out.threads)
    model_config, train_config = configured(options)
    start = inputs.second["start"]
    with out.step("decode"):
        folders, count = _objects(inputs, out.workspace), _object_count(inputs)
        objects = decode_dataset(folders, count, model_config, out.workspace, warn=out.warn)
    held = min(options.held_out, len(objects) - 1)
    used = len(objects) - held
    shown = Objects(objects.planes[used:], objects.conditions[used:], objects.lights[used:], objects.names[used:])
    objects = Objects(objects.planes[:used], objects.conditions[:used], objects.lights[:used], objects.names[:used])
    (out.workspace / "validation").mkdir(exist_ok=True)
    events = Events(out.workspace / "tensorboard") if options.tensorboard else None

    def validate(state) -> None:
        if held:
            grid, psnr = validation(state, shown, train_config.precision)
            write_png(out.workspace / "validation" / f"step_{state.step:06d}.png", grid)
            append_validation(out.workspace / "validation.csv", state.step, state.seconds, psnr)
            if events is not None:
                events.picture(state.step, grid)

    distributed.start()
    order = {
        "model": model_config,
        "train": train_config,
        "start": start and start.path,
        "workspace": out.workspace.absolute(),
        "used": used,
        "seed": options.seed,
        "minutes": options.minutes,
        "checkpoint_every": options.checkpoint_every,
        "device": out.device,
    }
    distributed.send(order)
    with out.step("train"):
        how = {} if events is None else {"log": events.scalars}
        state = _train(
            order,
            objects,
            validate_every=options.validate_every,
            validate=validate,
            warn=out.warn,
            progress=out.progress,
            **how,
        )
    with out.step("validate"):
        validate(state)
    if events is not None:
        events.close()
        for file in sorted((out.workspace / "tensorboard").iterdir()):
            shutil.copyfile(file, out.path(f"tensorboard/{file.name}"))
    save_model(out.path, model_config, state.average)
    shutil.copyfile(out.workspace / "loss.csv", out.path("loss.csv"))
    write_png(out.path("loss.png"), draw_curve(out.workspace / "loss.csv"))
    if held:
        shutil.copyfile(out.workspace / "validation.csv", out.path("validation.csv"))
    for picture in sorted((out.workspace / "validation").glob("*.png")):
        shutil.copyfile(picture, out.path(f"validation/{picture.name}"))
    every = range(0, used, max(used // 4000, 1))
    pictures = (
        from_bytes(objects.conditions[i, k]).numpy() for i in every for k in range(min(2, objects.conditions.shape[1]))
    )
    familiarity.write_ranges(out.path(familiarity.FILE), familiarity.ranges(pictures))
    facts = {
        "objects": used,
        "steps": state.step,
        "training_minutes": round(state.seconds / 60, 1),
        "batch": train_config.batch,
        "parameters": parameter_count(state.model),
        "threads": out.threads,
        "device": out.device,
        "processes": distributed.size(),
        "ablation": options.ablation,
    }
    out.path("card.md").write_text(card(options.preset, model_config, train_config, facts))
    out.content = ModelContent(
        preset=options.preset,
        image_size=model_config.image_size,
        domains=model_config.domains,
        parameters=parameter_count(state.model),
        steps=state.step,
        report={k: v for k, v in facts.items() if k not in ("parameters", "steps", "threads")},
    )


def _train(order: dict, objects, **how):
    """What every process does: the same model, the same data, its own part of each batch."""
    import torch

    from gdtool.diffusion.checkpoint.weights import check_shapes, load_model
    from gdtool.diffusion.network.model import Model
    from gdtool.diffusion.training.loop import run_training

    torch.manual_seed(order["seed"])
    model = Model(order["model"])
    if order["start"] is not None:
        from gdtool.diffusion.network.grow import grown

        loaded = load_model(order["start"])
        tensors = grown(loaded.state_dict(), loaded.config, order["model"])
        check_shapes(order["start"], tensors, model.state_dict())
        model.load_state_dict(tensors)
    elif order["model"].codec == "vae":
        from gdtool.diffusion.checkpoint.pretrained import start_from_pretrained

        start_from_pretrained(model)
    return run_training(
        model,
        objects,
        order["train"],
        order["workspace"],
        seed=order["seed"],
        minutes=order["minutes"],
        checkpoint_every=order["checkpoint_every"],
        device=order["device"],
        **how,
    )


def follow(threads: int) -> None:
    """What a process of torchrun that is not the first does: wait for the first one's order, train with it, and end."""
    import torch

    from gdtool.diffusion.data.objects import Objects, decode_dataset
    from gdtool.diffusion.training import distributed

    if threads:
        torch.set_num_threads(threads)
    order = distributed.receive()
    if order is not None:
        every = decode_dataset((), 0, order["model"], order["workspace"])
        used = order["used"]
        _train(order, Objects(every.planes[:used], every.conditions[:used], every.lights[:used], every.names[:used]))
    distributed.leave()


def dismiss() -> None:
    """The first process of several, its work done, lets the others go, also where it had nothing to do, and ends."""
    from gdtool.diffusion.training import distributed

    distributed.leave()


def plan(options: Options, as_json: bool) -> str:
    """What the training would cost, as text or as one JSON object."""
    from gdtool.diffusion.reports.plan import plan_of, text_of

    report = plan_of(*configured(options))
    return msgspec.json.encode(report).decode() if as_json else text_of(report)


def configured(options: Options):
    """The preset with the changes of the ablation, of --config and of the flags. Raises InputError for a bad file."""
    from pathlib import Path

    from gdtool.diffusion.config import ABLATIONS, PRESETS

    preset = PRESETS[options.preset]
    parts = [msgspec.to_builtins(part) for part in preset]
    for part, changes in zip(parts, ABLATIONS[options.ablation], strict=True):
        part.update(changes)
    if options.config is not None:
        path = Path(options.config)
        try:
            changes = msgspec.convert(read_json(path), dict[Literal["model", "train"], dict])
        except msgspec.ValidationError as error:
            raise InputError(
                path, str(error), 'write {"model": {...}, "train": {...}} with names and values of docs/training.md'
            ) from None
        for part, name in zip(parts, ("model", "train"), strict=True):
            part.update(changes.get(name, {}))
    flags = {"steps": options.steps, "batch": options.batch}
    parts[1].update({name: value for name, value in flags.items() if value is not None})
    if options.minutes is not None and options.steps is None:
        parts[1]["steps"] = MOST_STEPS  # the minutes decide
    try:
        model, train = (msgspec.convert(part, type(own)) for part, own in zip(parts, preset, strict=True))
    except msgspec.ValidationError as error:
        raise InputError(
            options.config or "configuration", str(error), "correct that value in the file of --config"
        ) from None
    if options.size is not None:
        from gdtool.diffusion.network.grow import resized

        model = resized(model, options.size)
    return model, train


def _objects(inputs: Inputs, workspace):
    """The views folders among the sources, those of datasets and archives opened one by one."""
    import itertools
    from pathlib import Path

    from gdtool.core.folder import dataset_objects

    parts = []
    for source in inputs.all:
        if isinstance(source, Path):
            from gdtool.diffusion.data.archives import views_of

            parts.append(views_of(source, workspace))
            continue
        parts.append([source] if source.kind == "views" else dataset_objects(source))
    return itertools.chain.from_iterable(parts)


def _object_count(inputs: Inputs) -> int:
    """How many views folders _objects() gives; of archives only the headers are read."""
    from pathlib import Path

    from gdtool.diffusion.data.archives import object_count

    return sum(
        object_count(source)
        if isinstance(source, Path)
        else 1
        if source.kind == "views"
        else len(source.content.objects)
        for source in inputs.all
    )


STAGE = Stage(
    name="train",
    version=3,
    reads=("dataset", "views", "archive-file"),
    writes="model",
    Options=Options,
    run=run,
    check=check,
    checkpoint="checkpoint.safetensors",
    gathers=True,
    second_inputs={"start": SecondInput("model", search=False, help="Model folder whose weights to start from.")},
)
