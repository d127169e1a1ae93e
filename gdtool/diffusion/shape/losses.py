"""Compute the losses of a predicted volume: its voxels, and its silhouettes from the front, the sides and between."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from gdtool.diffusion.shape.volume import turn

# Weights of the parts. Voxels count by their mean over the whole volume. At a tenth of this weight the silhouettes'
# gradients outweigh those of the voxels, and the network finds the fewest voxels that cover the silhouettes.
VOXEL_WEIGHT, FRONT_WEIGHT = 100.0, 0.5
ROW_STEP = 2  # every second slice is turned by 45 degrees, which takes most of the time
EMPTY_LOGIT = -12.0  # of voxels that are known to be empty


def shape_errors(
    logits: torch.Tensor, occupancy: torch.Tensor, space: torch.Tensor, first_row: int, image_size: int
) -> dict[str, torch.Tensor]:
    """Compare predicted volumes with the true ones; returns the parts of the loss by name, each weighted.

    logits, occupancy, space: (b, z, y, x), float32. Voxels outside of space are known to be empty and are left out.
    first_row: 0 or 1, where the slices begin that the diagonal views are compared in. A silhouette's logit is the
    greatest along the ray, as a threshold renders it; a product of the voxels' chances to be empty would be met by many
    small ones.
    """
    error = F.binary_cross_entropy_with_logits
    voxels = error(logits, occupancy, weight=space)
    logits, occupancy = torch.where(space > 0, logits, EMPTY_LOGIT), occupancy * space
    rows = slice(first_row, None, ROW_STEP)
    diagonal = []
    for name in ("front_right", "front_left"):
        covered = (turn(occupancy[:, :, rows], name, image_size).amax(2) > 0.5).to(logits.dtype)
        # turn() gives 0 outside of the volume, which is empty
        turned = turn(logits[:, :, rows] - EMPTY_LOGIT, name, image_size).amax(2) + EMPTY_LOGIT
        diagonal.append(error(turned, covered))
    return {
        "voxels": VOXEL_WEIGHT * voxels,
        "front": FRONT_WEIGHT * error(logits.amax(1), occupancy.amax(1)),
        "side": error(logits.amax(3), occupancy.amax(3)),
        "diagonal": torch.stack(diagonal).mean(),
    }
