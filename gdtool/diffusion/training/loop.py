"""Run the training loop: draw a batch, add noise, predict, compute the loss, step, average the weights, log.

A run is a pure function of data, configuration and seed. The choices of a step are seeded by (seed, step), those of an
object by (seed, step, place in the batch). So it does not matter how a batch is split over accumulations and processes.
A checkpoint holds the rest: weights, their average and the optimiser's moments. So a resumed run equals one that was
never stopped, bit for bit. distributed.py holds what differs between several processes.
"""

from __future__ import annotations

import csv
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from gdtool.core.errors import InputError
from gdtool.core.reading import parse_json
from gdtool.diffusion.config import Phase, TrainConfig
from gdtool.diffusion.data.objects import Objects, object_order
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.tensors import read_tensors
from gdtool.diffusion.training import distributed
from gdtool.diffusion.training.arithmetic import with_arithmetic
from gdtool.diffusion.training.objective import Objective, choose_step, columns, draw
from gdtool.diffusion.training.optimizer import MOMENTS, make_optimizer, restore_moments

CHECKPOINT = "checkpoint.safetensors"
MOST_SKIPPED = 10  # steps in a row with a gradient that is not finite: the run is lost


@dataclass
class State:
    """Hold everything that changes while training: model, optimiser, averaged weights by name, step and time."""

    model: Model
    optimizer: Any  # a torch.optim.Optimizer or optimizer.MuonAndAdam
    average: dict[str, torch.Tensor]
    objective: torch.nn.Module
    step: int = 0
    seconds: float = 0.0
    skipped: int = 0  # steps in a row whose gradient was not finite


def new_state(model: Model, train: TrainConfig) -> State:
    """Create the state before the first step, with the objective wrapped for all processes.

    The parameters of the part that is not trained are frozen.
    """
    for name, p in model.named_parameters():
        p.requires_grad_(name.startswith("shape.") == (train.part == "shape"))
    objective = distributed.wrap(Objective(model, train))
    optimizer = make_optimizer(model, train)
    average = {name: distributed.local_part(p).clone() for name, p in model.named_parameters()}
    return State(model, optimizer, average, objective)


def progress_of(state: State, train: TrainConfig, minutes: float | None) -> float:
    """Return the share of the run that is over, 0 to 1: the greater of those by steps and by minutes.

    minutes: limit of the run's time, or None.
    """
    return min(max(state.step / train.steps, state.seconds / 60 / minutes if minutes else 0.0), 1.0)


def phase_at(progress: float, train: TrainConfig) -> Phase:
    """Return the phase of the training at a progress, 0 to 1."""
    return next((phase for phase in train.phases if progress < phase.share), train.phases[-1])


def learning_rate(state: State, progress: float, train: TrainConfig) -> float:
    """Compute the learning rate: the phase's rate times the warm-up, and times a cosine decay where configured."""
    rate = phase_at(progress, train).learning_rate * min((state.step + 1) / train.warmup, 1.0)
    return rate * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress))) if train.decay else rate


