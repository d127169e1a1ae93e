"""Fit the SDF and material networks to views, starting from the geometry that the views carry: the paper's method.

Phases: fit the SDF network to the carved grid; train by NeuS volume rendering where no depth pins the surface down;
train at explicit surface points. Every domain that the views hold is used; no domain is required.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gdtool.fields.neural.networks import FREQUENCIES, MaterialNetwork, SdfNetwork
from gdtool.fields.neural.surface_sampling import (
    first_crossing,
    implicit_points,
    median_of_cdf,
    neus_weights,
    secant_root,
    unit,
)
from gdtool.shading.bsdf.closed_form import shade
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.sampling import fibonacci

SAMPLES, NARROW = 64, 8  # samples along a ray, and between a crossing's two ends
LIGHTS = 16  # lobes of the light
DISTANCE_RATE = 2e-3  # highest learning rate of Adam while distances are fitted
WEIGHTS = {"depth": 10.0, "normal": 1.0, "color": 1.0, "material": 1.0, "mask": 1.0, "eikonal": 0.1}


@dataclass(frozen=True)
class Pixels:
    """Hold the rays of all views and the values at their pixels.

    origins, directions (n, 3); inside (n,) bool; values: domain to (n[, c]). near, far (n,): where the ray may meet the
    surface. Pixels that the silhouette cuts are left out.
    """

    origins: Tensor
    directions: Tensor
    inside: Tensor
    near: Tensor
    far: Tensor
    values: dict[str, Tensor]


@dataclass
class Fit:
    """Hold the two networks, the light's raw parameters, and the losses by name at intervals of the training."""

    sdf: SdfNetwork
    material: MaterialNetwork
    light: Tensor
    sharpness: Tensor
    history: list[dict[str, float]] = field(default_factory=list)

    def lights(self) -> SphericalGaussians:
        """Return sixteen evenly spread lobes, with amplitudes softplus of the parameters."""
        axes = torch.as_tensor(fibonacci(LIGHTS), dtype=self.light.dtype, device=self.light.device)
        return SphericalGaussians(
            axes,
            torch.full((LIGHTS,), 8.0, dtype=self.light.dtype, device=self.light.device),
            torch.nn.functional.softplus(self.light),
        )


@dataclass(frozen=True)
class Schedule:
    """Set the length and the variant of `train`.

    rule: see find_surface. brdf: see closed_form.shade. samples: along a ray.
    """

    volume_steps: int
    surface_steps: int
    batch: int
    seed: int
    rule: str
    brdf: str
    samples: int = SAMPLES


class RaySegments(NamedTuple):
    """Rays between two depths: origins, directions (n, 3), near, far (n,)."""

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor


def start(seed: int, device: str) -> Fit:
    """Create fresh networks; the same seed gives the same weights on every device."""
    torch.manual_seed(seed)
    sdf, material = SdfNetwork().to(device), MaterialNetwork().to(device)
    light = torch.full((LIGHTS, 3), 0.0, device=device, requires_grad=True)
    return Fit(sdf, material, light, torch.tensor(float(np.log(60.0)), device=device, requires_grad=True))


def one_cycle(progress: float, warm: float = 0.1) -> float:
    """Return the factor of the learning rate: linear to 1 at `warm`, then a cosine down to 0 at progress 1."""
    if progress < warm:
        return max(progress / warm, 0.01)
    return 0.5 * (1 + math.cos(math.pi * min((progress - warm) / (1 - warm), 1.0)))


def fit_distances(
    fit: Fit,
    sample: Callable[[int], tuple[Tensor, Tensor]],
    steps: int,
    batch: int,
    track,
    spent: Callable[[], float],
    half_share: float = 0.0,
) -> float:
    """Fit the SDF network to known distances; returns the running mean of the absolute error.

    sample(n) gives points (n, 3) and distances (n,). spent() is the share of the time that is gone. The schedule
    follows it where it is ahead of the steps, so that the rate is small at the end on any machine. half_share: share of
    the schedule with layers in bfloat16. Its last digit is a few thousandths of the object, so the rest has to be
    float32. Frequencies are let in one by one over the first half.
    """
    device = fit.light.device
    optimiser = torch.optim.Adam(fit.sdf.parameters(), lr=0.0)
    error = 0.0
    fit.sdf.turn_outward()
    for k in track(steps, "fit distances"):
        progress = max(k / steps, spent())
        if progress >= 1:
            break
        optimiser.param_groups[0]["lr"] = DISTANCE_RATE * one_cycle(progress)
        fit.sdf.show_frequencies(3 + (FREQUENCIES - 3) * 2 * progress)
        points, distances = sample(batch)
        with torch.autocast(device.type, torch.bfloat16, enabled=progress < half_share):
            predicted = fit.sdf(points)
        gap = (predicted.float() - distances).abs()
        # Far from the surface the sign and the rough size are enough.
        loss = (gap / (1 + 10 * distances.abs())).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(fit.sdf.parameters(), 1.0)
        optimiser.step()
        error = 0.95 * error + 0.05 * float(gap.detach().mean()) if error else float(gap.detach().mean())
    fit.sdf.show_frequencies(FREQUENCIES)
    return error


