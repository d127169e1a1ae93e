"""Create the optimiser: AdamW for all weights, or Muon for inner matrices and AdamW for the rest."""

from __future__ import annotations

from typing import Any

import torch

from gdtool.core.errors import UsageError
from gdtool.diffusion.config import TrainConfig
from gdtool.diffusion.training import distributed

# Layers that read or write pixels or labels, by name. Muon's authors train first and last layers with AdamW.
FIRST_AND_LAST_LAYERS = (
    "conv_in",
    "conv_out",
    "class_embedding",
    "time_embedding",
    "position",
    "condition_gate",
    "embed",
    "read_picture",
    "read_space",
    "embed_code",
    "write",
    "project",
)
MOMENTS = ("step", "exp_avg", "exp_avg_sq", "momentum_buffer")
MIN_MUON_SIDE = 32  # least rows and columns of a matrix that Muon trains
# Muon's constants, from Jordan et al. 2024: the quintic polynomial that takes singular values toward 1, how often it is
# applied, and the momentum. The step is scaled to AdamW's usual size (Liu et al. 2025, "Muon is scalable").
POLYNOMIAL = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5
MOMENTUM = 0.95
ADAM_RMS = 0.2


def orthogonalise(matrix: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Make the singular values of a matrix (m, n) about 1, computing in dtype.

    Newton-Schulz iteration with POLYNOMIAL, after which they lie between about 0.7 and 1.2. Returns dtype.
    """
    a, b, c = POLYNOMIAL
    wide = matrix.to(dtype)
    if matrix.shape[0] > matrix.shape[1]:
        wide = wide.T
    wide = wide / wide.norm().clamp(min=1e-7)
    for _ in range(ITERATIONS):
        gram = wide @ wide.T
        wide = torch.addmm(wide, torch.addmm(gram, gram, gram, beta=b, alpha=c), wide, beta=a)
    return wide.T if matrix.shape[0] > matrix.shape[1] else wide


class MuonAndAdam:
    """Combine Muon (Jordan et al. 2024) for matrices and AdamW for the rest in one optimiser.

    matrices: parameters that Muon trains; a convolution is the matrix (outputs, inputs · taps). rest: parameter groups
    that AdamW trains. Muon's step is scaled to AdamW's usual size, so one learning rate serves both. It replaces
    torch.optim.Muon, which always orthogonalises in bfloat16: on processors without bfloat16 units that is eleven times
    slower than float32 and took twelve of the fourteen core-seconds of a step.
    """

    def __init__(self, matrices: list, rest: list[dict], train: TrainConfig):
        self.dtype = torch.bfloat16 if train.precision == "bfloat16" else torch.float32
        self.momentum: dict[torch.Tensor, torch.Tensor] = {}
        self.matrices = matrices
        self.group: dict[str, Any] = {"params": matrices, "lr": 1.0, "weight_decay": train.weight_decay, "rate": 1.0}
        self.adam = torch.optim.AdamW(rest, lr=1.0, betas=train.betas, fused=True)
        self.param_groups = [self.group, *self.adam.param_groups]

    @property
    def state(self) -> dict:
        """Map the network's parameters to their moments, as the state of a torch optimiser does."""
        return {**self.adam.state, **{p: {"momentum_buffer": moment} for p, moment in self.momentum.items()}}

    def restore(self, p: torch.Tensor, moments: dict[str, torch.Tensor]) -> None:
        """Set a parameter's moments to those of a checkpoint."""
        if any(p is matrix for matrix in self.matrices):
            self.momentum[p] = moments["momentum_buffer"].view(p.shape[0], -1)
        else:
            self.adam.state[p] = moments

    def step(self) -> None:
        """Take one step of both optimisers."""
        for p in self.matrices:
            if p.grad is not None:
                self._step_matrix(p)
        self.adam.step()

    @torch.no_grad()
    def _step_matrix(self, p: torch.Tensor) -> None:
        """Move one matrix along its orthogonalised Nesterov momentum."""
        assert p.grad is not None
        gradient, rate = p.grad.reshape(p.shape[0], -1), self.group["lr"]
        moment = self.momentum.setdefault(p, torch.zeros_like(gradient))
        moment.lerp_(gradient, 1 - MOMENTUM)
        direction = orthogonalise(gradient.lerp(moment, MOMENTUM), self.dtype)
        p.mul_(1 - rate * self.group["weight_decay"])
        scale = ADAM_RMS * max(gradient.shape) ** 0.5
        p.add_(direction.to(p.dtype).reshape(p.shape), alpha=-rate * scale)

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clear all gradients."""
        for p in self.matrices:
            p.grad = None
        self.adam.zero_grad(set_to_none=set_to_none)


def make_optimizer(model: torch.nn.Module, train: TrainConfig):
    """Create the configured optimiser of the parameters that have gradients.

    Weight decay applies to matrices and not to vectors.

    The class embedding has train.class_rate times the learning rate. Raises UsageError for Muon with weights that FSDP2
    has split.
    """
    groups: dict[tuple[bool, float], list] = {}
    matrices = []
    for name, p in model.named_parameters():
        if not p.requires_grad:
            continue
        inner = (
            p.ndim >= 2
            and min(p.shape[0], p[0].numel()) >= MIN_MUON_SIDE
            and not any(end in name.split(".") for end in FIRST_AND_LAST_LAYERS)
        )
        if train.optimizer == "muon" and inner:
            matrices.append(p)
            continue
        rate = train.class_rate if ".class_embedding." in f".{name}" else 1.0
        groups.setdefault((p.ndim >= 2, rate), []).append(p)
    rest = [
        {"params": ps, "weight_decay": train.weight_decay if decays else 0.0, "rate": rate}
        for (decays, rate), ps in groups.items()
    ]
    if not matrices:
        return torch.optim.AdamW(rest, lr=1.0, betas=train.betas, fused=True)
    if distributed.is_sharded(model):
        raise UsageError(
            "optimizer",
            "muon needs whole matrices, GDTOOL_SHARD splits them",
            "train without GDTOOL_SHARD, or with adamw",
        )
    return MuonAndAdam(matrices, rest, train)


def restore_moments(optimizer, p: torch.Tensor, moments: dict[str, torch.Tensor]) -> None:
    """Set a parameter's moments to those of a checkpoint, named as in `optimizer.state[p]`."""
    if isinstance(optimizer, MuonAndAdam):
        optimizer.restore(p, moments)
    else:
        optimizer.state[p] = moments
