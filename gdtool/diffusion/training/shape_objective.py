"""Compute the training loss of the shape network and of the prior of its codes."""

from __future__ import annotations

import math

import torch

from gdtool.diffusion.config import TrainConfig
from gdtool.diffusion.data.volumes import ShapeBatch
from gdtool.diffusion.inference.sampling import precision_context
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.shape.latent import CODE_NOISE
from gdtool.diffusion.shape.losses import ROW_STEP, shape_errors

SHAPE_PARTS = ("voxels", "front", "side", "diagonal", "prior")


def shape_losses(
    model: Model, batch: ShapeBatch, number: int, generators: list[torch.Generator], train: TrainConfig
) -> dict[str, torch.Tensor]:
    """Compute the loss of b volumes, "loss", and its parts by name (SHAPE_PARTS), each a mean over the objects.

    number: the step's, which decides the slices that are compared in diagonal views. generators: b, one for each
    object; they decide the noise of its code and of the prior.
    """
    config = model.config
    assert config.shape is not None
    noise = torch.stack([torch.randn(2, config.shape.code, generator=generator) for generator in generators])
    angle = torch.stack([torch.rand((), generator=generator) for generator in generators]) * (math.pi / 2)
    device = batch.picture.device
    return errors_of_volumes(model, batch, number % ROW_STEP, noise.to(device), angle.to(device), train.precision)


def errors_of_volumes(
    model: Model, batch: ShapeBatch, first_row: int, noise: torch.Tensor, angle: torch.Tensor, precision: str
) -> dict[str, torch.Tensor]:
    """Compute the loss of b volumes by random numbers that are given; returns what shape_losses() does.

    first_row: where the slices begin that are compared in diagonal views. noise (b, 2, c): of the codes, and of the
    prior. angle (b,): the prior's noise, 0 to pi / 2. precision: "float32" or "bfloat16".
    """
    network = model.shape
    assert network is not None
    code = network.code(batch.occupancy)
    with precision_context(batch.picture.device, precision):
        features = network.summarise(batch.picture, batch.space)
        logits = network.expand(features, code + CODE_NOISE * noise[:, 0], batch.known)
    parts = shape_errors(logits.float(), batch.occupancy, batch.space, first_row, model.config.image_size)
    parts["prior"] = network.prior.loss(code, features[-1].float().mean((2, 3)), angle, noise[:, 1])
    return {"loss": torch.stack(list(parts.values())).sum(), **{name: value.detach() for name, value in parts.items()}}
