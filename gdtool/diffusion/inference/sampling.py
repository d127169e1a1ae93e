"""Sample the images of all views and domains from a framed condition image."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from gdtool.core.errors import InputError, UsageError
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.inference.shape import make_guides
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.eight_bit import composite
from gdtool.diffusion.network.encoding import BACKGROUND, MIRRORED_VIEW, encode_condition, mirror_images
from gdtool.diffusion.network.known import KnownImages, keep_known, mirror_known
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.schedule import Renewal, Spacing, sample
from gdtool.diffusion.shape.guides import Guides, mirror_guides


def precision_context(device: torch.device | str, precision: str):
    """Return the autocast context for the networks. Lighting is computed outside of it, in float32."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16) if precision == "bfloat16" else nullcontext()


@dataclass(frozen=True)
class SamplingOptions:
    """Set how views are sampled from a model.

    None stands for the model's own value. domains: those to return; sampled_domains() says what is sampled with them.
    steps: number of denoising steps. guidance: factor of classifier-free guidance; 1 is none. guided_from, guided_to:
    it acts between these timesteps only, as shares of all, 0 to 1; other steps take half the time (Kynkäänniemi et al.
    2024). scheduler: "ddim" or "dpm". eta: share of the noise that each step of DDIM renews, 0 to 1. spacing: of the
    timesteps. mirror: average, at each step, the predictions for the picture and for its mirror image, where the model
    can do it.
    """

    domains: tuple[str, ...] = DOMAINS
    steps: int | None = None
    guidance: float | None = None
    guided_from: float = 0.0
    guided_to: float = 1.0
    seed: int = 0
    scheduler: str = "ddim"
    eta: float | None = None
    spacing: Spacing | None = None
    precision: str = "float32"
    mirror: bool | None = None

    def used_with(self, config: ModelConfig) -> SamplingSettings:
        """Return the settings that are used with a model: its own ones where these options have None.

        DPM-Solver++ is deterministic, so its eta is 0. Raises UsageError where it is given another one.
        """
        if self.scheduler == "dpm" and self.eta:
            raise UsageError("--eta", "only DDIM renews noise", "leave --eta or --scheduler dpm out")
        own_eta = 0.0 if self.scheduler == "dpm" else config.sampling_eta
        return SamplingSettings(
            steps=config.sampling_steps if self.steps is None else self.steps,
            guidance=config.sampling_guidance if self.guidance is None else self.guidance,
            eta=own_eta if self.eta is None else self.eta,
            spacing=config.sampling_spacing if self.spacing is None else self.spacing,
        )


@dataclass(frozen=True)
class SamplingSettings:
    """Hold the settings of a sampling that a model has its own values for; see SamplingOptions."""

    steps: int
    guidance: float
    eta: float
    spacing: Spacing


def sampled_domains(config: ModelConfig, wanted: tuple[str, ...]) -> tuple[str, ...]:
    """Return the domains to sample so that those wanted come out as in a run of all domains of the model.

    They are all of them where domains are channels of one image. Otherwise, without attention across domains, they are
    those wanted. With color as the only query ("one_way") the other domains
    do not depend on any, and color on all. In the other modes every domain depends on all. Attention in a star needs
    color; a model without it has none.
    """
    star = config.cross_domain in ("one_way", "two_way")
    if config.domain_layout == "channels":
        return config.domains
    independent = config.cross_domain == "none" or (star and "color" not in config.domains)
    if independent or (config.cross_domain == "one_way" and "color" not in wanted):
        return tuple(d for d in config.domains if d in wanted)
    return config.domains


def noise_domains(config: ModelConfig) -> tuple[str, ...]:
    """Return the domains that noise is drawn for, in that order, whatever domains are sampled.

    A seed's noise for a domain is then always the same. Wonder3D's code draws that of normals first, then of color.
    """
    if config.convention != "wonder3d":
        return DOMAINS
    return ("normal", "color", *(d for d in config.domains if d not in ("normal", "color")))


