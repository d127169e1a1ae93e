"""Split training over several processes that torchrun starts.

    torchrun --nproc_per_node 8 -m -- gdtool train objects --preset paper --device cuda -o my-model

Gradients are exchanged by PyTorch's DistributedDataParallel, or with GDTOOL_SHARD=1 by fully_shard (FSDP2), which
splits the weights, gradients and moments over the processes. With one process the functions here return their input.
The first process alone runs the stage and writes files. The others call worker.follow() and read the same data through
the memory-mapped arrays in the first one's workspace.
"""

from __future__ import annotations

import contextlib
import os
import sys
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import nn

# The other processes wait while the first one decodes the data and makes validation pictures. PyTorch's default limit
# is 10 or 30 minutes. torchrun ends all processes when one dies, so a long limit hides no failure.
GROUP_TIMEOUT = timedelta(days=2)


def size() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if dist.is_initialized() else 1


def rank() -> int:
    """Return this process's number; 0 is the first."""
    return dist.get_rank() if dist.is_initialized() else 0


def start() -> None:
    """Join the process group, where torchrun started several processes and this one has not joined yet."""
    if int(os.environ.get("WORLD_SIZE", "1")) > 1 and not dist.is_initialized():
        dist.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo", timeout=GROUP_TIMEOUT)
        if torch.cuda.is_available():
            torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))


def send(order: Any) -> None:
    """Send an order from the first process to the others; None tells them that there is no work."""
    if size() > 1:
        dist.broadcast_object_list([order], src=0)


def leave() -> None:
    """End this process, and, from the first one, also those that still wait for an order.

    Does not return in one of several processes, and does nothing in a single one. It skips the interpreter's shutdown.
    DDP keeps the group's threads alive, and a thread that drops its last tensor during shutdown aborts the process
    (pytorch/pytorch#179291; seen once in 40 runs).
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return
    if not dist.is_initialized():
        start()
        send(None)
    dist.destroy_process_group()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)


def receive() -> Any:
    """Wait for the order of the first process and return it; None where there is no work."""
    start()
    order = [None]
    dist.broadcast_object_list(order, src=0)
    return order[0]


def part_for_process(part: np.ndarray) -> np.ndarray:
    """Return this process's part of an array (n, …), about n over the number of processes."""
    return np.array_split(part, size())[rank()]


def sum_over_processes(figures: dict[str, float]) -> dict[str, float]:
    """Sum figures by name over all processes. A process that lacks a name counts as 0."""
    if size() == 1:
        return figures
    every: list = [None] * size()
    dist.all_gather_object(every, figures)
    return {
        name: sum(summand.get(name, 0.0) for summand in every)
        for name in dict.fromkeys(name for summand in every for name in summand)
    }


def wrap(objective: nn.Module) -> nn.Module:
    """Wrap the objective with DDP or FSDP2, so that processes exchange gradients; unchanged with one process."""
    if size() == 1:
        return objective
    if os.environ.get("GDTOOL_SHARD") == "1":
        from torch.distributed.fsdp import fully_shard

        from gdtool.diffusion.network.attention import RowAttention, Transformer
        from gdtool.diffusion.network.unet import Resnet

        for module in objective.modules():
            if isinstance(module, Resnet | Transformer | RowAttention):
                fully_shard(module)
        return fully_shard(objective)
    # Not every step sees every domain and view, so not every weight has a gradient.
    return nn.parallel.DistributedDataParallel(objective, find_unused_parameters=True)


def synchronised(objective: nn.Module, last: bool):
    """Return a context in which DDP exchanges gradients only in the last part of a batch."""
    if isinstance(objective, nn.parallel.DistributedDataParallel) and not last:
        return objective.no_sync()
    return contextlib.nullcontext()


def is_sharded(model: nn.Module) -> bool:
    """Tell whether FSDP2 has split the model's parameters."""
    return any(hasattr(p, "full_tensor") for p in model.parameters())


def local_part(x: torch.Tensor, whole: bool = False) -> torch.Tensor:
    """Return this process's part of a tensor that FSDP2 has split, or with `whole` all of it; detached."""
    x = x.detach()
    if not hasattr(x, "to_local"):
        return x
    return x.full_tensor() if whole else x.to_local()


def gather(x: torch.Tensor, like: torch.Tensor | None = None) -> torch.Tensor:
    """Gather a tensor that is split over the processes.

    x is a DTensor, or this process's part of a tensor that is split in the same way as the DTensor `like`.
    """
    if like is not None and hasattr(like, "full_tensor") and not hasattr(x, "full_tensor"):
        from torch.distributed.tensor import DTensor

        x = DTensor.from_local(x, like.device_mesh, like.placements, shape=like.shape, stride=like.stride())
    return x.full_tensor() if hasattr(x, "full_tensor") else x


def shard_like(x: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """Split a whole tensor over the processes in the same way as the DTensor `like`."""
    if not hasattr(like, "full_tensor"):
        return x
    from torch.distributed.tensor import distribute_tensor

    return distribute_tensor(x.to(like.device), like.device_mesh, like.placements)


def gather_state(state):
    """Return a copy of the state with whole weights and averages, for writing and validation.

    Every process must call it. Without FSDP2 it returns the state itself.
    """
    if not is_sharded(state.model):
        return state
    from gdtool.diffusion.network.model import Model

    parameters = dict(state.model.named_parameters())
    average = {name: gather(x, parameters[name]) for name, x in state.average.items()}
    weights = {name: gather(p.detach()) for name, p in parameters.items()}
    config = state.model.config
    encoder = state.model.encoder if config.encoder == "clip" else None  # frozen, and so not split
    model = Model(config, state.model.codec, encoder).to(next(iter(weights.values())).device).train()
    model.load_state_dict(weights, strict=False)
    return replace(state, model=model, average=average)