def find_surface(
    sdf: SdfNetwork,
    segments: RaySegments,
    rule: str = "secant",
    sharpness: float = 300.0,
    samples: int = SAMPLES,
) -> tuple[Tensor, Tensor, Tensor]:
    """Find where rays first enter the surface.

    Returns the depth (n,) along the ray, whether there is a crossing (n,), and the sample of least distance (n, 3).
    rule: "median" of the CDF of NARROW samples between the crossing's ends, or "secant" through them.
    """
    origins, directions, near, far = segments
    with torch.no_grad():
        share = torch.linspace(0, 1, samples, device=origins.device)
        t = near[:, None] + (far - near)[:, None] * share
        values = sdf(origins[:, None] + t[..., None] * directions[:, None])
        crosses, idx = first_crossing(values)
        lowest = values.argmin(1, keepdim=True)
        closest = origins + t.gather(1, lowest) * directions
        i = idx[:, None]
        t0, t1 = t.gather(1, i)[:, 0], t.gather(1, i + 1)[:, 0]
        f0, f1 = values.gather(1, i)[:, 0], values.gather(1, i + 1)[:, 0]
        if rule == "median":
            inner = t0[:, None] + (t1 - t0)[:, None] * torch.linspace(0, 1, NARROW, device=t.device)
            depth = median_of_cdf(inner, sdf(origins[:, None] + inner[..., None] * directions[:, None]), sharpness)
        else:
            depth = secant_root(t0, t1, f0, f1)
            # One step of regula falsi more: the chord of a curved field misses by its second order.
            value = sdf(origins + depth[:, None] * directions)
            ahead = value >= 0
            depth = secant_root(
                torch.where(ahead, depth, t0),
                torch.where(ahead, t1, depth),
                torch.where(ahead, value, f0),
                torch.where(ahead, f1, value),
            )
        return depth, crosses, closest


def volume_losses(fit: Fit, pixels: Pixels, chosen: Tensor) -> dict[str, Tensor]:
    """Compute NeuS losses of rays: opacity against the mask, expected normal and depth against the views."""
    origins, directions = pixels.origins[chosen], pixels.directions[chosen]
    near, far, inside = pixels.near[chosen], pixels.far[chosen], pixels.inside[chosen].float()
    t = (
        near[:, None]
        + (far - near)[:, None]
        * (torch.arange(SAMPLES, device=near.device) + torch.rand(1, device=near.device))
        / SAMPLES
    )
    values, gradient = fit.sdf.with_gradient(origins[:, None] + t[..., None] * directions[:, None])
    weights = neus_weights(values, fit.sharpness.exp())
    opacity = weights.sum(1).clamp(1e-4, 1 - 1e-4)
    losses = {
        "mask": torch.nn.functional.binary_cross_entropy(opacity, inside),
        "eikonal": ((gradient.norm(dim=-1) - 1) ** 2).mean(),
    }
    middle = (t[:, 1:] + t[:, :-1]) / 2
    hit = inside / inside.sum().clamp_min(1)
    if "normal" in pixels.values:
        normal = (weights[..., None] * unit(gradient[:, 1:])).sum(1)
        losses["normal"] = (hit * (1 - (normal * pixels.values["normal"][chosen]).sum(-1))).sum()
    if "depth" in pixels.values:
        losses["depth"] = (hit * ((weights * middle).sum(1) / opacity - pixels.values["depth"][chosen]).abs()).sum()
    return losses


