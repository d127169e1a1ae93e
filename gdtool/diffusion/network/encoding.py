"""Encode the images of each domain as the network's three channels in [-1, 1], and decode them.

Every domain carries the silhouette, so that a mask can be decoded from whatever subset is sampled:
  color, albedo        sRGB, 2c - 1, over an encoded background (white 1, grey 0, black -1)
  normal               world axes, times coverage: its length is the coverage
  depth                (2 - depth) / SLAB in world units, so nearer is larger; (value, value, coverage)
  roughness, metallic  2v - 1; (value, value, coverage)
In the third channel of the scalar domains coverage m is 2m - 1. Values are multiplied by m, so the background is 0.
"""

from __future__ import annotations

import numpy as np
import torch

from gdtool.cameras.camera import DISTANCE
from gdtool.core.kinds import DOMAINS

SLAB = 0.75  # half the depth range that is encoded: a unit box turned about its vertical axis reaches 0.707
BACKGROUND = {"white": 1.0, "grey": 0.0, "black": -1.0}
SCALARS = ("depth", "roughness", "metallic")
# The thirteen planes a view is stored in: premultiplied values of each domain, then coverage.
PLANES = {
    "color": slice(0, 3),
    "normal": slice(3, 6),
    "depth": slice(6, 7),
    "albedo": slice(7, 10),
    "roughness": slice(10, 11),
    "metallic": slice(11, 12),
    "mask": slice(12, 13),
}
PLANE_COUNT = 13
MIRRORED_VIEW = {"front_right": "front_left", "front_left": "front_right", "right": "left", "left": "right"}


def planes_from_images(images: dict[str, np.ndarray], mask: np.ndarray) -> np.ndarray:
    """Convert a views folder's images to premultiplied planes (k, 13, h, w) in [-1, 1], the channels of PLANES.

    Takes images (k, h, w[, 3]) by domain and mask (k, h, w), coverage. color and albedo are linear, normal is unit,
    depth is in world units. Values are multiplied by coverage m, which itself is stored as 2m - 1.
    """
    from gdtool.images.color import srgb_from_linear

    k, h, w = mask.shape
    out = np.zeros((k, PLANE_COUNT, h, w), np.float32)
    for domain, image in images.items():
        if domain not in PLANES:
            continue
        if domain in ("color", "albedo"):
            value = 2 * srgb_from_linear(np.clip(image, 0, 1)) - 1
        elif domain == "depth":
            value = np.clip((DISTANCE - image) / SLAB, -1, 1)
        elif domain == "normal":
            value = image
        else:
            value = 2 * np.clip(image, 0, 1) - 1
        value = value[..., None] if value.ndim == 3 else value
        out[:, PLANES[domain]] = np.moveaxis(value * mask[..., None], -1, 1)
    out[:, PLANES["mask"]] = 2 * mask[:, None] - 1
    return out


def encode(planes: torch.Tensor, domains: tuple[int, ...], background: torch.Tensor) -> torch.Tensor:
    """Encode planes (b, k, 13, h, w) over backgrounds to images (b, d, k, 3, h, w) in [-1, 1].

    planes: as planes_from_images() makes them. domains: d indices into DOMAINS. background (b,): encoded, a value of
    BACKGROUND for each object.
    """
    mask = planes[:, :, PLANES["mask"]]
    behind = (0.5 - 0.5 * mask) * background[:, None, None, None, None]
    out = []
    for i in domains:
        domain = DOMAINS[i]
        value = planes[:, :, PLANES[domain]]
        if domain in ("color", "albedo"):
            value = value + behind
        elif domain in SCALARS:
            value = torch.cat([value, value, mask], 2)
        out.append(value)
    return torch.stack(out, 1)


def mirrored_order(views: tuple[str, ...]) -> list[int]:
    """Return, for each view, the index of the view whose mirror image shows the object mirrored about x = 0."""
    return [views.index(MIRRORED_VIEW.get(name, name)) for name in views]


def mirror_images(images: torch.Tensor, domains: tuple[int, ...], views: tuple[str, ...]) -> torch.Tensor:
    """Mirror encoded images (b, d, k, 3, h, w) of objects about x = 0. Applied twice, it gives the input.

    domains: indices into DOMAINS along d. views: names along k.
    """
    images = images[:, :, mirrored_order(views)].flip(-1)
    for j, i in enumerate(domains):
        if DOMAINS[i] == "normal":
            images[:, j, :, 0] *= -1
    return images


def encode_condition(rgba: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    """Composite the premultiplied color of rgba (b, 4, h, w) in [-1, 1] over backgrounds (b,).

    Coverage stays as it is.
    """
    behind = (0.5 - 0.5 * rgba[:, 3:]) * background[:, None, None, None]
    return torch.cat([rgba[:, :3] + behind, rgba[:, 3:]], 1)


def coverage(images: dict[str, torch.Tensor], background: float) -> torch.Tensor:
    """Compute the coverage (…, h, w) in [0, 1] from encoded images (…, 3, h, w) by domain, as the mean over domains.

    It is the third channel of scalar domains and the length of normals. Without any of these it is the difference of
    color (or albedo) from the background, which fails for a subject of the background's color. background: encoded
    value in [-1, 1].
    """
    votes = [0.5 + 0.5 * images[d][..., 2, :, :] for d in SCALARS if d in images]
    if "normal" in images:
        votes.append(images["normal"].norm(dim=-3))
    if not votes:
        image = images["color"] if "color" in images else images["albedo"]
        votes = [(image - background).abs().amax(-3) * 2]
    return torch.stack(votes).mean(0).clamp(0, 1)


def decode(images: dict[str, torch.Tensor], mask: torch.Tensor, background: float) -> dict[str, torch.Tensor]:
    """Decode encoded images (…, 3, h, w) by domain to values, divided by the mask's coverage (…, h, w) in [0, 1].

    background: encoded value in [-1, 1] that color and albedo are composited over. Returns color and albedo (…, 3, h,
    w) sRGB in [0, 1], normal (…, 3, h, w) unit, depth (…, h, w) in world units, roughness and metallic (…, h, w) in [0,
    1]. Differentiable in images.
    """
    m = mask.clamp_min(0.1)
    out = {}
    for domain, x in images.items():
        if domain in ("color", "albedo"):
            value = (x - background * (1 - m.unsqueeze(-3))) / m.unsqueeze(-3)
            out[domain] = (0.5 + 0.5 * value).clamp(0, 1)
        elif domain == "normal":
            square = (x * x).sum(-3, keepdim=True)
            out[domain] = x * torch.rsqrt(square.clamp_min(1e-6))
        else:
            value = (0.5 * (x[..., 0, :, :] + x[..., 1, :, :]) / m).clamp(-1, 1)
            out[domain] = DISTANCE - SLAB * value if domain == "depth" else 0.5 + 0.5 * value
    return out
