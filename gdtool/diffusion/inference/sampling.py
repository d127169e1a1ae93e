"""Sample the images of all views and domains from a framed condition image."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass

import torch

from gdtool.core.errors import InputError
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.inference.shape import make_guides
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.encoding import BACKGROUND, MIRRORED_VIEW, encode_condition, mirror_images
from gdtool.diffusion.network.known import KnownImages, keep_known, mirror_known
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.schedule import sample
from gdtool.diffusion.shape.guides import Guides, mirror_guides


def precision_context(device: torch.device | str, precision: str):
    """Return the autocast context for the networks. Lighting is computed outside of it, in float32."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16) if precision == "bfloat16" else nullcontext()


@dataclass(frozen=True)
class SamplingOptions:
    """Set how views are sampled from a model.

    domains: those to return. In a model with attention across domains, color is sampled even where it is not returned.
    steps: number of denoising steps. guidance: factor of classifier-free guidance; 1 is none. guided_from, guided_to:
    it acts between these timesteps only, as shares of all, 0 to 1; other steps take half the time (Kynkäänniemi et al.
    2024). mirror: average, at each step, the predictions for the picture and for its mirror image; None follows the
    configuration, where the model can do it.
    """

    domains: tuple[str, ...] = DOMAINS
    steps: int = 8
    guidance: float = 1.0
    guided_from: float = 0.0
    guided_to: float = 1.0
    seed: int = 0
    scheduler: str = "ddim"
    precision: str = "float32"
    mirror: bool | None = None


@torch.no_grad()
def sample_images(
    model: Model,
    rgba: torch.Tensor,
    options: SamplingOptions = SamplingOptions(),
    *,
    guides: Guides | None = None,
    known: KnownImages | None = None,
    progress: Callable = lambda iterable, total, label: iterable,
) -> dict[str, torch.Tensor]:
    """Sample every view of the domains for a batch of objects.

    rgba (b, 4, h, w): framed condition in [-1, 1], as objects.condition_plane() encodes it. Returns encoded images (b,
    k, 3, h, w) by domain, over the first of the configuration's backgrounds. The noise depends on the seed alone, so an
    object's views do not depend on the rest of the batch. guides: of a model with a shape network, as
    shape.make_guides() makes them, which it does here where they are None. known: images that are given, for a model
    with the domains as channels; they are returned as they are.
    """
    config, device = model.config, rgba.device
    if config.shape and guides is None:
        guides = make_guides(model, rgba, known, mirror=averages_mirror_image(config, options))
    mirror = averages_mirror_image(config, options)
    wanted = [d for d in config.domains if d in options.domains]
    if config.cross_domain != "none" and "color" not in wanted:
        wanted = ["color", *wanted]
    if config.domain_layout == "channels":
        wanted = list(config.domains)
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
    every = Layout(1, tuple(range(len(DOMAINS))), len(views))
    noise = torch.randn(model.latent_shape(every), generator=torch.Generator().manual_seed(options.seed))
    noise = noise.unflatten(0, (len(DOMAINS), len(views)))[list(indices)].flatten(0, 1).repeat(b, 1, 1, 1).to(device)

    def mirror_latents(latents):
        """Mirror latents (n, c, h, w) of whole objects about x = 0: decode, mirror, encode."""
        images = model.codec.decode(latents).unflatten(0, (-1, len(indices), len(views)))
        return model.codec.encode(mirror_images(images, indices, config.views).flatten(0, 2))

    def with_mirror_images(latents):
        """Append the latents of the mirrored images to latents (n, c, h, w), which gives (2 n, c, h, w)."""
        return torch.cat([latents, mirror_latents(latents)])

    if mirror:
        noise = with_mirror_images(noise.chunk(2)[0])

    background = torch.full((b,), BACKGROUND[config.backgrounds[0]], device=device)
    rgba = encode_condition(rgba, background)
    guided = options.guidance != 1.0
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
    bar = iter(progress(range(options.steps), options.steps, "sampling"))

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
            clean = without + options.guidance * (with_condition - without)
        if mirror:
            of_picture, of_mirror_image = clean.chunk(2)
            clean = with_mirror_images((of_picture + mirror_latents(of_mirror_image)) / 2)
        return clean

    latents = sample(denoise, noise, config, options.steps, options.scheduler)
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
