"""The paper's networks: a fitted sphere, a field that starts inside out, bfloat16 beside float32, and the end of a
budget."""

import numpy as np
import pytest
import torch

from gdtool.fields.neural.fit import Pixels, Schedule, fit_distances, one_cycle, start, train
from gdtool.fields.neural.networks import FREQUENCIES, SdfNetwork
from gdtool.fields.neural.paper import closest_approach

RADIUS = 0.3


def ball(count):
    """Points in the box and their distances to a sphere of another radius than the one networks start as."""
    points = torch.rand(count, 3) * 1.2 - 0.6
    return points, points.norm(dim=-1) - RADIUS


def on_sphere(count=500):
    points = np.random.default_rng(0).standard_normal((count, 3))
    return torch.as_tensor(RADIUS * points / np.linalg.norm(points, axis=1, keepdims=True), dtype=torch.float32)


def fitted(steps=150, half_share=0.0, spent=lambda: 0.0, inside_out=False):
    fit = start(0, "cpu")
    if inside_out:
        with torch.no_grad():
            fit.sdf.last.weight.neg_()
            fit.sdf.last.bias.neg_()
    torch.manual_seed(1)
    fit_distances(fit, ball, steps, 512, lambda n, _: range(n), spent, half_share)
    with torch.no_grad():
        return fit, fit.sdf(on_sphere())


def test_a_field_that_starts_inside_out_ends_as_the_other_does():
    fit, values = fitted(inside_out=True)
    assert values.abs().mean() < 0.01
    with torch.no_grad():
        assert fit.sdf(torch.zeros(1, 3)) < -0.1
        assert fit.sdf(torch.full((1, 3), 0.5)) > 0.3


def test_bfloat16_layers_agree_with_float32():
    """As near to the sphere, to a quarter, where the fit only ends in float32; within 0.02 evaluated in bfloat16."""
    full, values = fitted()
    _, half = fitted(half_share=0.6)
    assert half.abs().mean() < 1.25 * values.abs().mean() < 0.01
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        low = full.sdf(on_sphere()).float()
    assert (low - values).abs().max() < 0.02
    assert not torch.equal(low, values)


def test_a_spent_budget_ends_the_schedule_at_a_small_rate():
    seen = []

    def spent():
        seen.append(len(seen) / 10)
        return seen[-1]

    fit, values = fitted(steps=10_000, spent=spent)
    assert len(seen) == 11
    assert torch.isfinite(values).all()
    assert torch.equal(fit.sdf.window, torch.ones_like(fit.sdf.window))
    assert one_cycle(0.0) < 0.02
    assert one_cycle(0.1) == 1.0
    assert one_cycle(1.0) == pytest.approx(0.0, abs=1e-9)


def test_only_the_first_frequencies_are_let_through():
    sdf = SdfNetwork()
    sdf.show_frequencies(2.5)
    assert sdf.window[:3].tolist() == [1, 1, 1]
    assert sdf.window[3:15].tolist() == [1] * 6 + [0.5] * 3 + [0] * 3
    sdf.show_frequencies(FREQUENCIES)
    assert (sdf.window == 1).all()


def test_networks_run_wherever_their_parameters_are():
    """Shapes and devices without arithmetic: a tensor made on the processor by mistake would raise."""
    sdf = SdfNetwork().to("meta")
    value, gradient = sdf.with_gradient(torch.empty(7, 3, device="meta"))
    assert value.device.type == gradient.device.type == "meta"
    assert gradient.shape == (7, 3)
    sdf.show_frequencies(4)
    assert sdf.window.device.type == "meta"


def test_rays_that_miss_are_watched_where_they_pass():
    vertices = on_sphere(4000).numpy()
    origins, directions = np.array([[0.35, 0.0, 2.0], [0.0, 0.4, 2.0]]), np.array([[0.0, 0, -1], [0.0, 0, -1]])
    along = closest_approach(origins, directions, np.full(2, 1.3), np.full(2, 2.7), vertices)
    assert along == pytest.approx([2.0, 2.0], abs=0.1)


def test_volume_start_and_surface_steps_follow_one_another_without_depth():
    points = on_sphere(200) * torch.tensor([1.5, 1.5, 0.0])
    origins, directions = points + torch.tensor([0.0, 0, 2]), torch.tensor([[0.0, 0, -1]]).expand(200, 3)
    inside = points.norm(dim=-1) < RADIUS
    normal = torch.cat([points[:, :2], (RADIUS**2 - (points**2).sum(-1, keepdim=True)).clamp_min(0).sqrt()], 1) / RADIUS
    pixels = Pixels(origins, directions, inside, torch.full((200,), 1.4), torch.full((200,), 2.6), {"normal": normal})
    fit, _ = fitted()
    done = train(
        fit,
        pixels,
        Schedule(volume_steps=3, surface_steps=4, batch=64, seed=0, rule="secant", brdf="gltf"),
        track=lambda n, _: range(n),
        spent=lambda: 0.0,
    )
    assert done == 7
    assert {"mask", "normal", "eikonal"} <= set(fit.history[0])
    with torch.no_grad():
        assert fit.sdf(on_sphere()).abs().mean() < 0.03
