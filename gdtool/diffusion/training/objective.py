"""Choose what a training step learns, and compute its loss: of the views, or of the shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig, Phase, TrainConfig
from gdtool.diffusion.data.objects import Batch, Objects, draw_batch
from gdtool.diffusion.data.volumes import ShapeBatch, draw_shape_batch
from gdtool.diffusion.inference.sampling import precision_context
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.encoding import BACKGROUND, encode, encode_condition
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.schedule import loss_weight
from gdtool.diffusion.training.losses import SHADED_DOMAINS, LitObject, image_error, rendering_error, view_directions
from gdtool.diffusion.training.painting import Given, draw_given
from gdtool.diffusion.training.shape_objective import SHAPE_PARTS, shape_losses


@dataclass(frozen=True)
class Step:
    """Hold the random choices of one step.

    domains: indices into DOMAINS, and views (k,): indices into the configuration's views; both are common to all
    objects of the batch. seed, number: of the run and of the step, which seed the choices of each object.
    """

    domains: tuple[int, ...]
    views: torch.Tensor
    seed: int
    number: int

    def choices(self, place: int) -> tuple[np.random.Generator, torch.Generator]:
        """Return the generators for the object at this place of the step's batch: NumPy's, and PyTorch's on the CPU."""
        choices = np.random.default_rng((self.seed, 3, self.number, place))
        return choices, torch.Generator().manual_seed(int(choices.integers(2**62)))


def choose_step(config: ModelConfig, phase: Phase, seed: int, step: int) -> Step:
    """Choose a step's domains and views at random.

    In a model with attention across domains, color is among the domains wherever there is more than one.
    """
    choices = np.random.default_rng((seed, 2, step))
    modelled = [DOMAINS.index(d) for d in config.domains]
    if phase.domains >= len(modelled):
        domains = tuple(modelled)
    elif phase.domains == 1 or config.cross_domain == "none":
        domains = tuple(sorted(choices.permutation(modelled)[: phase.domains].tolist()))
    else:
        domains = (0, *sorted(choices.permutation(modelled[1:])[: phase.domains - 1].tolist()))
    views = torch.from_numpy(np.sort(choices.permutation(len(config.views))[: phase.views]))
    return Step(domains, views, seed, step)


