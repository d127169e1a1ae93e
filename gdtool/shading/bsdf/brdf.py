"""The two reflection models: glTF 2.0's (appendix B) and the paper's (Disney / Schlick-GGX), in torch.

Cosines are clamped to [MIN_COSINE, 1]; roughness is perceptual (α = r²) and shaded with r >= MIN_ROUGHNESS.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

Brdf = Literal["gltf", "paper"]

MIN_ROUGHNESS = 0.045  # below, 1 / r⁴ leaves float16 and mirrors alias anyway
MIN_COSINE = 1e-3


def clamp_cosine(cosine: Tensor) -> Tensor:
    """To [MIN_COSINE, 1]."""
    return cosine.clamp(MIN_COSINE, 1.0)


def alpha_of(roughness: Tensor) -> Tensor:
    """α = r², r clamped to [MIN_ROUGHNESS, 1]."""
    return roughness.clamp(MIN_ROUGHNESS, 1.0) ** 2


def f0_of(albedo: Tensor, metallic: Tensor, f0: float | Tensor) -> Tensor:
    """Reflectance at normal incidence (..., 3): f0 for dielectrics, the albedo for metals."""
    m = metallic[..., None]
    return f0 * (1 - m) + albedo * m


def fresnel(f0: Tensor, cosine: Tensor) -> Tensor:
    """Schlick 1994: f0 + (1 − f0)(1 − c)^5; f0 (..., 3), cosine (...). In float32 within 2 machine epsilons for f0 of
    0.04 and more: what rounding took from 1 − c, exact by Sterbenz's lemma, goes back in before the fifth power makes
    it five times larger."""
    c = cosine.clamp(0.0, 1.0)
    x = 1 - c
    lost = ((1 - x) - c).detach()
    x2 = x * x
    weight = (x2 * x2 * (x + 5 * lost))[..., None]
    return f0 + (1 - f0) * weight


def ndf(alpha: Tensor, n_h: Tensor) -> Tensor:
    """GGX (Trowbridge & Reitz 1975): α² / (π ((n·h)²(α² − 1) + 1)²), with 1 − (n·h)² from the factors."""
    c = n_h.clamp(0.0, 1.0)
    a2 = alpha * alpha
    base = (1 - c) * (1 + c) + a2 * c * c
    return a2 / (math.pi * base * base)


def visibility_gltf(alpha: Tensor, n_l: Tensor, n_v: Tensor) -> Tensor:
    """Height-correlated Smith, divided by 4 (n·l)(n·v) (Heitz 2014)."""
    a2 = alpha * alpha
    l, v = clamp_cosine(n_l), clamp_cosine(n_v)
    root_v = torch.sqrt((1 - v) * (1 + v) * a2 + v * v)
    root_l = torch.sqrt((1 - l) * (1 + l) * a2 + l * l)
    return 0.5 / (l * root_v + v * root_l)


def visibility_paper(roughness: Tensor, n_l: Tensor, n_v: Tensor) -> Tensor:
    """Schlick-GGX with k = (r + 1)² / 8, the cosines of its numerator cancelled: 1 / (4 (l(1−k)+k)(v(1−k)+k))."""
    k = (roughness.clamp(MIN_ROUGHNESS, 1.0) + 1) ** 2 / 8
    l, v = clamp_cosine(n_l), clamp_cosine(n_v)
    return 0.25 / ((l * (1 - k) + k) * (v * (1 - k) + k))


def visibility(brdf: Brdf, roughness: Tensor, n_l: Tensor, n_v: Tensor) -> Tensor:
    """G / (4 (n·l)(n·v)) of the model."""
    return visibility_gltf(alpha_of(roughness), n_l, n_v) if brdf == "gltf" else visibility_paper(roughness, n_l, n_v)


def disney_diffuse(roughness: Tensor, n_l: Tensor, n_v: Tensor, l_h: Tensor) -> Tensor:
    """Factor on albedo / π of Disney's diffuse (Burley 2012)."""
    f90 = 0.5 + 2 * roughness * l_h * l_h
    return (1 + (f90 - 1) * (1 - n_l) ** 5) * (1 + (f90 - 1) * (1 - n_v) ** 5)


def reflectance(
    brdf: Brdf,
    albedo: Tensor,
    roughness: Tensor,
    metallic: Tensor,
    f0: Tensor,
    n_l: Tensor,
    n_v: Tensor,
    n_h: Tensor,
    v_h: Tensor,
) -> tuple[Tensor, Tensor]:
    """Diffuse and specular BRDF (..., 3) at one pair of directions, without the cosine; f0 (..., 3) from f0_of."""
    fresnel_term = fresnel(f0, v_h)
    specular = fresnel_term * (ndf(alpha_of(roughness), n_h) * visibility(brdf, roughness, n_l, n_v))[..., None]
    diffuse = albedo * ((1 - metallic) / math.pi)[..., None]
    if brdf == "gltf":
        diffuse = diffuse * (1 - fresnel_term)
    else:
        diffuse = diffuse * disney_diffuse(roughness, n_l.clamp(0, 1), n_v.clamp(0, 1), v_h)[..., None]
    return diffuse, specular
