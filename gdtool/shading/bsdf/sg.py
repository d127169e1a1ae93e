"""Evaluate, multiply and integrate spherical Gaussians G(v) = μ exp(λ(v·p − 1)), accurately in float32.

A lobe has a unit axis p, a sharpness λ >= 0 and an amplitude μ. All functions take torch tensors that broadcast, in
float32 or float64, and have finite gradients.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

# Beyond this a lobe is a point to float32; squares of it still fit.
MAX_SHARPNESS = 1e12
# Floor of what is divided by: its inverse, and products of that in gradients, stay finite in float32.
_TINY = 1e-24


@dataclass(frozen=True)
class SphericalGaussians:
    """Hold a sum of k lobes: axes (k, 3) unit, sharpness (k,) >= 0, amplitudes (k, 3) linear radiance."""

    axes: Tensor
    sharpness: Tensor
    amplitudes: Tensor

    def to(self, *args, **kwargs) -> SphericalGaussians:
        """Move or cast all tensors, with the arguments of Tensor.to."""
        return SphericalGaussians(
            self.axes.to(*args, **kwargs), self.sharpness.to(*args, **kwargs), self.amplitudes.to(*args, **kwargs)
        )

    @classmethod
    def from_record(cls, light: dict, dtype: torch.dtype = torch.float32) -> SphericalGaussians:
        """Read the lobes of a light.json record, as folders.records.read_light returns it."""
        return cls(*(torch.as_tensor(light[name], dtype=dtype) for name in ("axes", "sharpness", "amplitudes")))


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Take the dot product of vectors over the last axis."""
    return (a * b).sum(-1)


def normalize(v: Tensor) -> Tensor:
    """Divide vectors (..., 3) by their length. A vector shorter than 1e-12 stays short, with a finite gradient."""
    return v * torch.rsqrt(dot(v, v).clamp_min(_TINY))[..., None]


def lobe(axis: Tensor, sharpness: Tensor, v: Tensor) -> Tensor:
    """Evaluate a lobe of amplitude 1 in unit directions v (..., 3), as exp(−λ |v − p|² / 2).

    This form is exact near the axis, where λ(v·p − 1) would cancel.
    """
    chord = v - axis
    return torch.exp(-0.5 * sharpness * dot(chord, chord))


def evaluate(g: SphericalGaussians, v: Tensor) -> Tensor:
    """Evaluate the radiance (..., 3) of a sum of lobes in unit directions v (..., 3)."""
    return lobe(g.axes, g.sharpness, v[..., None, :]) @ g.amplitudes


