"""The training loop, top to bottom: draw, noise, predict, compare, step, average, write down.

A run is a pure function of data, configuration and seed: each step's choices come from (seed, step), and a checkpoint
holds all else (weights, their average, the optimiser's moments), so that a resumed run is bit for bit the unbroken one.
"""

from __future__ import annotations

import csv
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.attention import Layout
from gdtool.diffusion.config import DOMAINS, ModelConfig, Phase, TrainConfig
from gdtool.diffusion.data import Batch, Objects, draw, object_order
from gdtool.diffusion.encoding import BACKGROUND, encode, encode_condition
from gdtool.diffusion.losses import rendering_error, view_directions
from gdtool.diffusion.model import Model
from gdtool.diffusion.sampling import precision_context
from gdtool.diffusion.schedule import loss_weight
from gdtool.diffusion.weights import read_tensors

CHECKPOINT = "checkpoint.safetensors"


@dataclass
class State:
    """Everything that changes while training."""

    model: Model
    optimizer: torch.optim.Optimizer
    average: dict[str, torch.Tensor]
    step: int = 0
    seconds: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)


@dataclass(frozen=True)
class Step:
    """The random choices of one step that all its objects share."""

    domains: tuple[int, ...]
    views: torch.Tensor
    generator: torch.Generator
    choices: np.random.Generator


def new_state(model: Model, train: TrainConfig) -> State:
    """AdamW; matrices decay, vectors do not; the class embedding has its own learning rate."""
    groups: dict[tuple[bool, float], list] = {}
    for name, p in model.named_parameters():
        rate = train.class_rate if ".class_embedding." in f".{name}" else 1.0
        groups.setdefault((p.ndim >= 2, rate), []).append(p)
    optimizer = torch.optim.AdamW(
        [{"params": ps, "weight_decay": train.weight_decay if decays else 0.0, "rate": rate} for (decays, rate), ps in groups.items()],
        lr=1.0, betas=train.betas, fused=True)
    return State(model, optimizer, {name: p.detach().clone() for name, p in model.named_parameters()})


def progress_of(state: State, train: TrainConfig, minutes: float | None) -> float:
    """How much of the run is over, 0…1: by steps, or by minutes where those are given and sooner spent."""
    return min(max(state.step / train.steps, state.seconds / 60 / minutes if minutes else 0.0), 1.0)


def phase_at(progress: float, train: TrainConfig) -> Phase:
    return next((phase for phase in train.phases if progress < phase.share), train.phases[-1])


def learning_rate(state: State, progress: float, train: TrainConfig) -> float:
    rate = phase_at(progress, train).learning_rate * min((state.step + 1) / train.warmup, 1.0)
    return rate * (0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress))) if train.decay else rate


def choose(config: ModelConfig, phase: Phase, seed: int, step: int) -> Step:
    """Which domains and views a step sees: color always where it is primary and more than one domain is drawn."""
    choices = np.random.default_rng((seed, 2, step))
    generator = torch.Generator().manual_seed(int(choices.integers(2**62)))
    own = [DOMAINS.index(d) for d in config.domains]
    if phase.domains >= len(own):
        domains = tuple(own)
    elif phase.domains == 1 or config.cross_domain == "none":
        domains = tuple(sorted(choices.permutation(own)[: phase.domains].tolist()))
    else:
        domains = (0, *sorted(choices.permutation(own[1:])[: phase.domains - 1].tolist()))
    views = torch.from_numpy(np.sort(choices.permutation(len(config.views))[: phase.views]))
    return Step(domains, views, generator, choices)


