"""Create the optimiser: AdamW for all weights, or Muon for inner matrices and AdamW for the rest."""

from __future__ import annotations

import torch

from gdtool.core.errors import ResourceError, UsageError
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
)
MOMENTS = ("step", "exp_avg", "exp_avg_sq", "momentum_buffer")
MIN_MUON_SIDE = 32  # least rows and columns of a matrix that Muon trains


class MuonAndAdam:
    """Combine torch.optim.Muon (Jordan et al. 2024) and AdamW in one optimiser.

    matrices: parameters that Muon trains; a convolution is the matrix (outputs, inputs · taps). rest: parameter groups
    that AdamW trains. Muon's step is scaled to AdamW's usual size, so one learning rate serves both.
    """

    def __init__(self, matrices: list, rest: list[dict], train: TrainConfig):
        if not hasattr(torch.optim, "Muon"):
            raise ResourceError("muon", f"is not in torch {torch.__version__}", "use 2.11 or later, or optimizer adamw")
        self.matrices = matrices
        self.flat = [torch.nn.Parameter(p.detach().view(p.shape[0], -1)) for p in matrices]  # the same memory
        self.muon = torch.optim.Muon(
            self.flat, lr=1.0, weight_decay=train.weight_decay, momentum=0.95, adjust_lr_fn="match_rms_adamw"
        )
        self.adam = torch.optim.AdamW(rest, lr=1.0, betas=train.betas, fused=True)
        for group in self.muon.param_groups:
            group["rate"] = 1.0
        self.param_groups = self.muon.param_groups + self.adam.param_groups

    @property
    def state(self) -> dict:
        """Map the network's parameters to their moments, as the state of a torch optimiser does."""
        matrix_state = {
            p: self.muon.state[flat]
            for p, flat in zip(self.matrices, self.flat, strict=True)
            if flat in self.muon.state
        }
        return {**self.adam.state, **matrix_state}

    def restore(self, p: torch.Tensor, moments: dict[str, torch.Tensor]) -> None:
        """Set a parameter's moments to those of a checkpoint."""
        for matrix, flat in zip(self.matrices, self.flat, strict=True):
            if matrix is p:
                self.muon.state[flat] = moments
                return
        self.adam.state[p] = moments

    def step(self) -> None:
        """Take one step of both optimisers."""
        for p, flat in zip(self.matrices, self.flat, strict=True):
            flat.grad = None if p.grad is None else p.grad.reshape(flat.shape)
        self.muon.step()
        self.adam.step()

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Clear all gradients."""
        for p in (*self.matrices, *self.flat):
            p.grad = None
        self.adam.zero_grad(set_to_none=set_to_none)


def make_optimizer(model: torch.nn.Module, train: TrainConfig):
    """Create the configured optimiser. Weight decay applies to matrices and not to vectors.

    The class embedding has train.class_rate times the learning rate. Raises UsageError for Muon with weights that FSDP2
    has split.
    """
    groups: dict[tuple[bool, float], list] = {}
    matrices = []
    for name, p in model.named_parameters():
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