def surface_losses(
    fit: Fit, pixels: Pixels, chosen: Tensor, rule: str, brdf: str, samples: int = SAMPLES
) -> dict[str, Tensor]:
    """Compute losses at explicit surface points, and of rays that hit outside the mask or miss inside it."""
    origins, directions, inside = pixels.origins[chosen], pixels.directions[chosen], pixels.inside[chosen]
    depth, crosses, closest = find_surface(
        fit.sdf, RaySegments(origins, directions, pixels.near[chosen], pixels.far[chosen]), rule, samples=samples
    )
    losses: dict[str, Tensor] = {}
    wrong = crosses != inside
    if wrong.any():
        value = fit.sdf(closest[wrong]) * torch.where(inside[wrong], 1.0, -1.0)
        losses["mask"] = torch.nn.functional.softplus(50 * value).sum() / 50 / len(chosen) * 10
    good = crosses & inside
    if not good.any():
        return losses
    here = origins[good] + depth[good, None] * directions[good]
    value, gradient = fit.sdf.with_gradient(here)
    points = implicit_points(here, directions[good], value, gradient)
    normal = unit(gradient)
    wanted = {name: v[chosen][good] for name, v in pixels.values.items()}
    losses["eikonal"] = ((gradient.norm(dim=-1) - 1) ** 2).mean()
    if "depth" in wanted:
        gap = (((points - origins[good]) * directions[good]).sum(-1) - wanted["depth"]).abs()
        losses["depth"] = torch.where(gap < 0.1, gap, 0.1 + 0 * gap).mean()
    if "normal" in wanted:
        losses["normal"] = (1 - (normal * wanted["normal"]).sum(-1)).mean()
    material = fit.material(points)
    albedo, roughness, metallic = material[:, :3], material[:, 3], material[:, 4]
    losses["material"] = sum(
        (
            (value - wanted[name]).abs().mean()
            for name, value in (("albedo", albedo), ("roughness", roughness), ("metallic", metallic))
            if name in wanted
        ),
        torch.zeros((), device=here.device),
    )
    if "color" in wanted:
        f0 = 0.08 * material[:, 5:6] if brdf == "paper" else 0.04
        lit = shade(normal, -directions[good], albedo, roughness, metallic, fit.lights(), brdf, f0)
        losses["color"] = (tone(lit) - tone(wanted["color"])).abs().mean()
        if "albedo" not in wanted:
            # Light and albedo are known up to a scale: hold the mean albedo, and keep what color does not tell quiet.
            losses["prior"] = (
                0.1 * (albedo.mean() - 0.5) ** 2 + 0.02 * (roughness - 0.5).pow(2).mean() + 0.05 * metallic.mean()
            )
    return losses


def tone(radiance: Tensor) -> Tensor:
    """Compress radiance by a gamma of 2.2, so that highlights do not dominate the loss."""
    return (radiance.clamp_min(0) + 1e-3).pow(1 / 2.2)


def train(fit: Fit, pixels: Pixels, schedule: Schedule, track: Callable, spent: Callable[[], float]) -> int:
    """Train both networks: a volume phase, then an explicit surface phase; returns the number of steps done.

    spent(): share of the time that is gone, as in fit_distances.
    """
    generator = torch.Generator().manual_seed(schedule.seed)
    device = fit.light.device
    parameters = [
        {"params": fit.sdf.parameters(), "lr": 2e-4},
        {"params": fit.material.parameters(), "lr": 2e-3},
        {"params": [fit.light], "lr": 1e-2},
        {"params": [fit.sharpness], "lr": 5e-3},
    ]
    optimiser = torch.optim.Adam(parameters)
    highest = [group["lr"] for group in parameters]
    steps = schedule.volume_steps + schedule.surface_steps

    hits, misses = (torch.nonzero(x)[:, 0].cpu() for x in (pixels.inside, ~pixels.inside))
    done, gone = 0, spent()
    for k in track(steps, "networks"):
        # The clock counts from where this began; the start before it has spent its own share.
        progress = max(k / steps, (spent() - gone) / max(1 - gone, 1e-6))
        if progress >= 1:
            break
        # Adam's first steps move every weight by the full rate: without a warm-up they undo the fitted start.
        for group, rate in zip(optimiser.param_groups, highest, strict=True):
            group["lr"] = rate * min(1.0, (k + 1) / 30) * max(one_cycle(progress, 0.0), 0.02)
        volume = progress < schedule.volume_steps / steps
        size = schedule.batch // 4 if volume else schedule.batch
        share = size * 3 // 4 if len(misses) else size
        pick = hits[torch.randint(len(hits), (share,), generator=generator)]
        if len(misses):
            pick = torch.cat([pick, misses[torch.randint(len(misses), (size - share,), generator=generator)]])
        pick = pick.to(device)
        losses = (
            volume_losses(fit, pixels, pick)
            if volume
            else surface_losses(fit, pixels, pick, schedule.rule, schedule.brdf, schedule.samples)
        )
        if not volume:
            around = (torch.rand(size // 4, 3, generator=generator) * 1.1 - 0.55).to(device)
            losses["eikonal"] = (
                losses.get("eikonal", 0.0) + ((fit.sdf.with_gradient(around)[1].norm(dim=-1) - 1) ** 2).mean()
            )
        loss = sum(WEIGHTS.get(name, 1.0) * value for name, value in losses.items())
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([p for group in parameters for p in group["params"]], 1.0)
        optimiser.step()
        done = k + 1
        if k % 20 == 0 or done == steps:
            fit.history.append({"step": float(done), **{name: float(value.detach()) for name, value in losses.items()}})
    return done
