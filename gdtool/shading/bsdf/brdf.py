"""Evaluate the two reflection models in torch: glTF 2.0's (appendix B) and the paper's (Disney / Schlick-GGX).

Cosines are tensors of one shape and lie in [-1, 1]: n_l between normal and light, n_v between normal and view, n_h and
v_h with the half vector. They are clamped to [MIN_COSINE, 1] where a formula divides by them. Roughness is perceptual,
α = r², and shaded with r >= MIN_ROUGHNESS.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import Tensor

Brdf = Literal["gltf", "paper"]

MIN_ROUGHNESS = 0.045  # below it 1 / r⁴ overflows float16, and mirrors alias anyway
MIN_COSINE = 1e-3  # keeps 1 / cosine finite at grazing directions


def clamp_cosine(cosine: Tensor) -> Tensor:
    """Clamp a cosine to [MIN_COSINE, 1]."""
    return cosine.clamp(MIN_COSINE, 1.0)


def alpha_of(roughness: Tensor) -> Tensor:
    """Convert perceptual roughness, clamped to [MIN_ROUGHNESS, 1], to α = r²."""
    return roughness.clamp(MIN_ROUGHNESS, 1.0) ** 2


def f0_of(albedo: Tensor, metallic: Tensor, f0: float | Tensor) -> Tensor:
    """Blend the reflectance at normal incidence (..., 3): f0 for dielectrics, the albedo for metals.

    albedo (..., 3) linear; metallic (...) in [0, 1]; f0 a number or (..., 1).
    """
    m = metallic[..., None]
    return f0 * (1 - m) + albedo * m


def fresnel(f0: Tensor, cosine: Tensor) -> Tensor:
    """Evaluate Schlick's Fresnel term (1994), f0 + (1 − f0)(1 − c)^5, for f0 (..., 3) and cosine (...).

    In float32 it is within 2 machine epsilons for f0 >= 0.04. The rounding error of 1 − c is known exactly (Sterbenz's
    lemma); it is added back before the fifth power makes it five times larger.
    """
    c = cosine.clamp(0.0, 1.0)
    x = 1 - c
    lost = ((1 - x) - c).detach()
    x2 = x * x
    weight = (x2 * x2 * (x + 5 * lost))[..., None]
    return f0 + (1 - f0) * weight


def ndf(alpha: Tensor, n_h: Tensor) -> Tensor:
    """Evaluate the GGX normal distribution (Trowbridge & Reitz 1975), α² / (π ((n·h)²(α² − 1) + 1)²).

    alpha and the cosine n_h broadcast. 1 − (n·h)² is computed as (1 − n·h)(1 + n·h), which does not cancel near the
    normal.
    """
    c = n_h.clamp(0.0, 1.0)
    a2 = alpha * alpha
    base = (1 - c) * (1 + c) + a2 * c * c
    return a2 / (math.pi * base * base)


def visibility_gltf(alpha: Tensor, n_l: Tensor, n_v: Tensor) -> Tensor:
    """Evaluate height-correlated Smith shadowing, divided by 4 (n·l)(n·v) (Heitz 2014).

    alpha, and the cosines n_l and n_v of light and view with the normal, broadcast.
    """
    a2 = alpha * alpha
    n_l, n_v = clamp_cosine(n_l), clamp_cosine(n_v)
    root_v = torch.sqrt((1 - n_v) * (1 + n_v) * a2 + n_v * n_v)
    root_l = torch.sqrt((1 - n_l) * (1 + n_l) * a2 + n_l * n_l)
    return 0.5 / (n_l * root_v + n_v * root_l)


def visibility_paper(roughness: Tensor, n_l: Tensor, n_v: Tensor) -> Tensor:
    """Evaluate Schlick-GGX shadowing with k = (r + 1)² / 8, divided by 4 (n·l)(n·v).

    roughness in [0, 1], and the cosines n_l and n_v of light and view with the normal, broadcast. The cosines in
    numerator and denominator cancel: 1 / (4 (n·l (1 − k) + k)(n·v (1 − k) + k)).
    """
    k = (roughness.clamp(MIN_ROUGHNESS, 1.0) + 1) ** 2 / 8
    n_l, n_v = clamp_cosine(n_l), clamp_cosine(n_v)
    return 0.25 / ((n_l * (1 - k) + k) * (n_v * (1 - k) + k))


def visibility(brdf: Brdf, roughness: Tensor, n_l: Tensor, n_v: Tensor) -> Tensor:
    """Evaluate the shadowing term G / (4 (n·l)(n·v)) of a model; roughness and the cosines broadcast."""
    return visibility_gltf(alpha_of(roughness), n_l, n_v) if brdf == "gltf" else visibility_paper(roughness, n_l, n_v)


def disney_diffuse(roughness: Tensor, n_l: Tensor, n_v: Tensor, l_h: Tensor) -> Tensor:
    """Evaluate Disney's diffuse model (Burley 2012) as a factor on albedo / π.

    roughness in [0, 1], and the cosines n_l, n_v (light, view with the normal) and l_h (light with the half vector) in
    [0, 1], broadcast.
    """
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
    """Evaluate the diffuse and the specular BRDF (..., 3) at a pair of directions, without the cosine of the light.

    albedo (..., 3) linear; roughness, metallic (...) in [0, 1]; f0 (..., 3) from f0_of. n_l, n_v, n_h, v_h (...):
    cosines between normal n, light l, view v and half vector h. More than seven parameters: they are the terms of the
    formula, each a tensor.
    """
    fresnel_term = fresnel(f0, v_h)
    specular = fresnel_term * (ndf(alpha_of(roughness), n_h) * visibility(brdf, roughness, n_l, n_v))[..., None]
    diffuse = albedo * ((1 - metallic) / math.pi)[..., None]
    if brdf == "gltf":
        diffuse = diffuse * (1 - fresnel_term)
    else:
        diffuse = diffuse * disney_diffuse(roughness, n_l.clamp(0, 1), n_v.clamp(0, 1), v_h)[..., None]
    return diffuse, specular
