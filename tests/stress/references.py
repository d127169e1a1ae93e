"""References in float64 or mpmath for what the code computes in float32, and the inputs that the sweeps share."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import torch

from gdtool.shading.bsdf import brdf as models
from gdtool.shading.bsdf.sg import SphericalGaussians, evaluate, normalize

ULP = float(np.finfo(np.float32).eps)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(300)
N = torch.tensor([0.0, 0.0, 1.0])

# Values of λ to sweep, with the ends of the formats and the places where the code changes its form.
SHARPNESS = (
    0.0,
    1e-45,
    1e-38,
    1e-30,
    *(10.0**k for k in range(-8, 11)),
    9.9e-5,
    1.01e-4,
    9.9e-4,
    1.01e-3,
    0.499,
    0.501,
    1e12,
    3e38,
)
# 181 angles, and those where the clamped cosine's edge is.
ANGLES = np.concatenate([np.linspace(0, np.pi, 181), np.pi / 2 + np.array([-1e-3, -1e-6, 1e-6, 1e-3])])


def direction(degrees: float, azimuth: float = 0.0, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """(3,) unit, at an angle from N."""
    a, b = math.radians(degrees), math.radians(azimuth)
    return torch.tensor([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)], dtype=dtype)


def light(axis: torch.Tensor, sharpness: float, amplitude: float = 1.0) -> SphericalGaussians:
    """One grey lobe."""
    return SphericalGaussians(
        axis[None], torch.tensor([sharpness], dtype=axis.dtype), torch.full((1, 3), amplitude, dtype=axis.dtype)
    )


def sphere_integral(sharpness: float) -> float:
    """∫ exp(λ(cos θ − 1)) over the sphere."""
    x = mpmath.mpf(sharpness)
    return float(4 * mpmath.pi if x == 0 else -2 * mpmath.pi * mpmath.expm1(-2 * x) / x)


def ring_integrals(sharpness: float, cosines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """∫ exp(λ(v·p − 1)) max(0, v·n) dv and the same over the hemisphere about n, for p·n = cosines (c,).

    The azimuth about p in closed form, the angle from p by Gauss-Legendre in two panels that end where the ring first
    crosses the horizon, so that neither has a kink inside.
    """
    reach = min(2.0, 80.0 / max(sharpness, 1e-9))
    cosine_part, half_part = np.zeros(len(cosines)), np.zeros(len(cosines))
    for i, cosine in enumerate(cosines):
        across = math.sqrt(max(1 - cosine * cosine, 0.0))
        # Rings cut the horizon where 1 − μ lies between these.
        cuts = sorted({0.0, reach, *(x for x in (1 - across, 1 + across) if 0 < x < reach)})
        for low, high in zip(cuts, cuts[1:], strict=False):
            # x = low + (high − low) sin²: square roots at both ends become smooth.
            angle = (NODES + 1) * (math.pi / 4)
            drop = low + (high - low) * np.sin(angle) ** 2
            weight = WEIGHTS * (math.pi / 4) * (high - low) * np.sin(2 * angle)
            mu, ring = 1 - drop, np.sqrt(np.maximum(drop * (2 - drop), 0))
            a, b = mu * cosine, ring * across
            phi = np.arccos(np.clip(-a / np.maximum(b, 1e-300), -1, 1))
            lobe = np.exp(-sharpness * drop) * weight
            cosine_part[i] += 2 * (lobe * (a * phi + b * np.sin(phi))).sum()
            half_part[i] += 2 * (lobe * phi).sum()
    return cosine_part, half_part


def product_of_lobes(axis1, sharpness1, axis2, sharpness2) -> tuple[list, object, object]:
    """Axis, sharpness and log amplitude of a product, axes normalised first, in 60 digits."""
    with mpmath.workdps(60):

        def unit(v):
            v = [mpmath.mpf(float(x)) for x in v]
            length = mpmath.sqrt(sum(x * x for x in v))
            return [x / length for x in v]

        t1, t2 = mpmath.mpf(float(sharpness1)), mpmath.mpf(float(sharpness2))
        total = [t1 * a + t2 * b for a, b in zip(unit(axis1), unit(axis2), strict=True)]
        length = mpmath.sqrt(sum(x * x for x in total))
        return [x / length if length else mpmath.mpf(0) for x in total], length, length - t1 - t2


def reflected(
    view, albedo, roughness, metallic, lights, kind="gltf", f0=0.04, rings=512, spokes=512
) -> tuple[torch.Tensor, torch.Tensor]:
    """Diffuse and specular radiance (3,) of the true BRDF under SG light about N, by quadrature in float64.

    The grid is a polar one about the sharper of the reflection lobe and the first light, finer toward its pole.
    """
    dtype = torch.float64
    u = (torch.arange(rings, dtype=dtype) + 0.5) / rings
    drop, weight = 2 * u**4, 8 * u**3 / rings * (2 * math.pi / spokes)
    phi = (torch.arange(spokes, dtype=dtype) + 0.5) * 2 * math.pi / spokes
    mu, ring = 1 - drop, torch.sqrt(drop * (2 - drop))
    local = torch.stack(
        [ring[:, None] * phi.cos(), ring[:, None] * phi.sin(), mu[:, None].expand(-1, spokes)], -1
    ).reshape(-1, 3)
    v = view.to(dtype)
    mirror = torch.stack([-v[0], -v[1], v[2]])
    pole = (
        mirror
        if 2 / max(roughness, models.MIN_ROUGHNESS) ** 4 > float(lights.sharpness[0])
        else lights.axes[0].to(dtype)
    )
    helper = torch.eye(3, dtype=dtype)[int(pole.abs().argmin())]
    x = normalize(torch.linalg.cross(helper, pole))
    y = torch.linalg.cross(pole, x)
    light = local[:, :1] * x + local[:, 1:2] * y + local[:, 2:] * pole
    w = weight[:, None].expand(-1, spokes).reshape(-1)
    h = normalize(light + v)
    n_l = light[:, 2].clamp_min(0)
    a, r, m = (torch.as_tensor(t, dtype=dtype) for t in (albedo, roughness, metallic))
    diffuse, specular = models.reflectance(
        kind,
        a,
        r,
        m,
        models.f0_of(a, m, f0),
        n_l,
        v[2].expand_as(n_l),
        h[:, 2].clamp(0, 1),
        (h * v).sum(-1).clamp(0, 1),
    )
    radiance = evaluate(lights.to(dtype), light) * (n_l * w)[:, None]
    return (diffuse * radiance).sum(0), (specular * radiance).sum(0)
