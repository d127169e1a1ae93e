"""Define the noise schedule x_t = alpha_t x_0 + sigma_t e, the prediction of x_0, and samplers.

e is standard normal and alpha² + sigma² = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from gdtool.diffusion.config import ModelConfig


def alpha_and_sigma(config: ModelConfig) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute alpha and sigma for every timestep, (timesteps,) float32 each.

    They are on the CPU, even where the model is built on the meta device.
    """
    n = config.timesteps
    if config.noise_schedule == "scaled_linear":  # Stable Diffusion 1
        beta = torch.linspace(0.00085**0.5, 0.012**0.5, n, dtype=torch.float64, device="cpu") ** 2
        square = torch.cumprod(1 - beta, 0)
    else:  # Nichol & Dhariwal 2021, without their offset; ends in pure noise, so sampling starts where training was
        square = torch.cos((torch.arange(n, dtype=torch.float64, device="cpu") + 1) / n * math.pi / 2) ** 2
    return square.sqrt().float(), (1 - square).sqrt().float()


def clean_from_prediction(config: ModelConfig, prediction, noisy, a, s):
    """Compute x_0 from the network's prediction and its noisy input, (n, c, h, w) each.

    a, s: alpha and sigma, which broadcast against noisy. At alpha = 0 an epsilon prediction does not determine x_0, so
    alpha is clamped to 1e-4.
    """
    if config.prediction == "x":
        return prediction
    if config.prediction == "v":  # v = a e - s x_0
        return a * noisy - s * prediction
    return (noisy - s * prediction) / a.clamp_min(1e-4)


DATA_VARIANCE = 0.25  # of encoded images (most pixels are background), as in Karras et al. 2022


def input_scale(config: ModelConfig, a, s):
    """Return the factor on x_t as the network's input, for alpha a and sigma s.

    It is 1 for noisy_input "unit". For "shrunk" it is the factor of the best linear estimate of x_0 from x_t.
    """
    if config.noisy_input == "unit":
        return 1.0
    return a * DATA_VARIANCE / (a * a * DATA_VARIANCE + s * s)


def loss_weight(a: torch.Tensor, s: torch.Tensor, gamma: float, floor: float) -> torch.Tensor:
    """Compute the weight of x_0's error: the SNR a² / s², clamped to [floor, gamma] (min-SNR, Hang et al. 2023)."""
    return (a * a / (s * s).clamp_min(1e-8)).clamp(max=gamma).clamp(min=floor)


Spacing = Literal["trailing", "leading"]


@dataclass(frozen=True)
class Renewal:
    """Set how much noise each step of DDIM renews (Song et al. 2021, eq. 16).

    eta: 0 is deterministic, 1 renews as much as DDPM does. draw: gives standard normal noise of the latents' shape. It
    is called once in every step that does not end at x_0, in the order of the steps, as in diffusers' DDIMScheduler.
    """

    eta: float
    draw: Callable[[], torch.Tensor]


def timesteps(config: ModelConfig, steps: int, spacing: Spacing | None = None) -> list[int]:
    """Return `steps` decreasing timesteps that sampling visits.

    spacing: "trailing" starts at the last timestep (Lin et al. 2024); "leading" takes the multiples of
    timesteps // steps and adds config.sampling_offset, as diffusers does; None is the configuration's.
    """
    n = config.timesteps
    if (spacing or config.sampling_spacing) == "leading":
        return [min(i * (n // steps) + config.sampling_offset, n - 1) for i in reversed(range(steps))]
    return [max(round(n * (1 - i / steps)) - 1, 0) for i in range(steps)]


def sample(
    denoise: Callable[[torch.Tensor, int, int], torch.Tensor],
    noise: torch.Tensor,
    config: ModelConfig,
    steps: int,
    scheduler: str,
    spacing: Spacing | None = None,
    renewal: Renewal | None = None,
) -> torch.Tensor:
    """Integrate from noise (n, c, h, w) to x_0 in `steps` steps.

    denoise(x, timestep, step's number) predicts x_0. scheduler: "ddim" (Song et al. 2021) or "dpm", DPM-Solver++(2M)
    (Lu et al. 2022, algorithm 2). spacing: see timesteps(). renewal: for DDIM; without it each step is deterministic.
    The configuration's own spacing ends where sampling_ends_clean says, another one at x_0.
    """
    alpha, sigma = alpha_and_sigma(config)
    steps_at = timesteps(config, steps, spacing)
    ends_clean = config.sampling_ends_clean or spacing not in (None, config.sampling_spacing)
    levels = [(float(alpha[t]), float(sigma[t])) for t in steps_at]
    levels.append((1.0, 0.0) if ends_clean else (float(alpha[0]), float(sigma[0])))
    x, before, last_width = noise, None, math.inf
    for i, t in enumerate(steps_at):
        clean = denoise(x, t, i)
        (a, s), (a_next, s_next) = levels[i : i + 2]
        if s_next == 0:
            return clean
        direction, width = clean, math.inf
        if a > 1e-6:
            width = math.log(a_next / s_next) - math.log(a / s)  # half log-SNR
            if scheduler == "dpm" and before is not None and last_width > 0:
                weight = width / (2 * last_width)  # 0 after a step that started from pure noise
                direction = (1 + weight) * clean - weight * before
        kept: float = s_next
        fresh: torch.Tensor | float = 0.0
        if renewal is not None:
            renewed = renewal.eta * (s_next / s) * math.sqrt(max(1 - (a / a_next) ** 2, 0.0))
            kept, fresh = math.sqrt(max(s_next**2 - renewed**2, 0.0)), renewed * renewal.draw()
        # a_next x0 + s_next e with e from x and x0: DDIM, and DPM-Solver++ once x0 is extrapolated
        x = a_next * direction + kept * (x - a * direction) / s + fresh
        before, last_width = clean, width
    return x