def losses(model: Model, batch: Batch, step: Step, train: TrainConfig) -> dict[str, torch.Tensor]:
    """The objective of one micro-batch and its parts by name."""
    config, b, device = model.config, len(batch.planes), batch.planes.device
    layout = Layout(b, step.domains, len(step.views))
    n = layout.images // b

    def random(*shape):
        return torch.rand(*shape, generator=step.generator)

    background = torch.tensor([BACKGROUND[config.backgrounds[int(i)]] for i in step.choices.integers(len(config.backgrounds), size=b)])
    background = background.to(device)
    planes = batch.planes[:, step.views]
    truth = encode(planes, step.domains, background)  # (b, d, k, 3, h, w)
    clean = model.codec.encode(truth.flatten(0, 2))
    rgba = encode_condition(batch.condition, background)

    # One timestep per object: sampling never sees anything else.
    t = (random(b) * config.timesteps).long()
    t = torch.where(random(b) < train.pure_noise, config.timesteps - 1, t).to(device)
    noise = torch.randn(clean.shape, generator=step.generator).to(device)
    a, s = model.levels(t, layout)
    noisy = a * clean + s * noise

    dice = random(b).to(device)
    embedding_off = dice < train.drop_embedding + train.drop_both
    latent_off = (dice >= train.drop_embedding) & (dice < train.drop_embedding + train.drop_both + train.drop_latent)
    with precision_context(device, train.precision):
        context = model.encoder(rgba) * ~embedding_off[:, None, None]
        condition = model.condition_latents(rgba, layout, step.views) * ~latent_off.repeat_interleave(n)[:, None, None, None]
        predicted = model.predict_clean(noisy, condition, t, context, layout, step.views)

    square = (predicted - clean).float().square().mean((1, 2, 3)).view(b, len(step.domains), -1).mean(2)  # (b, d)
    weight = loss_weight(model.signal[t], model.deviation[t], train.snr_gamma, train.snr_floor)
    total = (weight[:, None] * square).mean()
    parts = {DOMAINS[i]: square[:, j].mean().detach() for j, i in enumerate(step.domains)}

    snr = (model.signal[t] / model.deviation[t]).square()
    near = torch.nonzero(snr > train.pbr_snr).flatten()
    if train.pbr_weight > 0 and len(near) and {1, 3, 4, 5} <= set(step.domains):
        images = model.codec.decode(predicted).unflatten(0, (b, len(step.domains), len(step.views)))
        directions = view_directions(config)[step.views].to(device)
        order = {i: j for j, i in enumerate(step.domains)}
        rendered = [
            snr[i].clamp(max=train.snr_gamma)
            * rendering_error(images[i], truth[i], order, planes[i], batch.lights[i], directions, train.pbr_pixels,
                              float(background[i]), step.generator)
            for i in near.tolist()]
        parts["rendering"] = torch.stack(rendered).mean().detach()
        total = total + train.pbr_weight * torch.stack(rendered).sum() / b
    return {"loss": total, **parts}


def train_step(state: State, objects: Objects, train: TrainConfig, seed: int, minutes: float | None, device: str) -> dict[str, float]:
    """One optimiser step over the phase's objects in `accumulate` parts; updates state."""
    config, progress = state.model.config, progress_of(state, train, minutes)
    phase = phase_at(progress, train)
    step = choose(config, phase, seed, state.step)
    rate = learning_rate(state, progress, train)
    for group in state.optimizer.param_groups:
        group["lr"] = rate * group["rate"]
    idx = object_order(len(objects), state.step, phase.batch or train.batch, seed)
    sums: dict[str, float] = {}
    for part in np.array_split(idx, train.accumulate):
        batch = draw(objects, part, config, train, step.choices)
        batch = Batch(batch.planes.to(device), batch.condition.to(device), batch.lights.to(device))
        parts = losses(state.model, batch, step, train)
        share = len(part) / len(idx)
        (parts["loss"] * share).backward()
        for name, value in parts.items():
            sums[name] = sums.get(name, 0.0) + float(value.detach()) * share
    norm = torch.nn.utils.clip_grad_norm_(state.model.parameters(), train.clip)
    if bool(torch.isfinite(norm)):  # a step that is not finite is left out rather than the whole run lost
        state.optimizer.step()
    state.optimizer.zero_grad(set_to_none=True)
    state.step += 1
    keep = min(train.ema, (1 + state.step) / (10 + state.step))
    names = list(state.average)
    own = dict(state.model.named_parameters())
    torch._foreach_lerp_([state.average[n] for n in names], [own[n].detach() for n in names], 1 - keep)
    return {"step": state.step, "rate": rate, "norm": float(norm), **sums}


