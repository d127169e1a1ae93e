"""Check noise levels, predictions and samplers on problems with known answers."""

import math

import msgspec
import pytest
import torch

from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.schedule import (
    DATA_VARIANCE,
    alpha_and_sigma,
    clean_from_prediction,
    input_scale,
    loss_weight,
    sample,
    timesteps,
)

CONFIG = ModelConfig()
SD = msgspec.structs.replace(CONFIG, noise_schedule="scaled_linear")


@pytest.mark.parametrize("config", [CONFIG, SD])
def test_levels_are_on_the_unit_circle_and_fall(config):
    a, s = alpha_and_sigma(config)
    torch.testing.assert_close(a**2 + s**2, torch.ones(1000))
    assert (a[1:] < a[:-1]).all()
    assert a[0] > 0.999


def test_cosine_ends_in_pure_noise_and_stable_diffusion_does_not():
    assert alpha_and_sigma(CONFIG)[0][-1] < 1e-6
    # the published schedule's last cumulative product is 0.0047
    assert float(alpha_and_sigma(SD)[0][-1] ** 2) == pytest.approx(0.00466, abs=2e-5)


@pytest.mark.parametrize("prediction", ["x", "v", "epsilon"])
def test_each_prediction_gives_back_the_clean_image(prediction):
    config = msgspec.structs.replace(CONFIG, prediction=prediction)
    clean, noise, a, s = torch.randn(5), torch.randn(5), torch.tensor(0.6), torch.tensor(0.8)
    target = {"x": clean, "epsilon": noise, "v": a * noise - s * clean}[prediction]
    torch.testing.assert_close(clean_from_prediction(config, target, a * clean + s * noise, a, s), clean)


def test_the_shrunk_input_is_the_best_linear_estimate():
    config = msgspec.structs.replace(CONFIG, noisy_input="shrunk")
    generator = torch.Generator().manual_seed(0)
    clean = torch.randn(100_000, generator=generator, dtype=torch.float64) * DATA_VARIANCE**0.5
    noisy = 0.6 * clean + 0.8 * torch.randn(100_000, generator=generator, dtype=torch.float64)
    assert input_scale(config, 0.6, 0.8) == pytest.approx(float((clean * noisy).sum() / noisy.square().sum()), rel=0.02)
    assert input_scale(config, 0.0, 1.0) == 0
    assert input_scale(CONFIG, 0.0, 1.0) == 1


def test_min_snr_weight():
    a = torch.tensor([0.1**0.5, 0.5**0.5, 0.9**0.5, 1.0])
    weight = loss_weight(a, (1 - a * a).clamp_min(0).sqrt(), 5.0, 0.0)
    torch.testing.assert_close(weight, torch.tensor([1 / 9, 1.0, 5.0, 5.0]))
    assert loss_weight(a, (1 - a * a).clamp_min(0).sqrt(), 5.0, 0.5)[0] == 0.5


def test_timesteps_start_at_the_last():
    assert timesteps(CONFIG, 4) == [999, 749, 499, 249]
    assert timesteps(CONFIG, 1) == [999]


@pytest.mark.parametrize("scheduler", ["ddim", "dpm"])
def test_a_known_image_is_reached_exactly(scheduler):
    truth = torch.randn(2, 3)
    out = sample(lambda x, t, i: truth, torch.randn(2, 3), CONFIG, 5, scheduler)
    torch.testing.assert_close(out, truth)


def gaussian_error(scheduler, steps):
    """Return the error of sampling data N(0, 2²), for which the exact flow maps noise z to 2 z.

    The best prediction is E[x_0 | x] = a 4 x / (4 a² + s²).
    """
    a, s = (x.double() for x in alpha_and_sigma(SD))

    def denoise(x, t, i):
        return a[t] * 4 * x / (4 * a[t] ** 2 + s[t] ** 2)

    z = torch.ones(1, dtype=torch.float64)
    start = float((4 * a[-1] ** 2 + s[-1] ** 2).sqrt())  # the flow's own value at the last timestep, not quite 1
    return abs(float(sample(denoise, z * start, SD, steps, scheduler)) - 2.0)


def test_more_steps_come_nearer_and_dpm_is_ahead_of_ddim():
    assert gaussian_error("ddim", 40) < 0.6 * gaussian_error("ddim", 10)
    assert gaussian_error("dpm", 20) < 0.5 * gaussian_error("ddim", 20)
    assert math.isfinite(gaussian_error("dpm", 1))
