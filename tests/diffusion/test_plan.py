"""Check the cost that --plan predicts without computing values against the cost of small real steps."""

import msgspec
import pytest
import torch
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from gdtool.diffusion.config import PRESETS, Phase
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.model import Model, parameter_count
from gdtool.diffusion.reports.plan import frozen_cost, make_plan, phase_cost, rendering_share, step_cost
from gdtool.diffusion.training.loop import new_state, train_step
from tests.diffusion.test_training import spheres

CONFIG = msgspec.structs.replace(PRESETS["tiny"][0], image_size=32, channels=(32, 64), encoder_width=32)


def measured_step(config, objects, count):
    torch.manual_seed(0)
    model = Model(config).train()
    layout, views = Layout(objects, (0, 1, 2), 2), torch.arange(2)
    rgba = torch.rand(objects, 4, 32, 32)
    noisy = torch.randn(model.latent_shape(layout))
    condition = model.condition_latents(rgba, layout, views)
    with count:
        out = model.predict_clean(noisy, condition, torch.full((objects,), 500), model.encoder(rgba), layout, views)
        (out - noisy).square().mean().backward()
    return model


@pytest.mark.parametrize("checkpointing", [False, True])
def test_flops_are_those_of_a_real_step(checkpointing):
    config = msgspec.structs.replace(CONFIG, gradient_checkpointing=checkpointing)
    counter = FlopCounterMode(display=False)
    measured_step(config, 2, counter)
    planned = step_cost(config, 3, 2, 2, fused=False, dtype=torch.float32)["flops"]
    assert planned == counter.get_total_flops() > 1e8


@pytest.mark.parametrize("checkpointing", [False, True])
def test_memory_is_what_the_profiler_measures(checkpointing):
    """The measured peak is that of the sum over the allocator's events, without the gradients."""
    config = msgspec.structs.replace(CONFIG, gradient_checkpointing=checkpointing)
    profiler = profile(activities=[ProfilerActivity.CPU], profile_memory=True)
    model = measured_step(config, 2, profiler)
    gradients = sum(p.numel() * 4 for p in model.parameters() if p.grad is not None)
    planned = step_cost(config, 3, 2, 2, fused=False, dtype=torch.float32)["bytes"]
    assert planned == pytest.approx(peak_of(profiler) - gradients, rel=0.2)


def peak_of(profiler) -> int:
    live = peak = 0
    for event in sorted(
        (e for e in profiler.profiler.kineto_results.events() if e.name() == "[memory]"), key=lambda e: e.start_ns()
    ):
        live += event.nbytes()
        peak = max(peak, live)
    return peak


@pytest.fixture
def with_vae(tmp_path):
    """Return a configuration with a VAE of Stable Diffusion's structure and a few thousand weights."""
    diffusers = pytest.importorskip("diffusers", reason="needs pip install 'gdtool[hub]'")
    blocks = {"block_out_channels": (8, 8, 8, 8), "norm_num_groups": 4, "latent_channels": 4}
    diffusers.AutoencoderKL(
        down_block_types=("DownEncoderBlock2D",) * 4, up_block_types=("UpDecoderBlock2D",) * 4, **blocks
    ).save_pretrained(tmp_path / "vae")
    return msgspec.structs.replace(
        CONFIG, codec="vae", condition_alpha=False, condition_skip=False, image_size=64, pretrained=str(tmp_path)
    )


def real_and_planned(config, rendering):
    """Measure a train_step of two objects in all six domains, and predict its cost.

    Returns (FLOPs, peak bytes without gradients) twice: measured and planned.
    """
    phase = Phase(domains=6, views=2)
    train = msgspec.structs.replace(
        PRESETS["tiny"][1],
        batch=2,
        precision="float32",
        pure_noise=0.0,
        phases=(phase,),
        tilted=0.0,
        hue=False,
        mirror=False,
        # Every object has an SNR above this.
        pbr_weight=0.1 if rendering else 0.0,
        pbr_snr=-1.0,
    )
    torch.manual_seed(0)
    state, objects = new_state(Model(config).train(), train), spheres(2, config.image_size)
    train_step(state, objects, train, 0, None, "cpu")  # the optimiser's moments are there from now on
    with FlopCounterMode(display=False) as counter:
        train_step(state, objects, train, 0, None, "cpu")
    profiler = profile(activities=[ProfilerActivity.CPU], profile_memory=True)
    with profiler:
        train_step(state, objects, train, 0, None, "cpu")
    weights = parameter_count(state.model)
    planned = phase_cost(config, train, phase, frozen_cost(config), weights, fused=False)
    return (counter.get_total_flops(), peak_of(profiler) - 4 * weights), (
        planned["flops_per_step"],
        planned["activation_bytes"],
    )


@pytest.mark.parametrize("rendering", [False, True])
def test_a_real_training_step_costs_what_is_planned(rendering):
    real, planned = real_and_planned(CONFIG, rendering)
    assert planned[0] == real[0]
    assert planned[1] == pytest.approx(real[1], rel=0.15)


@pytest.mark.parametrize("rendering", [False, True])
def test_a_real_training_step_with_a_vae_costs_what_is_planned(with_vae, rendering):
    real, planned = real_and_planned(with_vae, rendering)
    assert planned[0] == pytest.approx(real[0], rel=0.01)
    assert planned[1] == pytest.approx(real[1], rel=0.15)


def test_objects_with_much_noise_are_not_rendered():
    train = PRESETS["tiny"][1]
    assert (
        rendering_share(CONFIG, train, 3)
        == 0.0
        == rendering_share(CONFIG, msgspec.structs.replace(train, pbr_weight=0.0), 6)
    )
    # the cosine schedule's SNR is 1 half-way
    assert rendering_share(CONFIG, msgspec.structs.replace(train, pbr_snr=1.0, pure_noise=0.6), 6) == pytest.approx(
        0.2, abs=0.01
    )


def test_a_plan_adds_up():
    train = msgspec.structs.replace(
        PRESETS["tiny"][1],
        batch=4,
        accumulate=2,
        steps=10,
        phases=(Phase(share=0.5, domains=1, views=2), Phase(domains=6, views=6)),
    )
    plan = make_plan(CONFIG, train)
    assert plan["weights"] == parameter_count(Model(CONFIG))
    assert plan["weights_bytes"] == 20 * plan["weights"]
    assert [p["steps"] for p in plan["phases"]] == [5, 5]
    assert plan["phases"][1]["objects_at_once"] == 2
    assert plan["phases"][1]["flops_per_step"] > 10 * plan["phases"][0]["flops_per_step"]
    hours = plan["hours"]["H100 80 GB"]
    total = sum(p["steps"] * p["flops_per_step"] for p in plan["phases"])
    assert hours["1"] == pytest.approx(total / (989e12 * plan["utilisation"]) / 3600)
    assert hours["1"] / 8 < hours["8"]


def test_the_command_needs_no_data(gdtool):
    result = gdtool("train", "--plan", "--preset", "tiny", "--json")
    assert result.returncode == 0, result.stderr
    plan = msgspec.json.decode(result.stdout)
    assert plan["weights"] > 1000
    assert set(plan["hours"]["A100 80 GB"]) == {"1", "8", "fits"}