def product(axis1: Tensor, sharpness1: Tensor, axis2: Tensor, sharpness2: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Multiply two lobes of amplitude 1: returns axis (..., 3), sharpness, and the logarithm of the amplitude (<= 0).

    λ² = S² − 2 λ₁λ₂ q with S = λ₁ + λ₂ and q = |p₁ − p₂|² / 2; beyond a right angle (λ₁ − λ₂)² + λ₁λ₂ |p₁ + p₂|²,
    which does not cancel there. Wang et al. 2009, rearranged.
    """
    sharpness1, sharpness2 = sharpness1.clamp_max(MAX_SHARPNESS), sharpness2.clamp_max(MAX_SHARPNESS)
    total = sharpness1 + sharpness2
    safe = total.clamp_min(_TINY)
    # Shares of the sum, so that no square of a sharpness over- or underflows.
    s1, s2 = sharpness1 / safe, sharpness2 / safe
    apart, along = axis1 - axis2, axis1 + axis2
    q = 0.5 * dot(apart, apart)
    near = 1 - 2 * s1 * s2 * q
    far = (s1 - s2) ** 2 + s1 * s2 * dot(along, along)
    squared = torch.where(q < 1, near, far).clamp_min(_TINY)
    ratio = torch.sqrt(squared)
    exponent = -2 * s1 * s2 * q / (1 + ratio) * total
    axis = normalize(s1[..., None] * axis1 + s2[..., None] * axis2)
    return axis, total * ratio, exponent


def integral(sharpness: Tensor) -> Tensor:
    """Integrate a lobe of amplitude 1 over the sphere: −2π expm1(−2λ)/λ, 4π at λ = 0."""
    small = sharpness < 1e-4
    s = torch.where(small, torch.ones_like(sharpness), sharpness)
    series = 4 * math.pi * (1 - sharpness + (2 / 3) * sharpness * sharpness)
    return torch.where(small, series, -2 * math.pi * torch.expm1(-2 * s) / s)


def hemisphere_integral(sharpness: Tensor, cosine: Tensor) -> Tensor:
    """Integrate a lobe of amplitude 1 over a hemisphere whose pole makes the given cosine with the axis.

    Blends the integrals of the hemispheres about the axis and away from it (Meder & Brüderlin 2018). The share comes
    from the error function (Tokuyoshi 2022, "Accurate Diffuse Lighting from Spherical Gaussian Lights"). Largest error:
    4.4e-3 of the sphere integral, at λ = 10; 1.1e-2 with Meder & Brüderlin's hyperbolic tangent.
    """
    s = sharpness.clamp(0, MAX_SHARPNESS)
    c = cosine.clamp(-1, 1)
    small = s < 1e-4
    y = torch.where(small, torch.ones_like(s), s)
    upper = 2 * math.pi * torch.where(small, 1 - 0.5 * s, -torch.expm1(-y) / y)
    steep = y * torch.sqrt((0.5 * y + 0.651732883) / ((y + 1.341828003) * y + 7.221668780))
    share = 0.5 * (1 + torch.where(small, c, torch.erf(steep * c) / torch.erf(steep)))
    return upper * (share + (1 - share) * torch.exp(-s))


_A, _B, _C, _D, _E = 2.73608316, 17.0212978, 4.01008267, 15.2191563, 76.0878963


def cosine_integral(sharpness: Tensor, cosine: Tensor) -> Tensor:
    """Integrate a lobe of amplitude 1 times max(0, v·n) over the sphere; cosine = p·n. Never negative.

    Tokuyoshi 2024, "A Fast and Accurate Spherical Gaussian × Clamped Cosine Integral". The error is at most 1.6e-3 of
    the peak, at λ = 5; 5e-6 at λ = 0.1, 5e-9 at 1e4.
    """
    s = sharpness.clamp(0, MAX_SHARPNESS)
    c = cosine.clamp(-1, 1)
    t = s * torch.sqrt(0.5 * ((s + _A) * s + _B) / (((s + _C) * s + _D) * s + _E))
    tiny = t < 1e-4
    t_safe = torch.where(tiny, torch.full_like(t, 1e-4), t)
    bell = torch.exp(-((t_safe * c) ** 2)) * torch.expm1(-(t_safe**2) * (1 - c) * (1 + c)) / t_safe
    g = 0.5 * (c * torch.special.erfc(-t_safe * c) + torch.special.erfc(t_safe)) - (0.5 / math.sqrt(math.pi)) * bell
    g = torch.where(tiny, 0.5 * (1 + c), g).clamp(0, 1)

    low = s < 0.5
    x = torch.where(low, s, torch.zeros_like(s))
    u_series = torch.zeros_like(x)
    l_series = torch.zeros_like(x)
    for m in range(8, -1, -1):
        sign = (-1.0) ** m / math.factorial(m + 2)
        u_series = u_series * x + sign
        l_series = l_series * x + sign * (m + 1)
    y = torch.where(low, torch.ones_like(s), s)
    decay = torch.exp(-y)
    u_closed = (torch.expm1(-y) + y) / y / y
    l_closed = (-torch.expm1(-y) - y * decay) / y / y
    upper = torch.where(low, u_series, u_closed)
    lower = torch.where(low, torch.exp(-x) * l_series, decay * l_closed)
    return 2 * math.pi * (lower + (upper - lower) * g)
