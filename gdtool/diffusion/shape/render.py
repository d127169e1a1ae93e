"""Render a volume of occupancies to masks, depth and normals of the rig's views, which agree by construction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from gdtool.cameras.camera import DISTANCE, HALF_WIDTH
from gdtool.diffusion.shape.volume import CROP_SHARE, ray_positions, turn, volume_side, world_axes

SURFACE = 0.5  # occupancy at the surface
# Standard deviation, in voxels, of the Gaussian blur before the gradient is taken. At one voxel normals of a sphere are
# within 2 degrees, and an edge is no rounder than the voxels make it.
NORMAL_BLUR = 1.0
BLUR_RADIUS = 2  # voxels: the blur's taps reach two standard deviations to either side


class Rendered(NamedTuple):
    """Hold the views of b volumes: mask (b, k, h, h) in [0, 1], depth (b, k, h, h) in world units, normal (b, k, 3, h,
    h) unit. Depth and normal mean something where mask is above 0.
    """

    mask: torch.Tensor
    depth: torch.Tensor
    normal: torch.Tensor


def render_volume(occupancy: torch.Tensor, views: tuple[str, ...], image_size: int) -> Rendered:
    """Render volumes occupancy (b, z, y, x), probabilities in [0, 1], to the named views of the rig.

    A ray meets the surface where the occupancy first rises above SURFACE, by linear interpolation between samples. A
    ray that stays below it meets its greatest occupancy, which becomes the mask. Not differentiable in depth.
    """
    gradient = _gradient(occupancy)
    masks, depths, normals = [], [], []
    for name in views:
        mask, along = _first_crossing(turn(occupancy, name, image_size), ray_positions(name, image_size))
        masks.append(_to_image(mask, image_size))
        depths.append(_to_image(DISTANCE - along, image_size))
        normals.append(_to_image(_normals(gradient, along, name, image_size), image_size))
    return Rendered(torch.stack(masks, 1), torch.stack(depths, 1), torch.stack(normals, 1))


def _first_crossing(samples: torch.Tensor, along: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Find where the rays of samples (b, y, s, u), taken at the positions along (s,), enter the object.

    Returns the greatest occupancy (b, y, u), and the position (b, y, u) along the rays in world units toward the
    camera.
    """
    positions = torch.tensor(along, dtype=samples.dtype, device=samples.device)
    most, at_most = samples.max(2)
    inside = samples > SURFACE
    hit = inside.any(2)
    index = torch.where(hit, inside.to(torch.uint8).argmax(2), at_most)
    before = (index - 1).clamp_min(0)
    here, there = (samples.gather(2, i[:, :, None])[:, :, 0] for i in (index, before))
    share = ((here - SURFACE) / (here - there).clamp_min(1e-6)).clamp(0, 1)  # of a step, back from the sample inside
    return most, positions[index] + torch.where(hit & (index > 0), share, 0.0) * (positions[0] - positions[1])


def _gradient(occupancy: torch.Tensor) -> torch.Tensor:
    """Compute the gradient (b, 3, z, y, x) of the blurred occupancy, in world axes, pointing out of the object."""
    taps = np.exp(-0.5 * (np.arange(-BLUR_RADIUS, BLUR_RADIUS + 1) / NORMAL_BLUR) ** 2)
    blurred, side = occupancy, occupancy.shape[-1]
    for axis in (1, 2, 3):  # a sum of shifted copies: three times as fast as a convolution with one channel
        padding = [0, 0] * (3 - axis) + [BLUR_RADIUS, BLUR_RADIUS]
        padded = F.pad(blurred, padding)
        shifted = [float(tap) * padded.narrow(axis, i, side) for i, tap in enumerate(taps / taps.sum())]
        blurred = torch.stack(shifted).sum(0)
    z, y, x = torch.gradient(blurred, dim=(1, 2, 3))
    return torch.stack([-x, y, -z], 1)  # rows grow downward, the world's y upward


def _normals(gradient: torch.Tensor, along: torch.Tensor, name: str, image_size: int) -> torch.Tensor:
    """Look the gradient (b, 3, z, y, x) up at the surface points of a view; returns unit normals (b, 3, y, u).

    along (b, y, u): positions of the points along the rays, in world units toward the camera.
    """
    side, half = volume_side(image_size), CROP_SHARE * HALF_WIDTH
    right, backward = (torch.tensor(axis, dtype=along.dtype, device=along.device) for axis in world_axes(name))
    columns = (torch.arange(image_size, device=along.device) + 0.5) / image_size * 2 - 1
    rows = (torch.arange(side, device=along.device) + 0.5) / side * 2 - 1
    x = columns * HALF_WIDTH * right[0] + along * backward[0]
    z = columns * HALF_WIDTH * right[2] + along * backward[2]
    points = torch.stack([x / half, rows[:, None].expand_as(x), z / half], -1)  # (b, y, u, 3)
    found = F.grid_sample(gradient, points[:, None], mode="bilinear", padding_mode="border", align_corners=False)[
        :, :, 0
    ]
    # Where the blurred occupancy is flat, the surface is taken to face the camera.
    found = found + 1e-6 * backward[:, None, None]
    return F.normalize(found, dim=1)


def _to_image(rows: torch.Tensor, image_size: int) -> torch.Tensor:
    """Pad (…, y, u) with zeros above and below to the image's height."""
    margin = (image_size - volume_side(image_size)) // 2
    return F.pad(rows, (0, 0, margin, margin))