def save_checkpoint(state: State, workspace: Path, identity: str) -> None:
    """Write weights, average and moments beside the old checkpoint, then replace it."""
    from safetensors.torch import save_file

    tensors = {}
    for name, p in state.model.named_parameters():
        tensors[f"model/{name}"] = p.detach()
        tensors[f"average/{name}"] = state.average[name]
        for key, value in state.optimizer.state.get(p, {}).items():
            tensors[f"{key}/{name}"] = value
    tensors = {name: x.cpu().contiguous() for name, x in tensors.items()}
    record = json.dumps({"step": state.step, "seconds": state.seconds, "identity": identity})
    partial = workspace / f".{CHECKPOINT}.partial"
    save_file(tensors, str(partial), metadata={"state": record})
    os.replace(partial, workspace / CHECKPOINT)


def load_checkpoint(state: State, workspace: Path, identity: str) -> bool:
    """Bring state to the workspace's checkpoint, if there is one. Raises InputError when it belongs to another run."""
    path = workspace / CHECKPOINT
    if not path.is_file():
        return False
    tensors, metadata = read_tensors(path)
    record = json.loads(metadata["state"])
    if record["identity"] != identity:
        raise InputError(path, "belongs to a run with another configuration", "remove it or train with the same options")
    with torch.no_grad():
        for name, p in state.model.named_parameters():
            p.copy_(tensors[f"model/{name}"])
            state.average[name].copy_(tensors[f"average/{name}"])
            if f"exp_avg/{name}" in tensors:
                state.optimizer.state[p] = {key: tensors[f"{key}/{name}"].to(p.device if key != "step" else "cpu")
                                            for key in ("step", "exp_avg", "exp_avg_sq")}
    state.step, state.seconds = record["step"], record["seconds"]
    return True


def run_training(model: Model, objects: Objects, train: TrainConfig, workspace: Path, *, seed: int, minutes: float | None = None,
                 checkpoint_every: int = 200, validate_every: int = 1000, validate: Callable[[State], None] = lambda state: None,
                 device: str = "cpu", progress=lambda iterable, total, label: iterable) -> State:
    """Train until the steps or the minutes are spent; resumes from workspace. Writes workspace/loss.csv as it goes."""
    identity = msgspec.json.encode([model.config, train, seed, len(objects)]).decode()
    torch.manual_seed(seed)
    state = new_state(model.to(device).train(), train)
    state.average = {name: x.to(device) for name, x in state.average.items()}
    resumed = load_checkpoint(state, workspace, identity)
    columns = ["step", "seconds", "loss", "rate", "norm", *model.config.domains, "rendering"]
    log_path = workspace / "loss.csv"
    kept = []
    if resumed and log_path.is_file():  # rows after the checkpoint will be written again
        with open(log_path, newline="") as file:
            kept = [row for row in csv.DictReader(file) if int(row["step"]) <= state.step]
    with open(log_path, "w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", extrasaction="ignore")
        writer.writeheader()
        writer.writerows(kept)
        bar = iter(progress(range(state.step, train.steps), train.steps, "training"))
        while progress_of(state, train, minutes) < 1:
            start = time.perf_counter()
            record = train_step(state, objects, train, seed, minutes, device)
            state.seconds += time.perf_counter() - start
            writer.writerow({k: (f"{v:.6g}" if isinstance(v, float) else v) for k, v in record.items()} | {"seconds": f"{state.seconds:.1f}"})
            file.flush()
            next(bar, None)
            if state.step % checkpoint_every == 0:
                save_checkpoint(state, workspace, identity)
            if state.step % validate_every == 0:
                validate(state)
        for _ in bar:
            break
    save_checkpoint(state, workspace, identity)
    return state
