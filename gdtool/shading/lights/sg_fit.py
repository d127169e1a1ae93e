"""Fit spherical Gaussians to the radiance of an environment, and measure the fit's error."""

from __future__ import annotations

import numpy as np

from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.lights.bundled import LOBE_COUNT
from gdtool.shading.lights.environment import Environment
from gdtool.shading.sampling import fibonacci

# Rows of the image that is fitted.
FIT_ROWS = 32
# Logarithm of the largest sharpness that an image of FIT_ROWS rows resolves.
MAX_LOG_SHARPNESS = float(np.log(250.0))
# Weight of the squared irradiance error against the squared radiance error. Diffuse color comes nearly all from
# irradiance, so an error of 1 % in it counts like about 5 % in the radiance.
IRRADIANCE_WEIGHT = 30.0


def fit_sg(
    environment: Environment, count: int = LOBE_COUNT, seed: int = 0, steps: int = 300
) -> tuple[SphericalGaussians, dict[str, float]]:
    """Fit count lobes to an environment's radiance; also returns the fit's errors, by name as fit_error() gives them.

    Half of the lobes start at the brightest places; each start excludes its surroundings from the next. The other half
    start evenly spread. Adam then optimises axes, log sharpness and log amplitudes for `steps` steps. The loss has two
    parts: the squared error of the square root of radiance, weighted by solid angle, and the squared error of
    irradiance. The root keeps the sun from outweighing the sky. Raises ValueError for an environment without light.
    """
    import torch

    small = environment.downsampled(FIT_ROWS)
    d = small.directions.reshape(-1, 3)
    weight = np.repeat(small.solid_angles, small.image.shape[1])
    radiance = small.image.reshape(-1, 3).astype(np.float64)
    mean = float((radiance * weight[:, None]).sum() / (3 * weight.sum()))
    if mean <= 0:
        raise ValueError("an environment without light cannot be fitted")
    radiance = radiance / mean
    axes, sharpness, amplitudes = _start(d, radiance, weight, count, seed)

    generator = torch.Generator().manual_seed(seed)
    normals = torch.nn.functional.normalize(
        torch.randn(128, 3, generator=generator, dtype=torch.float64), dim=1
    ).float()
    directions, target = torch.tensor(d, dtype=torch.float32), torch.tensor(radiance, dtype=torch.float32)
    area = torch.tensor(weight / weight.sum(), dtype=torch.float32)
    transport = normals.matmul(directions.T).clamp_min(0) * area * 4
    irradiance = transport @ target
    parameters = [
        torch.tensor(x, dtype=torch.float32, requires_grad=True) for x in (axes, np.log(sharpness), np.log(amplitudes))
    ]
    optimizer = torch.optim.Adam(parameters, lr=0.05)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        axis = torch.nn.functional.normalize(parameters[0], dim=1)
        s, amplitude = parameters[1].clamp(-1.0, MAX_LOG_SHARPNESS).exp(), parameters[2].clamp(-12.0, 12.0).exp()
        fitted = torch.exp(s * (directions @ axis.T - 1)) @ amplitude
        loss = (area[:, None] * (torch.sqrt(fitted + 0.01) - torch.sqrt(target + 0.01)) ** 2).sum()
        loss = loss + IRRADIANCE_WEIGHT * ((transport @ fitted - irradiance) ** 2).mean() / (irradiance**2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        axis = torch.nn.functional.normalize(parameters[0], dim=1)
        lobes = SphericalGaussians(
            axis.double(),
            parameters[1].clamp(-1.0, MAX_LOG_SHARPNESS).exp().double(),
            parameters[2].clamp(-12, 12).exp().double() * mean,
        )
    return lobes, fit_error(environment, lobes)


def fit_error(environment: Environment, lobes: SphericalGaussians) -> dict[str, float]:
    """Measure how well lobes match an environment, on its image of about 32 rows.

    radiance_rms: RMS error over the sphere, relative to the RMS radiance. irradiance_rms, irradiance_max: RMS and
    largest error over 256 normals, relative to the RMS and the largest irradiance. energy: relative error of the total.
    """
    import torch

    from gdtool.shading.bsdf.sg import cosine_integral, evaluate

    small = environment.downsampled(FIT_ROWS)
    d = torch.tensor(small.directions.reshape(-1, 3), dtype=torch.float64)
    weight = torch.tensor(np.repeat(small.solid_angles, small.image.shape[1]), dtype=torch.float64)[:, None]
    truth = torch.tensor(small.image.reshape(-1, 3), dtype=torch.float64)
    g = lobes.to(torch.float64)
    fitted = evaluate(g, d)
    normals = torch.tensor(fibonacci(256))
    received = torch.tensor(small.irradiance(normals.numpy()), dtype=torch.float64)
    estimate = cosine_integral(g.sharpness, normals @ g.axes.T) @ g.amplitudes
    return {
        "radiance_rms": float(torch.sqrt((weight * (fitted - truth) ** 2).sum() / (weight * truth**2).sum())),
        "irradiance_rms": float(torch.sqrt(((estimate - received) ** 2).mean() / (received**2).mean())),
        "irradiance_max": float((estimate - received).abs().max() / received.max()),
        "energy": float((weight * fitted).sum() / (weight * truth).sum() - 1),
    }


def _start(
    d: np.ndarray, radiance: np.ndarray, weight: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose the fit's starting axes (k, 3), sharpness (k,) and amplitudes (k, 3); k = count.

    d (n, 3): unit directions of the pixels. radiance (n, 3): theirs, with mean 1. weight (n,): their solid angles.
    """
    peaks = count // 2
    bright = radiance.sum(1)
    hidden = bright.copy()
    peak_axes: list[np.ndarray] = []
    peak_sharpness: list[float] = []
    for _ in range(peaks):
        at = int(hidden.argmax())
        near = d @ d[at]
        # As wide as the region above half of the peak.
        region = weight[(near > 0.8) & (bright > 0.5 * bright[at])].sum()
        peak_axes.append(d[at])
        peak_sharpness.append(np.clip(2 * np.pi / max(region, 1e-3), 1.0, 500.0))
        hidden = np.where(near > np.cos(max(2.0 / np.sqrt(peak_sharpness[-1]), 0.25)), 0.0, hidden)
    spread = fibonacci(count - peaks)
    axes = np.concatenate([np.array(peak_axes).reshape(-1, 3), spread])
    sharpness = np.concatenate([peak_sharpness, np.full(count - peaks, 4.0)])
    nearest = np.array([radiance[(d @ axis).argmax()] for axis in axes])
    broad = np.array([np.average(radiance, axis=0, weights=weight * np.exp(4 * (d @ axis - 1))) for axis in spread])
    amplitudes = np.concatenate([nearest[:peaks], 0.4 * broad])
    jitter = np.random.default_rng(seed).normal(0, 0.01, axes.shape)
    return axes + jitter, sharpness, np.maximum(amplitudes, 1e-3)
