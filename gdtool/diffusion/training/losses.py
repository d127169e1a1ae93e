"""Compute the training losses: the clean image's error, and the error of its closed-form rendering."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from gdtool.cameras.camera import rig
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig, TrainConfig
from gdtool.diffusion.network.encoding import PLANES, SCALARS, decode

SMOOTHED_BELOW = 0.02  # a distance is smoothed below this, so that its gradient is continuous at 0
SHADED_DOMAINS = ("normal", "albedo", "roughness", "metallic")  # domains that closed-form shading reads


def linear(srgb: torch.Tensor) -> torch.Tensor:
    """Decode sRGB values in [0, 1] to linear ones, differentiably (IEC 61966-2-1)."""
    high = ((srgb.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(srgb <= 0.04045, srgb / 12.92, high)


def image_error(
    predicted: torch.Tensor,
    clean: torch.Tensor,
    objects: int,
    domains: tuple[int, ...],
    config: ModelConfig,
    train: TrainConfig,
    trust: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute the weighted and the squared error of latents (b d k, c, h, w), as means (b, d) by object and domain.

    train.domain_weights multiply the values of each domain; the coverage in a scalar domain's third channel has weight
    1. In the domains of train.absolute_domains the error of a value is its distance from the truth, smoothed below
    SMOOTHED_BELOW (Charbonnier's loss); the distance of a normal is taken over its three axes. In the others the error
    is the square of the distance. A VAE's latents have no channel of coverage and are weighted as a whole. trust (b, d,
    k, h, w): weights of the pixels, patch codec only; None: 1. The second result is the squared error with the weights
    of the pixels alone.
    """
    square = (predicted - clean).float().square()
    if config.codec != "patch":
        square = square.mean((1, 2, 3)).unflatten(0, (objects, len(domains), -1)).mean(2)
        return square * square.new_tensor([train.domain_weights[i] for i in domains]), square
    square = square.unflatten(1, (3, -1)).unflatten(0, (objects, len(domains), -1))  # (b, d, k, 3, patch², h, w)
    weighted = []
    if trust is not None:
        pixels = F.pixel_unshuffle(trust[:, :, :, None], config.patch)[:, :, :, None]  # (b, d, k, 1, patch², h, w)
        square = square * pixels
    for j, i in enumerate(domains):
        value, coverage = square[:, j].split((2, 1) if DOMAINS[i] in SCALARS else (3, 0), dim=2)
        if DOMAINS[i] in train.absolute_domains:
            # of values with a trust of 0 or 1, or nearly so, the distance is trusted as its square is
            value = ((value.mean(2, keepdim=True) + SMOOTHED_BELOW**2).sqrt() - SMOOTHED_BELOW).expand_as(value)
        weighted.append(torch.cat([train.domain_weights[i] * value, coverage], 2).flatten(1).mean(1))
    return torch.stack(weighted, 1), square.flatten(2).mean(2)


def view_directions(config: ModelConfig) -> torch.Tensor:
    """Return unit vectors (k, 3) from the object toward the camera of each view of the configuration."""
    by_name = {camera.name: camera.backward for camera in rig("six", config.image_size)}
    return torch.tensor(np.stack([by_name[name] for name in config.views]), dtype=torch.float32)


@dataclass(frozen=True)
class LitObject:
    """Hold one object's silhouette, lights and cameras for the rendering loss.

    planes (k, 13, h, w): channels of encoding.PLANES, of which coverage is read. lights (16, 7): axis, sharpness and
    amplitude of spherical Gaussians. views (k, 3): unit vectors toward the cameras. background: encoded value in [-1,
    1] that the images are composited over.
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
    """Compute the mean squared difference of predicted and true maps shaded in closed form under one light.

    predicted, truth (d, k, 3, h, w): encoded images of one object. order: from index into DOMAINS to position along d.
    pixels: number of random foreground pixels that are shaded. Radiance c is compared as c / (1 + c), so that a few
    highlights do not dominate. Computed in float32. Returns 0 for an object without foreground pixels.
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
        """Shade the chosen pixels of images (d, k, 3, h, w); returns c / (1 + c) of their radiance c, (pixels, 3)."""
        picked = images[:, k, :, row, column].transpose(0, 1)  # (d, pixels, 3)
        values = decode(
            {d: picked[order[DOMAINS.index(d)]][..., None, None] for d in SHADED_DOMAINS},
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
