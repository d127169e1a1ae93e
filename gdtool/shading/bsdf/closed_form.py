"""Shade points under spherical Gaussian light in closed form, without shadows; differentiable in every argument.

Diffuse light is the integral of each lobe times the clamped cosine. Specular light is a sum of two estimates, weighted
by 1 / (1 + x) and x / (1 + x) with x = 2 λ_light r⁴ n·v:

- For light that is broader than the reflection lobe: the product of the light and the lobe, which is taken as a
  spherical Gaussian about the mirror direction (Wang et al. 2009, "All-frequency rendering of dynamic,
  spatially-varying reflectance").
- For light that is sharper: the light's energy times a GGX lobe that is widened by the light's width (after Tokuyoshi
  2015, "Virtual spherical Gaussian lights for real-time glossy indirect illumination").
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import torch
from torch import Tensor

from gdtool.cameras import Camera, rays
from gdtool.shading.bsdf.brdf import Brdf, alpha_of, clamp_cosine, f0_of, fresnel, ndf, visibility
from gdtool.shading.bsdf.sg import MAX_SHARPNESS, SphericalGaussians, cosine_integral, dot, integral, normalize, product

# The least n·v that is shaded: the forms about the mirror direction divide by it. Pixels at grazing angles are few, and
# no closed form is good there.
MIN_VIEW_COSINE = 0.05


def fresnel_loss(n_v: Tensor) -> Tensor:
    """Approximate the mean of (1 − v·h)^5 over the hemisphere of light directions, weighted by their cosine.

    n_v (...): cosine of view and normal. A quartic in 1 − n·v, fitted to quadrature; the largest error is 1e-5.
    """
    x = 1 - n_v.clamp(0.0, 1.0)
    return FRESNEL_LOSS[0] + x * (FRESNEL_LOSS[1] + x * (FRESNEL_LOSS[2] + x * (FRESNEL_LOSS[3] + x * FRESNEL_LOSS[4])))


FRESNEL_LOSS = (8.2276e-05, 2.01991e-03, 9.31524e-03, 7.78369e-03, 8.96193e-03)


def disney_mean(roughness: Tensor, n_v: Tensor) -> Tensor:
    """Approximate the mean of Disney's diffuse factor over the light's hemisphere, weighted by the light's cosine.

    roughness (...) in [0, 1]; n_v (...): cosine of view and normal.
    """
    # E[(1 − n·l)^5] = 1/21 and E[(l·h)²] = (1 + E[l·v]) / 2 with E[l·v] = 2/3 n·v under the cosine density.
    v = n_v.clamp(0.0, 1.0)
    f90 = 0.5 + roughness * (1 + (2 / 3) * v)
    return (1 + (f90 - 1) / 21) * (1 + (f90 - 1) * (1 - v) ** 5)


def shade(
    normal: Tensor,
    view: Tensor,
    albedo: Tensor,
    roughness: Tensor,
    metallic: Tensor,
    lights: SphericalGaussians,
    brdf: Brdf = "gltf",
    f0: float | Tensor = 0.04,
) -> Tensor:
    """Compute the linear radiance (..., 3) that points reflect toward view.

    normal and view (..., 3) are unit, view toward the eye; albedo (..., 3) linear; roughness, metallic (...) in [0, 1];
    f0, the dielectric reflectance, a number or (..., 1). A zero normal gives 0. A view below the horizon is shaded as
    grazing. All arguments broadcast. More than seven parameters: they are the terms of the formula, each
    differentiable.
    """
    diffuse, specular = shade_parts(normal, view, albedo, roughness, metallic, lights, brdf, f0)
    return diffuse + specular


def shade_parts(
    normal: Tensor,
    view: Tensor,
    albedo: Tensor,
    roughness: Tensor,
    metallic: Tensor,
    lights: SphericalGaussians,
    brdf: Brdf = "gltf",
    f0: float | Tensor = 0.04,
) -> tuple[Tensor, Tensor]:
    """Compute the diffuse and the specular part (..., 3) of shade, with the same parameters."""
    known = (dot(normal, normal) > 0.25).to(normal.dtype)[..., None]
    n_v = dot(normal, view).clamp(MIN_VIEW_COSINE, 1.0)
    light_cosine = dot(normal[..., None, :], lights.axes)
    received = cosine_integral(lights.sharpness, light_cosine)
    irradiance = (received[..., None] * lights.amplitudes).sum(-2) * known
    reflected = f0_of(albedo, metallic, f0)
    diffuse = albedo * ((1 - metallic) / math.pi)[..., None] * irradiance
    if brdf == "gltf":
        diffuse = diffuse * (1 - reflected - (1 - reflected) * fresnel_loss(n_v)[..., None])
    else:
        diffuse = diffuse * disney_mean(roughness, n_v)[..., None]
    specular = _specular(normal, view, n_v, roughness, reflected, light_cosine, received, lights, brdf) * known
    return diffuse, specular


def _specular(
    normal: Tensor,
    view: Tensor,
    n_v: Tensor,
    roughness: Tensor,
    f0: Tensor,
    light_cosine: Tensor,
    received: Tensor,
    lights: SphericalGaussians,
    brdf: Brdf,
) -> Tensor:
    """Compute the specular radiance (..., 3) of shade_parts.

    n_v (...): clamped cosine of view and normal. f0 (..., 3) from f0_of. light_cosine, received (..., k): cosine with
    the normal and clamped-cosine integral of each of k lobes. Nine parameters: shade_parts has computed some of them
    already.
    """
    alpha = alpha_of(roughness)
    alpha2 = alpha * alpha

    # The lobe as an SG: about n in half vectors, about the mirror direction in light directions.
    sharpness_h = 2 / alpha2
    peak = 1 / cosine_integral(sharpness_h, torch.ones_like(sharpness_h))
    light_sharpness = lights.sharpness.clamp_max(MAX_SHARPNESS)
    mirror = normalize(2 * dot(normal, view)[..., None] * normal - view)
    warped = (sharpness_h / (4 * n_v))[..., None]
    axis, sharpness, exponent = product(mirror[..., None, :], warped, lights.axes, light_sharpness)
    overlap = torch.exp(exponent) * cosine_integral(sharpness, dot(axis, normal[..., None, :]))
    by_lobe = (peak * visibility(brdf, roughness, n_v, n_v))[..., None] * overlap

    # The light as a point: GGX widened by the light's spread, times the energy that arrives.
    half = normalize(view[..., None, :] + lights.axes)
    n_h, v_h = dot(half, normal[..., None, :]), dot(half, view[..., None, :]).clamp(MIN_VIEW_COSINE, 1.0)
    spread = (1 + 1 / (v_h * v_h)) / (4 * light_sharpness.clamp_min(0.1))
    filtered = torch.sqrt((alpha2[..., None] + spread).clamp_max(1.0))
    mean_cosine = clamp_cosine(received / integral(light_sharpness))
    by_light = ndf(filtered, n_h) * visibility(brdf, roughness[..., None], mean_cosine, n_v[..., None]) * received

    x = 2 * light_sharpness * (alpha2 * n_v)[..., None]
    weight = x / (1 + x)
    lobes = (1 - weight)[..., None] * by_lobe[..., None] * fresnel(f0, n_v)[..., None, :]
    lobes = lobes + weight[..., None] * by_light[..., None] * fresnel(f0[..., None, :], v_h)
    return (lobes * lights.amplitudes).sum(-2)


def closed_form_image(
    frame: dict[str, np.ndarray], camera: Camera, lobes: SphericalGaussians, brdf: str = "gltf"
) -> np.ndarray:
    """Shade a view's material maps under spherical Gaussians, without shadows: (h, w, 3) linear radiance.

    frame: the images normal, albedo, roughness, metallic and mask (h, w[, c]) by name, as Renderer.buffers returns
    them. Pixels whose mask is 0 are 0.
    """
    inside = frame["mask"] > 0
    view = -rays(camera)[1][inside]
    normal, toward, albedo, roughness, metallic = (
        torch.tensor(x, dtype=torch.float32)
        for x in (
            frame["normal"][inside],
            view,
            frame["albedo"][inside],
            frame["roughness"][inside],
            frame["metallic"][inside],
        )
    )
    out = np.zeros((*inside.shape, 3), np.float32)
    with torch.no_grad():
        out[inside] = shade(
            normal, toward, albedo, roughness, metallic, lobes.to(torch.float32), cast(Brdf, brdf)
        ).numpy()
    return out
