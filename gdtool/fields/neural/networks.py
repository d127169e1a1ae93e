"""Define the paper's two fields: a signed distance network and a material network over an encoded position."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

FREQUENCIES = 10  # of the positional encoding
ENCODED = 64  # 3 + 2 * 3 * 10 = 63, padded: K mod 32 != 0 leaks NaN across rows in oneDNN's bfloat16 (oneDNN#5717)
WIDTH = 128  # of a hidden layer


def encode(points: Tensor, frequencies: int = FREQUENCIES) -> Tensor:
    """points (..., 3) in [-1, 1] to (..., 64): the points, sin and cos of pi 2^k x for k < frequencies, a zero.

    The argument is reduced to (-pi, pi] before the sine: y - 2 round(y / 2) is exact in floating point, and without it
    float32 errs by 1e-4 at k = 9. Always in float32 or better: bfloat16 has no digits left at k = 9.
    """
    points = points if points.dtype == torch.float64 else points.float()
    scale = 2.0 ** torch.arange(frequencies, dtype=points.dtype, device=points.device)
    turns = points[..., None, :] * scale[:, None]
    angle = math.pi * (turns - 2 * torch.round(turns / 2).detach())
    parts = [points, torch.sin(angle).flatten(-2), torch.cos(angle).flatten(-2)]
    padding = ENCODED - 3 - 6 * frequencies
    if padding > 0:
        parts.append(torch.zeros(*points.shape[:-1], padding, dtype=points.dtype, device=points.device))
    return torch.cat(parts, -1)


class SdfNetwork(nn.Module):
    """f_m: 8 layers of 128, the encoding fed in again at layer 4; starts as the signed distance of a sphere.

    The start is Atzmon & Lipman 2020's geometric initialisation: only the raw coordinates have weight, so the sines
    add detail as training goes on.
    """

    def __init__(self, radius: float = 0.4, layers: int = 8, width: int = WIDTH, skip: int = 4):
        super().__init__()
        self.skip = skip
        self.register_buffer("window", torch.ones(ENCODED), persistent=False)
        sizes = [(ENCODED if k == 0 else width, width - ENCODED if k == skip - 1 else width) for k in range(layers)]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in sizes)
        self.last = nn.Linear(width, 1)
        with torch.no_grad():
            for k, layer in enumerate(self.hidden):
                nn.init.normal_(layer.weight, 0.0, math.sqrt(2 / layer.out_features))
                nn.init.zeros_(layer.bias)
                if k == 0:
                    layer.weight[:, 3:] = 0
                elif k == skip:
                    layer.weight[:, -(ENCODED - 3) :] = 0
            nn.init.normal_(self.last.weight, math.sqrt(math.pi / width), 1e-4)
            nn.init.zeros_(self.last.bias)
            # At this width the random layers miss the sphere's slope and radius by a quarter: set both exactly.
            points = torch.randn(4096, 3)
            points = points / points.norm(dim=-1, keepdim=True) * torch.linspace(0.02, 1.0, len(points))[:, None]
            raw = torch.stack([self(points), torch.ones(len(points))], 1)
            slope, offset = torch.linalg.lstsq(raw, points.norm(dim=-1, keepdim=True) - radius).solution[:, 0]
            self.last.weight *= slope
            self.last.bias += offset

    def forward(self, points: Tensor) -> Tensor:
        """Signed distance (...) of points (..., 3), negative inside."""
        x = encoded = encode(points) * self.window
        for k, layer in enumerate(self.hidden):
            if k == self.skip:
                x = torch.cat([x, encoded], -1) / math.sqrt(2)
            x = nn.functional.softplus(layer(x), beta=100)
        return self.last(x)[..., 0]

    def show_frequencies(self, count: float) -> None:
        """Let the first `count` frequencies of the encoding through, the next one in part, and no other."""
        share = (count - torch.arange(FREQUENCIES, device=self.window.device)).clamp(0, 1).repeat_interleave(3)
        self.window[3 : 3 + 6 * FREQUENCIES] = torch.cat([share, share])

    def turn_outward(self) -> bool:
        """Flip the sign of a field that is negative on the box of side 2 around the object; returns whether it did.

        Fitting corrects an inverted field only slowly, because every value has to pass through zero.
        """
        corners = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)
        corners = corners[corners.abs().amax(1) > 0].to(self.window.device)
        with torch.no_grad():
            turned = bool(self(corners).median() < 0)
            if turned:
                self.last.weight.neg_()
                self.last.bias.neg_()
        return turned

    def with_gradient(self, points: Tensor, create_graph: bool = True) -> tuple[Tensor, Tensor]:
        """Compute the signed distance (...) and its gradient (..., 3)."""
        with torch.enable_grad():
            points = points.detach().requires_grad_(True)
            value = self(points)
            (gradient,) = torch.autograd.grad(value.sum(), points, create_graph=create_graph)
        return value, gradient


class MaterialNetwork(nn.Module):
    """f_c: 4 layers of 128 and a sigmoid, to albedo (3), roughness, metallic, specular in [0, 1]."""

    def __init__(self, layers: int = 4, width: int = WIDTH):
        super().__init__()
        sizes = [(ENCODED if k == 0 else width, width) for k in range(layers)]
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in sizes)
        self.last = nn.Linear(width, 6)

    def forward(self, points: Tensor) -> Tensor:
        """Compute the six material channels (..., 6) in 0..1 at points (..., 3)."""
        x = encode(points)
        for layer in self.hidden:
            x = torch.relu(layer(x))
        return torch.sigmoid(self.last(x))
