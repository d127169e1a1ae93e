"""Predict the volume of the object that a picture shows."""

from __future__ import annotations

import numpy as np
import torch

from gdtool.diffusion.data.volumes import front_space, picture_channels
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.shape.volume import crop

# Occupancy that is given to the likeliest voxel behind a pixel of the picture's silhouette where no voxel is occupied:
# the front silhouette is known, so something lies there.
LEAST_BEHIND = 0.75
PRIOR_STEPS = 8  # denoising steps of a code: more do not change the spread of the shapes


@torch.no_grad()
def predict_volume(
    model: Model,
    rgba: torch.Tensor,
    space: np.ndarray | None = None,
    *,
    seed: int | None = None,
    device: torch.device | str = "cpu",
) -> torch.Tensor:
    """Predict the occupancy (1, r, r, r) of the object in a framed picture, in [0, 1], indexed (z, y, x).

    rgba (4, h, h): sRGB color times coverage, and coverage, in [0, 1]. space (r, r, r) bool: voxels that may be
    occupied, besides what the picture's silhouette says; None: all. seed: of the code, which chooses one of the
    possible shapes; None takes the network's best guess. The silhouette from the front is exactly the picture's.
    """
    network = model.shape
    assert network is not None
    assert model.config.shape is not None
    picture = crop(rgba).numpy()
    allowed = front_space(picture[3]) if space is None else front_space(picture[3]) & space
    channels = torch.from_numpy(picture_channels(picture))[None].to(device)
    room = torch.from_numpy(allowed)[None].float().to(device)
    features = network.summarise(channels, room)
    code, known = torch.zeros(1, model.config.shape.code, device=device), torch.zeros(1, device=device)
    if seed is not None:
        noise = torch.randn(code.shape, generator=torch.Generator().manual_seed(seed)).to(device)
        code, known = network.prior.sample(features[-1].mean((2, 3)), noise, PRIOR_STEPS), known + 1
    logits = network.expand(features, code, known)
    occupancy = torch.sigmoid(logits) * room
    likeliest = torch.where(room > 0, logits, -torch.inf).argmax(1, keepdim=True)
    behind = occupancy.gather(1, likeliest).clamp_min(LEAST_BEHIND) * room.amax(1, keepdim=True)
    return occupancy.scatter(1, likeliest, torch.maximum(behind, occupancy.gather(1, likeliest)))