@torch.no_grad()
def sample_images(
    model: Model,
    rgba: torch.Tensor,
    options: SamplingOptions = SamplingOptions(),
    *,
    guides: Guides | None = None,
    known: KnownImages | None = None,
    progress: Callable = lambda iterable, total, label: iterable,
    draw: Callable[[], torch.Tensor] | None = None,
) -> dict[str, torch.Tensor]:
    """Sample every view of the domains for a batch of objects.

    rgba (b, 4, h, w): framed condition in [-1, 1], as objects.condition_plane() encodes it. draw: replaces the seed's
    noise; each call gives standard normal latents of one object, (d k, c, h, w) for the d domains of noise_domains().
    Returns encoded images (b, k, 3, h, w) by domain, over the first of the configuration's backgrounds, of all domains
    that were sampled. The noise depends on the seed alone, so an object's views do not depend on the rest of the batch.

    guides: of a model with a shape network, as shape.make_guides() makes them, which it does here where they are None.
    known: images that are given, for a model with the domains as channels; they are returned as they are.
    """
    config, device, settings = model.config, rgba.device, options.used_with(model.config)
    mirror = averages_mirror_image(config, options)
    if config.shape and guides is None:
        guides = make_guides(model, rgba, known, mirror=mirror)
    wanted = sampled_domains(config, options.domains)
    indices = tuple(DOMAINS.index(d) for d in wanted)
    condition_guides, condition_known = guides, known
    if mirror:
        rgba = torch.cat([rgba, rgba.flip(-1)])
        if guides is not None:
            condition_guides = join(guides, mirror_guides(guides, config.views))
        if known is not None:
            condition_known = join(known, mirror_known(known, indices, config.views))
    b = len(rgba)
    views = torch.arange(len(config.views))
    noise_of_object = _object_noise(model, wanted, draw or _seeded_noise(model, options.seed))

    def mirror_latents(latents):
        """Mirror latents (n, c, h, w) of whole objects about x = 0: decode, mirror, encode."""
        images = model.codec.decode(latents).unflatten(0, (-1, len(indices), len(views)))
        return model.codec.encode(mirror_images(images, indices, config.views).flatten(0, 2))

    def with_mirror_images(latents):
        """Append the latents of the mirrored images to latents (n, c, h, w), which gives (2 n, c, h, w)."""
        return torch.cat([latents, mirror_latents(latents)])

    def draw_noise():
        """Draw noise (n, c, h, w); every object of the batch has the same."""
        noise = noise_of_object().to(device)
        return with_mirror_images(noise.repeat(b // 2, 1, 1, 1)) if mirror else noise.repeat(b, 1, 1, 1)

    background = torch.full((b,), BACKGROUND[config.backgrounds[0]], device=device)
    rgba = (composite if config.convention == "wonder3d" else encode_condition)(rgba, background)
    guided = settings.guidance != 1.0
    with precision_context(device, options.precision):
        context = model.encoder(rgba)
    single = Layout(b, indices, len(views))
    condition = model.condition_latents(rgba, single, views, condition_guides, condition_known)
    if guided:  # second half of the batch: no embedding, no latent
        double = (
            condition.with_dropped(),
            torch.cat([context, torch.zeros_like(context)]),
            Layout(2 * b, indices, len(views)),
        )
    bar = iter(progress(range(settings.steps), settings.steps, "sampling"))

    def denoise(x, t, i):
        """Predict x_0 from x (n, c, h, w) at timestep t; i is the step's number."""
        next(bar, None)
        both = guided and options.guided_from <= t / (config.timesteps - 1) <= options.guided_to
        condition_in, context_in, layout = double if both else (condition, context, single)
        times = torch.full((layout.objects,), t, device=device)
        with precision_context(device, options.precision):
            clean = model.predict_clean(
                x.repeat(2, 1, 1, 1) if both else x, condition_in, times, context_in, layout, views
            )
        if both:
            with_condition, without = clean.chunk(2)
            clean = without + settings.guidance * (with_condition - without)
        if mirror:
            of_picture, of_mirror_image = clean.chunk(2)
            clean = with_mirror_images((of_picture + mirror_latents(of_mirror_image)) / 2)
        return clean

    noise, renewal = draw_noise(), Renewal(settings.eta, draw_noise) if settings.eta else None
    latents = sample(denoise, noise, config, settings.steps, options.scheduler, settings.spacing, renewal)
    for _ in bar:
        pass
    if mirror:
        latents, b = latents.chunk(2)[0], b // 2
    images = model.codec.decode(latents).unflatten(0, (b, len(indices), len(views)))
    if known is not None:
        images = keep_known(images, known)
    return {d: images[:, j] for j, d in enumerate(wanted)}


def join(first: tuple, second: tuple):
    """Concatenate two named tuples of tensors (b, …) along the first dimension."""
    return type(first)(*(torch.cat(pair) for pair in zip(first, second, strict=True)))


def _seeded_noise(model: Model, seed: int) -> Callable[[], torch.Tensor]:
    """Return a function that draws the noise of one object's images in all of noise_domains(), on the CPU."""
    generator = torch.Generator().manual_seed(seed)
    order = tuple(DOMAINS.index(d) for d in noise_domains(model.config))
    shape = model.latent_shape(Layout(1, order, len(model.config.views)))
    return lambda: torch.randn(shape, generator=generator)


def _object_noise(
    model: Model, domains: tuple[str, ...], draw: Callable[[], torch.Tensor]
) -> Callable[[], torch.Tensor]:
    """Return a function that draws the noise of one object's images in some domains: what `draw` gives for them."""
    order, views = noise_domains(model.config), len(model.config.views)
    chosen = [order.index(d) for d in domains]
    return lambda: draw().unflatten(0, (len(order), views))[chosen].flatten(0, 1)


def averages_mirror_image(config: ModelConfig, options: SamplingOptions) -> bool:
    """Decide whether to average with the mirrored picture. Raises InputError where it is required and impossible."""
    possible = (
        config.codec == "patch"
        and config.convention == "gdtool"
        and all(MIRRORED_VIEW.get(name, name) in config.views for name in config.views)
    )
    mirror = config.sampling_mirrored and possible if options.mirror is None else options.mirror
    if mirror and not possible:
        raise InputError(
            "mirror",
            "only a model of the patch codec, in gdtool's convention, with views on both sides is sampled "
            "with the mirrored picture",
            "pass mirror=None",
        )
    return mirror
