"""Check noise levels, predictions and samplers on problems with known answers."""

import math

import msgspec
import pytest
import torch

from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.schedule import (
    DATA_VARIANCE,
    Renewal,
    alpha_and_sigma,
    clean_from_prediction,
    input_scale,
    loss_weight,
    sample,
    timesteps,
)

CONFIG = ModelConfig()
SD = msgspec.structs.replace(CONFIG, noise_schedule="scaled_linear")
WONDER3D = msgspec.structs.replace(
    SD, sampling_spacing="leading", sampling_offset=1, sampling_ends_clean=False, prediction="epsilon"
)


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


def test_leading_timesteps_are_multiples_and_an_offset():
    assert timesteps(WONDER3D, 4) == [751, 501, 251, 1]
    assert timesteps(WONDER3D, 3) == [667, 334, 1]
    assert timesteps(WONDER3D, 50)[:2] == [981, 961]
    assert timesteps(CONFIG, 4, "leading") == [750, 500, 250, 0]
    assert timesteps(WONDER3D, 4, "trailing") == [999, 749, 499, 249]


def test_as_many_leading_timesteps_as_there_are_stay_within_the_schedule():
    assert timesteps(WONDER3D, 1000)[0] == 999
    assert timesteps(WONDER3D, 1000)[-1] == 1


@pytest.mark.parametrize("scheduler", ["ddim", "dpm"])
def test_a_model_may_end_at_the_noise_of_timestep_0(scheduler):
    """With the noise known exactly, every step stays on x = a truth + s noise, so the last is at timestep 0."""
    truth, noise = torch.randn(2, 3), torch.randn(2, 3)
    a, s = alpha_and_sigma(WONDER3D)
    start = a[751] * truth + s[751] * noise
    out = sample(lambda x, t, i: truth, start, WONDER3D, 4, scheduler)
    torch.testing.assert_close(out, a[0] * truth + s[0] * noise)


def test_a_spacing_that_is_not_the_models_own_ends_at_x_0():
    truth = torch.randn(2, 3)
    assert torch.equal(sample(lambda x, t, i: truth, torch.randn(2, 3), WONDER3D, 4, "ddim", "trailing"), truth)


def test_eta_takes_the_posteriors_standard_deviation():
    """One step with eta 1 from x to the end, with x_0 predicted as 0: what is added is the noise of DDPM's posterior.

    Its variance is (1 - a'²) / (1 - a²) (1 - a² / a'²) with a' after the step (Ho et al. 2020, eq. 7).
    """
    a, _ = (x.double() for x in alpha_and_sigma(WONDER3D))
    variance = (1 - a[0] ** 2) / (1 - a[1] ** 2) * (1 - a[1] ** 2 / a[0] ** 2)
    one = torch.ones(1, dtype=torch.float64)
    out = sample(lambda x, t, i: 0 * x, 0 * one, WONDER3D, 1, "ddim", None, Renewal(1.0, lambda: one))
    torch.testing.assert_close(out, variance.sqrt().view(1), rtol=1e-3, atol=0)


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_eta_keeps_the_variance(eta):
    """Predict the true x_0 from any x: at each eta x keeps a truth + s e with e of variance 1, up to the last step."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.full((200_000,), 3.0, dtype=torch.float64)
    a, s = alpha_and_sigma(WONDER3D)
    seen = []

    def denoise(x, t, i):
        seen.append(((x - a[t].double() * truth) / s[t].double()).std())
        return truth

    def draw():
        return torch.randn(truth.shape, generator=generator, dtype=torch.float64)

    sample(denoise, a[751].double() * truth + s[751].double() * draw(), WONDER3D, 4, "ddim", None, Renewal(eta, draw))
    torch.testing.assert_close(torch.stack(seen), torch.ones(4, dtype=torch.float64), rtol=0.01, atol=0)


def test_noise_is_drawn_at_every_step_the_last_one_included():
    draws = []
    renewal = Renewal(1.0, lambda: draws.append(1) or torch.zeros(2))
    sample(lambda x, t, i: x, torch.zeros(2), WONDER3D, 4, "ddim", None, renewal)
    assert len(draws) == 4


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