def view_losses(
    model: Model, batch: Batch, step: Step, generators: list[torch.Generator], train: TrainConfig
) -> dict[str, torch.Tensor]:
    """Compute the objective of a micro-batch of b objects, "loss", and its parts by name, each a mean over the objects.

    generators: b, one for each object. They decide its timestep, noise, background, dropped conditions and shaded
    pixels.
    """
    config, b, device = model.config, len(batch.planes), batch.planes.device
    layout = Layout(b, step.domains, len(step.views))
    n = layout.images // b

    # four numbers for each object: timestep, whether it is the last one, what is dropped, background
    dice = torch.stack([torch.rand(4, generator=generator) for generator in generators])
    background = torch.tensor(
        [BACKGROUND[config.backgrounds[int(x * len(config.backgrounds))]] for x in dice[:, 3]], device=device
    )
    planes = batch.planes[:, step.views]
    truth = encode(planes, step.domains, background)  # (b, d, k, 3, h, w)
    clean = model.codec.encode(truth.flatten(0, 2))
    rgba = encode_condition(batch.condition, background)

    # One timestep for all images of an object, as when sampling.
    t = (dice[:, 0] * config.timesteps).long()
    t = torch.where(dice[:, 1] < train.pure_noise, config.timesteps - 1, t).to(device)
    noise = torch.cat([torch.randn(n, *clean.shape[1:], generator=generator) for generator in generators]).to(device)
    a, s = model.levels(t, layout)
    noisy = a * clean + s * noise

    drop = dice[:, 2].to(device)
    embedding_off = drop < train.drop_embedding + train.drop_both
    latent_off = (drop >= train.drop_embedding) & (drop < train.drop_embedding + train.drop_both + train.drop_latent)
    given = draw_given(model, batch, generators, train.precision) if config.shape else None
    with precision_context(device, train.precision):
        context = model.encoder(rgba) * ~embedding_off[:, None, None]
        if given is None:
            condition = model.condition_latents(rgba, layout, step.views)
        else:
            condition = model.condition_latents(rgba, layout, step.views, given.guides, given.known)
        kept = ~latent_off.repeat_interleave(len(condition.inputs) // b)
        predicted = model.predict_clean(
            noisy, condition.scaled(kept[:, None, None, None]), t, context, layout, step.views
        )

    trust = None if given is None else trusted(given, step)
    weighted, square = image_error(predicted, clean, b, step.domains, config, train, trust)  # (b, d) each
    weight = loss_weight(model.alpha[t], model.sigma[t], train.snr_gamma, train.snr_floor)
    total = (weight[:, None] * weighted).mean()
    parts = {DOMAINS[i]: square[:, j].mean().detach() for j, i in enumerate(step.domains)}

    snr = (model.alpha[t] / model.sigma[t]).square()
    near = torch.nonzero(snr > train.pbr_snr).flatten()
    if train.pbr_weight > 0 and len(near) and {1, 3, 4, 5} <= set(step.domains):
        # Only the domains that shading reads are decoded, and only of these objects.
        lit = [j for j, i in enumerate(step.domains) if DOMAINS[i] in SHADED_DOMAINS]
        latents = predicted.unflatten(0, (b, len(step.domains), -1))[:, lit]
        directions = view_directions(config)[step.views].to(device)
        order = {step.domains[j]: place for place, j in enumerate(lit)}
        rendered = []
        for i in near.tolist():
            images = model.codec.decode(latents[i].flatten(0, 1)).unflatten(0, latents.shape[1:3])
            error = rendering_error(
                images,
                truth[i][lit],
                order,
                LitObject(planes=planes[i], lights=batch.lights[i], views=directions, background=float(background[i])),
                pixels=train.pbr_pixels,
                generator=generators[i],
            )
            rendered.append(snr[i].clamp(max=train.snr_gamma) * error)
        parts["rendering"] = (torch.stack(rendered).sum() / b).detach()
        total = total + train.pbr_weight * torch.stack(rendered).sum() / b
    return {"loss": total, **parts}


def trusted(given: Given, step: Step) -> torch.Tensor:
    """Return the weights (b, d, k, h, w) of the pixels of a step's images; 0 for known images."""
    unknown = 1 - given.known.given[:, :, step.views]
    return unknown[..., None, None] * given.trust[:, None, step.views]


def draw(
    objects: Objects,
    idx: np.ndarray,
    config: ModelConfig,
    train: TrainConfig,
    generators: Sequence[np.random.Generator],
) -> Batch | ShapeBatch:
    """Make a batch of the objects idx (b,) for the part of the model that is trained; one generator for each."""
    return (draw_shape_batch if train.part == "shape" else draw_batch)(objects, idx, config, train, generators)


def columns(config: ModelConfig, train: TrainConfig) -> tuple[str, ...]:
    """Return the names of the loss's parts, in the order of loss.csv."""
    return SHAPE_PARTS if train.part == "shape" else (*config.domains, "rendering")


class Objective(torch.nn.Module):
    """Wrap the losses as a module, so that the hooks of DDP and FSDP see the forward pass."""

    def __init__(self, model: Model, train: TrainConfig):
        super().__init__()
        self.model, self.train_config = model, train

    def forward(
        self, batch: Batch | ShapeBatch, step: Step, generators: list[torch.Generator]
    ) -> dict[str, torch.Tensor]:
        """Compute the losses of a micro-batch by name."""
        if isinstance(batch, ShapeBatch):
            return shape_losses(self.model, batch, step.number, generators, self.train_config)
        return view_losses(self.model, batch, step, generators, self.train_config)
