"""Define the noise schedule x_t = alpha_t x_0 + sigma_t e, the prediction of x_0, and samplers.

e is standard normal and alpha² + sigma² = 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable

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


def timesteps(config: ModelConfig, steps: int) -> list[int]:
    """Return `steps` decreasing timesteps that start at the last one ("trailing" spacing, Lin et al. 2024)."""
    return [max(round(config.timesteps * (1 - i / steps)) - 1, 0) for i in range(steps)]


def sample(
    denoise: Callable[[torch.Tensor, int, int], torch.Tensor],
    noise: torch.Tensor,
    config: ModelConfig,
    steps: int,
    scheduler: str,
) -> torch.Tensor:
    """Integrate from noise (n, c, h, w) to x_0 in `steps` steps.

    denoise(x, timestep, step's number) predicts x_0. scheduler: "ddim" (Song et al. 2021, deterministic) or "dpm",
    DPM-Solver++(2M) (Lu et al. 2022, algorithm 2).
    """
    alpha, sigma = alpha_and_sigma(config)
    steps_at = timesteps(config, steps)
    x, before, last_width = noise, None, math.inf
    for i, t in enumerate(steps_at):
        clean = denoise(x, t, i)
        if i == len(steps_at) - 1:
            return clean
        a, s = float(alpha[t]), float(sigma[t])
        a_next, s_next = float(alpha[steps_at[i + 1]]), float(sigma[steps_at[i + 1]])
        direction, width = clean, math.inf
        if a > 1e-6:
            width = math.log(a_next / s_next) - math.log(a / s)  # half log-SNR
            if scheduler == "dpm" and before is not None:
                weight = width / (2 * last_width)  # 0 after a step that started from pure noise
                direction = (1 + weight) * clean - weight * before
        # a_next x0 + s_next e with e from x and x0: DDIM, and DPM-Solver++ once x0 is extrapolated
        x = a_next * direction + s_next * (x - a * direction) / s
        before, last_width = clean, width
    return x
