"""Compute the training losses: the clean image's error, and the error of its closed-form rendering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gdtool.cameras.camera import rig
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig, TrainConfig
from gdtool.diffusion.network.encoding import PLANES, SCALARS, decode

SOFTNESS = 0.02  # of the absolute error: its gradient is continuous at 0
LIT = ("normal", "albedo", "roughness", "metallic")  # what the closed form is made of


def linear(srgb: torch.Tensor) -> torch.Tensor:
    """Decode sRGB, differentiably (IEC 61966-2-1)."""
    high = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, high)


def image_error(
    predicted: torch.Tensor,
    clean: torch.Tensor,
    objects: int,
    domains: tuple[int, ...],
    config: ModelConfig,
    train: TrainConfig,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the mean error of latents (b d k, c, h, w) per object and domain: as weighted for training, and squared,
    (b, d).

    train.domain_weights apply to each domain's values; the coverage in a scalar domain's third channel weighs 1. In
    train.absolute_domains the values count by their distance, a normal's in all three axes, smoothed below SOFTNESS
    (Charbonnier's loss), the rest by its square. The VAE's latents have no coverage channel and are weighted as a
    whole.
    """
    square = (predicted - clean).float().square()
    if config.codec != "patch":
        square = square.mean((1, 2, 3)).unflatten(0, (objects, len(domains), -1)).mean(2)
        return square * square.new_tensor([train.domain_weights[i] for i in domains]), square
    square = square.unflatten(1, (3, -1)).unflatten(0, (objects, len(domains), -1))  # (b, d, k, 3, patch², h, w)
    counted = []
    for j, i in enumerate(domains):
        value, coverage = square[:, j].split((2, 1) if DOMAINS[i] in SCALARS else (3, 0), dim=2)
        if DOMAINS[i] in train.absolute_domains:
            value = ((value.mean(2, keepdim=True) + SOFTNESS**2).sqrt() - SOFTNESS).expand_as(value)
        counted.append(torch.cat([train.domain_weights[i] * value, coverage], 2).flatten(1).mean(1))
    return torch.stack(counted, 1), square.flatten(2).mean(2)


def view_directions(config: ModelConfig) -> torch.Tensor:
    """Return unit vectors (k, 3) from the object toward each camera of the rig."""
    by_name = {camera.name: camera.backward for camera in rig("six", config.image_size)}
    return torch.tensor(np.stack([by_name[name] for name in config.views]), dtype=torch.float32)


@dataclass(frozen=True)
class LitObject:
    """Hold the scene of one object's rendering loss.

    planes (k, 13, h, w); lights (16, 7): axis, sharpness, amplitude; views (k, 3): toward the cameras; background:
    encoded.
    """

    planes: torch.Tensor
    lights: torch.Tensor
    views: torch.Tensor
    background: float


def rendering_error(
    predicted: torch.Tensor,
    truth: torch.Tensor,
    order: dict[int, int],
    scene: LitObject,
    pixels: int,
    generator: torch.Generator,
) -> torch.Tensor:
    """Compute the mean squared difference of the closed-form renderings of predicted and true maps under one light.

    predicted, truth (d, k, 3, h, w): encoded images of one object. order: index into DOMAINS to position along d.
    pixels: number of random foreground pixels. Radiance c is compared as c / (1 + c), or a few highlights would
    dominate. float32 throughout. 0 for an object that is not seen.
    """
    from gdtool.shading.bsdf.closed_form import shade
    from gdtool.shading.bsdf.sg import SphericalGaussians

    lights = scene.lights
    mask = 0.5 + 0.5 * scene.planes[:, PLANES["mask"].start]
    inside = torch.nonzero(mask > 0.9)
    if len(inside) == 0:
        return predicted.sum() * 0
    chosen = inside[torch.randint(len(inside), (pixels,), generator=generator)]
    k, row, column = chosen.unbind(1)
    light = SphericalGaussians(lights[:, :3], lights[:, 3], lights[:, 4:])

    def render(images: torch.Tensor) -> torch.Tensor:
        """Shade the chosen pixels of images (d, k, 3, h, w)."""
        picked = images[:, k, :, row, column].transpose(0, 1)  # (d, pixels, 3)
        values = decode(
            {d: picked[order[DOMAINS.index(d)]][..., None, None] for d in LIT},
            mask[k, row, column][:, None, None],
            scene.background,
        )
        flat = {d: x.flatten(1) for d, x in values.items()}
        radiance = shade(
            flat["normal"],
            scene.views[k],
            linear(flat["albedo"]),
            flat["roughness"][:, 0],
            flat["metallic"][:, 0],
            light,
        )
        return radiance / (1 + radiance)

    with torch.no_grad():
        target = render(truth.float())
    return ((render(predicted.float()) - target) ** 2).mean()
