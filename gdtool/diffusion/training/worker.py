"""Run a training in every process: the first one sends an order, and all of them execute it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from gdtool.diffusion.checkpoint.weights import check_shapes, load_model
from gdtool.diffusion.config import ModelConfig, TrainConfig
from gdtool.diffusion.data.objects import Objects, decode_dataset
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.training import distributed
from gdtool.diffusion.training.loop import Observers, RunOptions, State, run_training


@dataclass(frozen=True)
class Order:
    """Describe a training to all processes.

    start: model folder whose weights the training starts from, or None. workspace: folder with the decoded objects and
    the checkpoint. used: number of objects that are trained on; the others are for validation.
    """

    model: ModelConfig
    train: TrainConfig
    start: Path | None
    workspace: Path
    used: int
    run: RunOptions


def execute(order: Order, objects: Objects, observers: Observers | None = None) -> State:
    """Train a model by the order; every process calls it with the same arguments and takes part in each batch.

    observers: of the first process.
    """
    torch.manual_seed(order.run.seed)
    model = Model(order.model)
    if order.start is not None:
        from gdtool.diffusion.network.grow import grow_weights

        loaded = load_model(order.start)
        tensors = grow_weights(loaded.state_dict(), loaded.config, order.model)
        check_shapes(order.start, tensors, model.state_dict())
        model.load_state_dict(tensors)
    elif order.model.codec == "vae":
        from gdtool.diffusion.checkpoint.pretrained import start_from_pretrained

        start_from_pretrained(model)
    return run_training(model, objects, order.train, order.workspace, order.run, observers or Observers())


def follow(threads: int) -> None:
    """Wait for the first process's order, train by it, and end this process: the whole work of the other processes.

    threads: limit of PyTorch's threads, 0 for none.
    """
    if threads:
        torch.set_num_threads(threads)
    order = distributed.receive()
    if order is not None:
        every = decode_dataset((), 0, order.model, order.workspace)
        execute(order, every.part(slice(order.used)))
    distributed.leave()