def train_step(
    state: State, objects: Objects, train: TrainConfig, seed: int, minutes: float | None, device: str
) -> dict[str, float]:
    """Take one optimiser step, and update the state.

    The phase's batch is split into `accumulate` parts, one after the other. minutes: limit of the run's time, or None.
    Returns the step's row of loss.csv. Raises InputError for a batch smaller than the number of processes.
    """
    config, progress = state.model.config, progress_of(state, train, minutes)
    phase = phase_at(progress, train)
    step = choose_step(config, phase, seed, state.step)
    rate = learning_rate(state, progress, train)
    for group in state.optimizer.param_groups:
        group["lr"] = rate * group["rate"]
    idx = object_order(len(objects), state.step, phase.batch or train.batch, seed)
    places = np.arange(len(idx))
    sums: dict[str, float] = {}
    # Every process takes a share of each part of the batch; DDP and FSDP average the gradients over processes.
    if len(idx) < distributed.size():
        raise InputError(
            "batch",
            f"of {len(idx)} objects is less than one for each of {distributed.size()} processes",
            "raise --batch",
        )
    count = min(train.accumulate, len(idx) // distributed.size())
    parts_of = [distributed.part_for_process(part) for part in np.array_split(places, count)]
    for number, part in enumerate(parts_of):
        choices, generators = zip(*(step.choices(int(place)) for place in part), strict=True)
        batch = draw(objects, idx[part], config, train, choices).to(device)
        with distributed.synchronised(state.objective, number == len(parts_of) - 1):
            parts = state.objective(batch, step, list(generators))
            share = len(part) / len(idx)
            (parts["loss"] * share * distributed.size()).backward()
        for name, value in parts.items():
            sums[name] = sums.get(name, 0.0) + float(value.detach()) * share
    sums = distributed.sum_over_processes(sums)
    norm = distributed.local_part(torch.nn.utils.clip_grad_norm_(state.model.parameters(), train.clip), whole=True)
    finite = bool(torch.isfinite(norm))
    if finite:  # otherwise the step is skipped, so that the weights stay finite
        state.optimizer.step()
    state.skipped = 0 if finite else state.skipped + 1
    state.optimizer.zero_grad(set_to_none=True)
    state.step += 1
    keep = min(train.ema, (1 + state.step) / (10 + state.step))
    weights = {name: distributed.local_part(p) for name, p in state.model.named_parameters() if p.requires_grad}
    torch._foreach_lerp_([state.average[name] for name in weights], list(weights.values()), 1 - keep)
    return {"step": state.step, "rate": rate, "norm": float(norm), "skipped": int(not finite), **sums}


def save_checkpoint(state: State, workspace: Path, identity: str) -> None:
    """Write weights, averages and moments to a file beside the old checkpoint, then replace it.

    identity: text that a resumed run must match.
    """
    from safetensors.torch import save_file

    tensors = {}
    for name, p in state.model.named_parameters():
        tensors[f"model/{name}"] = distributed.gather(p.detach())
        tensors[f"average/{name}"] = distributed.gather(state.average[name], p)
        for key, value in state.optimizer.state.get(p, {}).items():
            tensors[f"{key}/{name}"] = distributed.gather(value)
    if distributed.rank() != 0:
        return
    tensors = {name: x.cpu().contiguous() for name, x in tensors.items()}
    record = json.dumps({"step": state.step, "seconds": state.seconds, "identity": identity})
    partial = workspace / f".{CHECKPOINT}.partial"
    save_file(tensors, str(partial), metadata={"state": record})
    partial.replace(workspace / CHECKPOINT)


def load_checkpoint(state: State, workspace: Path, identity: str) -> bool:
    """Restore the state from the workspace's checkpoint, and return whether there was one.

    Raises InputError when it belongs to a run with another identity.
    """
    path = workspace / CHECKPOINT
    if not path.is_file():
        return False
    tensors, metadata = read_tensors(path)
    record = _record(metadata, path)
    if record["identity"] != identity:
        raise InputError(
            path, "belongs to a run with another configuration", "remove it or train with the same options"
        )
    with torch.no_grad():
        for name, p in state.model.named_parameters():
            p.copy_(distributed.shard_like(tensors[f"model/{name}"], p))
            state.average[name].copy_(distributed.local_part(distributed.shard_like(tensors[f"average/{name}"], p)))
            moments = {key: tensors[f"{key}/{name}"] for key in MOMENTS if f"{key}/{name}" in tensors}
            if moments:
                restore_moments(
                    state.optimizer,
                    p,
                    {
                        key: value if key == "step" else distributed.shard_like(value.to(p.device), p)
                        for key, value in moments.items()
                    },
                )
    state.step, state.seconds = record["step"], record["seconds"]
    return True


def _record(metadata: dict[str, str], path: Path) -> dict[str, Any]:
    """Parse the step, seconds and identity in a checkpoint's metadata. Raises InputError where they are missing."""
    try:
        return msgspec.to_builtins(msgspec.convert(parse_json(metadata.get("state", ""), path), _Record))
    except msgspec.ValidationError as error:
        raise InputError(
            path, f"is not a checkpoint of gdtool ({error})", "remove it, and the training starts anew"
        ) from None


class _Record(msgspec.Struct, forbid_unknown_fields=True):
    """Describe a checkpoint's metadata."""

    step: Annotated[int, msgspec.Meta(ge=0)]
    seconds: Annotated[float, msgspec.Meta(ge=0)]
    identity: str


@dataclass(frozen=True)
class RunOptions:
    """Set how a run goes, apart from its configuration.

    seed: of all random choices. minutes: limit of the time spent in steps, None for none. checkpoint_every,
    validate_every: in steps. device: a torch device.
    """

    seed: int
    minutes: float | None = None
    checkpoint_every: int = 200
    validate_every: int = 1000
    device: str = "cpu"


@dataclass(frozen=True)
class Observers:
    """Hold the functions that the training loop calls: for validation, warnings, rows of the log, and progress."""

    validate: Callable[[State], None] = lambda state: None
    warn: Callable[[str], None] = lambda message: None
    log: Callable[[dict], None] = lambda record: None
    progress: Callable = lambda iterable, total, label: iterable


def run_training(
    model: Model,
    objects: Objects,
    train: TrainConfig,
    workspace: Path,
    options: RunOptions,
    observers: Observers = Observers(),
) -> State:
    """Train until all steps or minutes are spent, resuming from the checkpoint in workspace where there is one.

    The first process writes workspace/loss.csv and passes each row to observers.log. A step whose gradient is not
    finite is skipped with a warning. Raises InputError after MOST_SKIPPED such steps in a row.
    """
    # A run may go on on another machine, whose faster format is another.
    anywhere = msgspec.structs.replace(train, precision="auto")
    identity = msgspec.json.encode([model.config, anywhere, options.seed, len(objects)]).decode()
    train, _ = with_arithmetic(train, options.device)
    torch.manual_seed(options.seed)
    state = new_state(model.to(options.device).train(), train)
    state.average = {name: x.to(options.device) for name, x in state.average.items()}
    resumed = load_checkpoint(state, workspace, identity)
    log_path = workspace / "loss.csv"
    target = log_path if distributed.rank() == 0 else Path(os.devnull)
    with target.open("r+" if resumed and log_path.is_file() else "w", newline="") as file:
        writer = _resume_log(file, state.step if resumed else 0, columns(model.config, train))
        bar = iter(observers.progress(range(state.step, train.steps), train.steps, "training"))
        while progress_of(state, train, options.minutes) < 1:
            start = time.perf_counter()
            record = train_step(state, objects, train, options.seed, options.minutes, options.device)
            state.seconds += (
                distributed.sum_over_processes({"s": time.perf_counter() - start})["s"] / distributed.size()
            )
            writer.writerow(
                {k: (f"{v:.6g}" if isinstance(v, float) else v) for k, v in record.items()}
                | {"seconds": f"{state.seconds:.1f}"}
            )
            file.flush()
            observers.log(record)
            _warn_skipped(state, observers.warn)
            next(bar, None)
            if state.step % options.checkpoint_every == 0:
                save_checkpoint(state, workspace, identity)
            if state.step % options.validate_every == 0:
                whole = distributed.gather_state(state)
                if distributed.rank() == 0:
                    observers.validate(whole)
        for _ in bar:
            break
    save_checkpoint(state, workspace, identity)
    return distributed.gather_state(state)


def _warn_skipped(state: State, warn: Callable[[str], None]) -> None:
    """Warn where the last step was skipped. Raises InputError after MOST_SKIPPED skipped steps in a row."""
    if state.skipped >= MOST_SKIPPED:
        raise InputError(
            "training",
            f"has a gradient that is not finite in {MOST_SKIPPED} steps up to {state.step}",
            "lower learning_rate, or use --precision float32; the checkpoint has finite weights",
        )
    if state.skipped:
        warn(f"step {state.step} is left out: its gradient is not finite ({state.skipped} in a row)")


def _resume_log(file, step: int, parts: tuple[str, ...]) -> csv.DictWriter:
    """Create a writer of loss.csv that keeps the rows up to `step`.

    parts: names of the loss's parts. A resumed run starts at its checkpoint and writes the later rows again.
    """
    names = ["step", "seconds", "loss", "rate", "norm", "skipped", *parts]
    earlier_rows = [row for row in csv.DictReader(file) if int(row["step"]) <= step] if step else []
    file.seek(0)
    file.truncate() if file.name != os.devnull else None
    writer = csv.DictWriter(file, names, restval="", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(earlier_rows)
    return writer
