"""Find surface points from samples along a ray: NeuS weights, first crossings, roots and implicit gradients.

Each docstring says why its formula is evaluated in that form.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus


def log_transmission(f0: Tensor, f1: Tensor, sharpness: Tensor | float) -> Tensor:
    """log(1 - alpha) <= 0 of NeuS (Wang et al. 2021, eq. 13) between signed distances f0 and f1 along a ray.

    1 - alpha = sigmoid(s f1) / sigmoid(s f0), at most 1. Written with softplus it has no quotient that underflows; deep
    inside, where both terms are large and alike, their difference is taken analytically.
    """
    a, b = f0 * sharpness, f1 * sharpness
    outside = softplus(-a) - softplus(-b)
    inside = (f1 - f0) * sharpness + softplus(a) - softplus(b)
    return torch.where((a < 0) & (b < 0), inside, outside).clamp_max(0.0)


def neus_alpha(f0: Tensor, f1: Tensor, sharpness: Tensor | float) -> Tensor:
    """Opacity in [0, 1] of the interval between signed distances f0 and f1."""
    return -torch.expm1(log_transmission(f0, f1, sharpness))


def neus_weights(values: Tensor, sharpness: Tensor | float) -> Tensor:
    """Weights (r, n - 1) of the intervals of rays with signed distances (r, n); their sum is at most 1.

    What lies before an interval is summed without it: taken off a sum that holds it, a wall (log transmission -1e5)
    would leave rounding of its own size (weights summing to 1.0009 at sharpness 65,538).
    """
    through = log_transmission(values[:, :-1], values[:, 1:], sharpness)
    before = torch.cat([torch.zeros_like(through[:, :1]), torch.cumsum(through[:, :-1], 1)], 1)
    return torch.exp(before) * -torch.expm1(through)


def first_crossing(values: Tensor) -> tuple[Tensor, Tensor]:
    """First outside-to-inside step of signed distances (r, n) along rays.

    Returns found (r,) bool and idx (r,): values[idx] >= 0 > values[idx + 1]; idx is 0 where nothing is found. An exact
    zero counts as outside, exits and NaN never count.
    """
    enters = (values[:, :-1] >= 0) & (values[:, 1:] < 0)
    return enters.any(1), enters.to(torch.int8).argmax(1)


def secant_root(t0: Tensor, t1: Tensor, f0: Tensor, f1: Tensor) -> Tensor:
    """Find where the chord from (t0, f0 >= 0) to (t1, f1 < 0) is zero."""
    gap = (f0 - f1).clamp_min(torch.finfo(f0.dtype).tiny)
    return t0 + (t1 - t0) * (f0 / gap).clamp(0.0, 1.0)


def median_of_cdf(t: Tensor, values: Tensor, sharpness: Tensor | float) -> Tensor:
    """Find the paper's surface point (r,) on each ray: where the sum of its NeuS weights passes half its total.

    t (r, d): the samples' distances along the rays; values (r, d): signed distances there.
    """
    weights = neus_weights(values, sharpness)
    total = weights.sum(1, keepdim=True).clamp_min(torch.finfo(t.dtype).tiny)
    cdf = torch.cumsum(weights / total, 1)
    idx = (cdf >= 0.5).to(torch.int8).argmax(1, keepdim=True)
    above = cdf.gather(1, idx)
    share = (weights / total).gather(1, idx)
    within = ((0.5 - (above - share)) / share.clamp_min(1e-12)).clamp(0.0, 1.0)
    return (t.gather(1, idx) + within * (t.gather(1, idx + 1) - t.gather(1, idx)))[:, 0]


def implicit_points(points: Tensor, directions: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
    """Surface points (n, 3) that move along their rays as the field changes (IDR, Yariv et al. 2020, eq. 3).

    points: where the rays (directions) meet the surface now, taken as constant; value: the field there, with its
    graph; gradient (n, 3): its spatial gradient, taken as constant. Grazing rays are held back: their points run away.
    """
    slope = (gradient.detach() * directions).sum(-1)
    slope = torch.where(slope > -0.1, torch.full_like(slope, -0.1), slope)
    return points.detach() - directions * ((value - value.detach()) / slope)[..., None]


def unit(vectors: Tensor) -> Tensor:
    """vectors / length with a finite gradient at zero."""
    return vectors * torch.rsqrt((vectors * vectors).sum(-1, keepdim=True).clamp_min(1e-20))
