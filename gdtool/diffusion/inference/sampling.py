"""From a framed condition image to the images of all views and domains."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext

import torch

from gdtool.core.errors import InputError
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.encoding import BACKGROUND, MIRRORED_VIEW, encode_condition, mirrored
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.network.schedule import sample


def precision_context(device: torch.device | str, precision: str):
    """Autocast of the networks; lighting arithmetic stays out of it."""
    kind = torch.device(device).type
    return torch.autocast(kind, torch.bfloat16) if precision == "bfloat16" else nullcontext()


@torch.no_grad()
def sample_images(
    model: Model,
    rgba: torch.Tensor,
    *,
    domains: tuple[str, ...] = DOMAINS,
    steps: int = 8,
    guidance: float = 1.0,
    guided_from: float = 0.0,
    guided_to: float = 1.0,
    seed: int = 0,
    scheduler: str = "ddim",
    precision: str = "float32",
    mirror: bool | None = None,
    progress: Callable = lambda iterable, total, label: iterable,
) -> dict[str, torch.Tensor]:
    """Sample every view of the domains for a batch of objects.

    rgba (b, 4, h, w): framed condition, premultiplied and encoded (data.condition_plane). Returns domain to encoded
    images (b, k, 3, h, w) over the first of the configuration's backgrounds. Noise depends on seed alone: neither on
    the batch nor on which domains are asked for. Where color is primary it is sampled even when it is not asked for.
    guided_from, guided_to: timesteps, as shares of all, between which guidance acts; elsewhere there is none and half
    the work (Kynkäänniemi et al. 2024). mirror: take at each step the mean of what the picture and its mirror image
    give; None: as the configuration says, where it can."""
    config, device = model.config, rgba.device
    can = (
        config.codec == "patch"
        and config.convention == "gdtool"
        and all(MIRRORED_VIEW.get(name, name) in config.views for name in config.views)
    )
    mirror = config.sampling_mirrored and can if mirror is None else mirror
    if mirror and not can:
        raise InputError(
            "mirror",
            "only a model of the patch codec, in gdtool's convention, with views on both sides is sampled with the mirrored picture",
            "pass mirror=None",
        )
    rgba = torch.cat([rgba, rgba.flip(-1)]) if mirror else rgba
    b = len(rgba)
    wanted = [d for d in config.domains if d in domains]
    if config.cross_domain != "none" and "color" not in wanted:
        wanted = ["color", *wanted]
    indices = tuple(DOMAINS.index(d) for d in wanted)
    views = torch.arange(len(config.views))
    every = Layout(1, tuple(range(len(DOMAINS))), len(views))
    noise = torch.randn(model.latent_shape(every), generator=torch.Generator().manual_seed(seed))
    noise = noise.unflatten(0, (len(DOMAINS), len(views)))[list(indices)].flatten(0, 1).repeat(b, 1, 1, 1).to(device)

    def turned(latents):
        """Latents of some of the objects as their mirror images'."""
        images = model.codec.decode(latents).unflatten(0, (-1, len(indices), len(views)))
        return model.codec.encode(mirrored(images, indices, config.views).flatten(0, 2))

    def of_mirror(one):
        return torch.cat([one, turned(one)])

    if mirror:
        noise = of_mirror(noise.chunk(2)[0])

    background = torch.full((b,), BACKGROUND[config.backgrounds[0]], device=device)
    rgba = encode_condition(rgba, background)
    guided = guidance != 1.0
    with precision_context(device, precision):
        context = model.encoder(rgba)
    single = Layout(b, indices, len(views))
    condition = model.condition_latents(rgba, single, views)
    if guided:  # second half of the batch: no embedding, no latent
        double = (
            torch.cat([condition, torch.zeros_like(condition)]),
            torch.cat([context, torch.zeros_like(context)]),
            Layout(2 * b, indices, len(views)),
        )
    bar = iter(progress(range(steps), steps, "sampling"))

    def denoise(x, t, i):
        next(bar, None)
        both = guided and guided_from <= t / (config.timesteps - 1) <= guided_to
        seen, told, layout = double if both else (condition, context, single)
        times = torch.full((layout.objects,), t, device=device)
        with precision_context(device, precision):
            clean = model.predict_clean(x.repeat(2, 1, 1, 1) if both else x, seen, times, told, layout, views)
        if both:
            with_condition, without = clean.chunk(2)
            clean = without + guidance * (with_condition - without)
        if mirror:
            one, other = clean.chunk(2)
            clean = of_mirror((one + turned(other)) / 2)
        return clean

    latents = sample(denoise, noise, config, steps, scheduler)
    for _ in bar:
        pass
    if mirror:
        latents, b = latents.chunk(2)[0], b // 2
    images = model.codec.decode(latents).unflatten(0, (b, len(indices), len(views)))
    return {d: images[:, j] for j, d in enumerate(wanted)}
