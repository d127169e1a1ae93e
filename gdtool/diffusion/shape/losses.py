"""Compute the losses of a predicted volume: its voxels, and its silhouettes from the front, the sides and between."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from gdtool.diffusion.shape.volume import turn

# Weights of the parts. Voxels count by their mean over the whole volume, of which the object fills a few percent; ten
# times that is of the order of the silhouettes' parts.
VOXEL_WEIGHT, FRONT_WEIGHT = 10.0, 0.5
ROW_STEP = 2  # every second slice is turned by 45 degrees, which takes most of the time
MIN_EMPTY_LOG = -1e-4  # greatest logarithm of an empty ray's probability, so that log(1 - p) stays finite


def silhouette_error(empty_log: torch.Tensor, covered: torch.Tensor) -> torch.Tensor:
    """Compute the cross entropy of silhouettes, a mean over the pixels.

    empty_log (…): logarithm of the probability that a pixel's ray meets nothing. covered (…): 0 or 1.
    """
    empty_log = empty_log.clamp(max=MIN_EMPTY_LOG)
    hit_log = torch.log1p(-torch.exp(empty_log))
    return -(covered * hit_log + (1 - covered) * empty_log).mean()


def shape_errors(
    logits: torch.Tensor, occupancy: torch.Tensor, space: torch.Tensor, first_row: int, image_size: int
) -> dict[str, torch.Tensor]:
    """Compare predicted volumes with the true ones; returns the parts of the loss by name, each weighted.

    logits, occupancy, space: (b, z, y, x), float32. Voxels outside of space are known to be empty and are left out.
    first_row: 0 or 1, where the slices begin that the diagonal views are compared in.
    """
    voxels = F.binary_cross_entropy_with_logits(logits, occupancy, weight=space)
    empty_log = -F.softplus(logits) * space
    occupancy = occupancy * space
    front = silhouette_error(empty_log.sum(1), occupancy.amax(1))
    side = silhouette_error(empty_log.sum(3), occupancy.amax(3))
    rows = slice(first_row, None, ROW_STEP)
    diagonal = []
    for name in ("front_right", "front_left"):
        covered = (turn(occupancy[:, :, rows], name, image_size).amax(2) > 0.5).to(logits.dtype)
        diagonal.append(silhouette_error(turn(empty_log[:, :, rows], name, image_size).sum(2), covered))
    return {
        "voxels": VOXEL_WEIGHT * voxels,
        "front": FRONT_WEIGHT * front,
        "side": side,
        "diagonal": sum(diagonal) / len(diagonal),
    }
