"""Code a shape in a few numbers, and sample codes that fit a picture by a small diffusion model.

A picture leaves open what lies behind it. A code tells the network which of the possible shapes is meant: a linear
projection of the coarse occupancy, trained together with the network, and blurred by noise so that similar shapes have
similar codes. The prior is a diffusion model of codes given the picture's features (Rombach et al. 2022 train theirs on
images' codes in the same way).
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn

from gdtool.diffusion.network.unet import sinusoid

COARSE = 12  # voxels along each side of the coarse occupancy that is coded
CODE_NOISE = 0.3  # standard deviation added to codes, which lie in [-1, 1], in training
TIME_WIDTH = 32  # channels of the time's embedding
LEVELS = 1000  # timesteps that the embedding is told, over the whole range of noise


class ShapeCode(nn.Module):
    """Project a volume's coarse occupancy to a code in [-1, 1]."""

    def __init__(self, width: int, side: int):
        super().__init__()
        self.cells = side // math.ceil(side / COARSE)
        self.project = nn.Linear(self.cells**3, width)

    def forward(self, occupancy: torch.Tensor) -> torch.Tensor:
        """Map occupancy (b, r, r, r) to codes (b, width)."""
        coarse = F.adaptive_avg_pool3d(occupancy[:, None], self.cells)
        return torch.tanh(self.project(coarse.flatten(1)))


class LatentPrior(nn.Module):
    """Predict a code from its noisy version and a picture's features.

    The noisy code is cos(a) code + sin(a) e with standard normal e and a from 0 to pi / 2.
    """

    def __init__(self, code: int, features: int, width: int):
        super().__init__()
        self.code_width = code
        self.layers = nn.ModuleList(
            [
                nn.Linear(code + features + TIME_WIDTH, width),
                nn.Linear(width, width),
                nn.Linear(width, code),
            ]
        )

    def forward(self, noisy: torch.Tensor, angle: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
        """Predict the code (b, c) from noisy (b, c), angle (b,) in radians and features (b, f)."""
        time = sinusoid(angle * (LEVELS / (math.pi / 2)), TIME_WIDTH)
        x = torch.cat([noisy, features, time], 1)
        x = F.silu(self.layers[0](x))
        x = x + F.silu(self.layers[1](x))
        return self.layers[2](x)

    def loss(self, code: torch.Tensor, features: torch.Tensor, angle: torch.Tensor, noise: torch.Tensor):
        """Compute the squared error of the predicted code, a mean over the batch.

        code (b, c), features (b, f), angle (b,), noise (b, c); no gradient reaches code and features.
        """
        code, features = code.detach(), features.detach()
        noisy = angle.cos()[:, None] * code + angle.sin()[:, None] * noise
        return (self(noisy, angle, features) - code).square().mean()

    def sample(self, features: torch.Tensor, noise: torch.Tensor, steps: int) -> torch.Tensor:
        """Sample codes (b, c) for features (b, f) from standard normal noise (b, c), by DDIM (Song et al. 2021)."""
        x, code = noise, noise
        for i in range(steps):
            angle = math.pi / 2 * (1 - i / steps)
            following = math.pi / 2 * (1 - (i + 1) / steps)
            code = self(x, torch.full((len(x),), angle, device=x.device), features)
            error = (x - math.cos(angle) * code) / math.sin(angle)
            x = math.cos(following) * code + math.sin(following) * error
        return code
