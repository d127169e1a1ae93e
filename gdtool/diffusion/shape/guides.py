"""Make what the painting network is given of the shape: its renderings, and the picture projected onto it."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F

from gdtool.cameras.camera import DISTANCE, HALF_WIDTH
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.network.encoding import SLAB, mirrored_order
from gdtool.diffusion.shape.render import Rendered
from gdtool.diffusion.shape.volume import world_axes

GUIDE_CHANNELS = 9  # coverage, depth, normal (3), projected color (3), visibility
# World units that a point may lie behind the front view's surface and still count as seen from there: two pixels, more
# than the error of a depth that was stored in 8 bits.
SEEN_TOLERANCE = 4 * HALF_WIDTH / 128
# Least cosine between a surface and the direction to the front camera. A pixel of the picture is stretched over five
# pixels of a surface that is steeper.
MIN_SEEN_COSINE = 0.2


class Guides(NamedTuple):
    """Hold the shape's renderings for b objects in k views, and the picture's color on them.

    mask (b, k, h, h): coverage, 0 to 1. depth (b, k, h, h): world units. normal (b, k, 3, h, h): unit, world axes.
    color (b, k, 3, h, h): sRGB color of the picture at each surface point's place in the front view, 0 to 1. visible
    (b, k, h, h): 1 where the picture shows that point, 0 where something lies before it or the surface is too steep.
    """

    mask: torch.Tensor
    depth: torch.Tensor
    normal: torch.Tensor
    color: torch.Tensor
    visible: torch.Tensor


def project_picture(rgba: torch.Tensor, rendered: Rendered, views: tuple[str, ...]) -> Guides:
    """Project a picture along the front view's axis onto the surfaces of all views.

    rgba (b, 4, h, h): sRGB color times coverage, and coverage, in [0, 1]. rendered: of the shape. views: the names of
    the k views, one of them "front". Points that the picture does not show take the color of what lies before them.
    """
    mask, depth, normal = rendered
    size, front = rgba.shape[-1], views.index("front")
    columns = ((torch.arange(size, device=rgba.device) + 0.5) / size * 2 - 1).expand(size, size)
    rows = columns.T
    front_place = DISTANCE - depth[:, front]  # along z, toward the front camera
    front_covered = mask[:, front]
    looked_up = torch.cat([rgba, (front_place * front_covered)[:, None], front_covered[:, None]], 1)
    colors, seen = [], []
    for k, name in enumerate(views):
        right, backward = (torch.tensor(a, dtype=rgba.dtype, device=rgba.device) for a in world_axes(name))
        along = DISTANCE - depth[:, k]
        x = columns * HALF_WIDTH * right[0] + along * backward[0]
        z = columns * HALF_WIDTH * right[2] + along * backward[2]
        places = torch.stack([x / HALF_WIDTH, rows.expand_as(x)], -1)
        value = F.grid_sample(looked_up, places, mode="bilinear", padding_mode="zeros", align_corners=False)
        covered, front_covered_here = value[:, 3:4], value[:, 5].clamp_min(1e-3)
        colors.append((value[:, :3] / covered.clamp_min(1e-3)).clamp(0, 1))
        in_front = value[:, 4] / front_covered_here - z
        facing = normal[:, k, 2] > MIN_SEEN_COSINE
        seen.append((in_front < SEEN_TOLERANCE) & facing & (covered[:, 0] > 0.5))
    visible = torch.stack(seen, 1).to(rgba.dtype) * mask
    return Guides(mask, depth, normal, torch.stack(colors, 1), visible)


def mirror_guides(guides: Guides, views: tuple[str, ...]) -> Guides:
    """Mirror the guides of objects about x = 0; views: names along k."""
    order = mirrored_order(views)
    mask, depth, normal, color, visible = (x[:, order].flip(-1) for x in guides)
    return Guides(mask, depth, normal * normal.new_tensor([-1.0, 1.0, 1.0])[:, None, None], color, visible)


def guide_channels(guides: Guides) -> torch.Tensor:
    """Encode guides as GUIDE_CHANNELS channels in [-1, 1], (b, k, 9, h, h); values are multiplied by coverage."""
    mask = guides.mask[:, :, None]
    return torch.cat(
        [
            2 * mask - 1,
            _encoded_depth(guides)[:, :, None],
            guides.normal * mask,
            (2 * guides.color - 1) * mask,
            guides.visible[:, :, None],
        ],
        2,
    )


def base_images(guides: Guides, domains: tuple[int, ...]) -> torch.Tensor:
    """Make the images (b, d, k, 3, h, h) that the painting network's output is added to, encoded as encoding.encode().

    Color and albedo are the projected picture; normal and depth are those of the shape; roughness and metallic are 0.5.
    domains: d indices into DOMAINS. Over the grey background.
    """
    mask = guides.mask[:, :, None]
    depth, nothing = _encoded_depth(guides)[:, :, None], torch.zeros_like(mask)
    out = []
    for i in domains:
        domain = DOMAINS[i]
        if domain in ("color", "albedo"):
            image = (2 * guides.color - 1) * mask
        elif domain == "normal":
            image = guides.normal * mask
        else:
            value = depth if domain == "depth" else nothing
            image = torch.cat([value, value, 2 * mask - 1], 2)
        out.append(image)
    return torch.stack(out, 1)


def _encoded_depth(guides: Guides) -> torch.Tensor:
    """Encode depth (b, k, h, h) as in the depth domain's images, times coverage."""
    return ((DISTANCE - guides.depth) / SLAB).clamp(-1, 1) * guides.mask
