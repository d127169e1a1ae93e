"""Sweeps of the fields: NeuS opacity, first crossing, normals of distances, encoding, bfloat16 networks."""

from __future__ import annotations

import math

import mpmath
import msgspec
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdtool.fields.neural import surface_sampling as ss
from gdtool.fields.neural.networks import ENCODED, FREQUENCIES, MaterialNetwork, SdfNetwork, encode

settings.register_profile("stress", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("stress")

VALUES = (0.0, *(sign * x for x in (1e-8, 1e-6, 1e-5, 1e-4, 1e-3, 0.01, 0.1, 0.5, 1.0) for sign in (1, -1)))


def exact_alpha(f0: float, f1: float, s: float) -> float:
    """1 − sigmoid(s f1) / sigmoid(s f0), at least 0, in 60 digits."""
    with mpmath.workdps(60):
        a, b = mpmath.mpf(f0) * mpmath.mpf(s), mpmath.mpf(f1) * mpmath.mpf(s)
        return float(max(1 - (1 + mpmath.exp(-a)) / (1 + mpmath.exp(-b)), 0))


@pytest.mark.parametrize("sharpness", [1.0, 20.0, 300.0, 1e3, 1e4, 1e5, 1e6])
def test_neus_alpha(sharpness):
    """Every pair: zeros, equal values, entering, leaving, and starts inside."""
    f0, f1 = (x.reshape(-1) for x in torch.meshgrid(torch.tensor(VALUES), torch.tensor(VALUES), indexing="ij"))
    alpha = ss.neus_alpha(f0, f1, sharpness).double()
    exact = torch.tensor(
        [exact_alpha(float(a), float(b), sharpness) for a, b in zip(f0, f1, strict=True)], dtype=torch.float64
    )
    assert ((alpha >= 0) & (alpha <= 1)).all()
    worst = int((alpha - exact).abs().argmax())
    assert float((alpha - exact).abs().max()) <= 1e-5, (
        float(f0[worst]),
        float(f1[worst]),
        float(alpha[worst]),
        float(exact[worst]),
    )
    x, y = f0.clone().requires_grad_(), f1.clone().requires_grad_()
    for gradient in torch.autograd.grad(ss.neus_alpha(x, y, sharpness).sum(), (x, y)):
        assert torch.isfinite(gradient).all()


def test_neus_alpha_gradcheck():
    f0 = torch.tensor([0.05, 0.01, -0.01, 0.02], dtype=torch.float64, requires_grad=True)
    f1 = torch.tensor([0.02, -0.02, -0.03, -1.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: ss.neus_alpha(a, b, 40.0), (f0, f1))


@settings(max_examples=200)
@given(st.lists(st.floats(-1, 1, width=32), min_size=2, max_size=64), st.floats(1, 1e6))
def test_neus_weights_are_shares_of_one(values, sharpness):
    weights = ss.neus_weights(torch.tensor([values]), sharpness)
    assert torch.isfinite(weights).all()
    assert (weights >= 0).all()
    assert float(weights.sum()) <= 1 + 1e-5


def brute_force_crossing(values: list[float]) -> int | None:
    return next((i for i in range(len(values) - 1) if values[i] >= 0 and values[i + 1] < 0), None)


@settings(max_examples=150)
@given(
    st.integers(2, 64).flatmap(
        lambda n: st.lists(
            st.one_of(
                st.sampled_from([0.0, -0.0, 1.0, -1.0, 1e-45, -1e-45, math.nan, math.inf, -math.inf]),
                st.floats(-1, 1, width=32),
            ),
            min_size=n,
            max_size=n,
        )
    )
)
def test_first_crossing(values):
    found, idx = ss.first_crossing(torch.tensor([values], dtype=torch.float32))
    expected = brute_force_crossing(values)
    assert (bool(found[0]), int(idx[0])) == (expected is not None, expected or 0)


# Analytic distances, written with torch so that autograd gives their gradient as it does a network's.
DISTANCES = {
    "sphere": lambda p: p.norm(dim=-1) - 0.4,
    "plane": lambda p: p @ torch.tensor([0.36, 0.48, 0.8], dtype=p.dtype) - 0.1,
    "torus": lambda p: torch.sqrt((p[..., [0, 2]].norm(dim=-1) - 0.3) ** 2 + p[..., 1] ** 2) - 0.1,
    "capsule": lambda p: (
        (
            p - torch.stack([p[..., 0].clamp(-0.3, 0.3), torch.zeros_like(p[..., 0]), torch.zeros_like(p[..., 0])], -1)
        ).norm(dim=-1)
        - 0.2
    ),
}


def normals_of(distance, points: torch.Tensor) -> torch.Tensor:
    p = points.clone().requires_grad_()
    return ss.unit(torch.autograd.grad(distance(p).sum(), p)[0])


@pytest.mark.parametrize("name", DISTANCES)
def test_normals_of_analytic_distances(name):
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.6
    # Where the distance has a kink its normal is not one direction.
    exact = normals_of(DISTANCES[name], points.double())
    near = normals_of(DISTANCES[name], points.double() + 1e-4)
    smooth = (near * exact).sum(-1) > 0.999
    got = normals_of(DISTANCES[name], points).double()
    assert smooth.sum() > 3000
    angle = 2 * torch.asin((0.5 * (got - exact).norm(dim=-1)).clamp_max(1))
    assert float(angle[smooth].max()) <= 1e-5
    assert float((got.norm(dim=-1) - 1).abs().max()) <= 1e-6


def test_normals_on_a_cubes_edges_and_of_zero_gradients():
    points = torch.tensor([[0.4, 0.4, 0.0], [0.4, 0.4, 0.4], [0.0, 0.0, 0.0], [-0.4, 0.1, 0.4]])
    normal = normals_of(lambda p: p.abs().amax(-1) - 0.4, points)
    assert torch.isfinite(normal).all()
    # An edge has one of its faces' normals or a mean of them, so it points outward.
    assert ((normal * points).sum(-1)[[0, 1, 3]] > 0.3).all()
    zero = torch.zeros(4, 3, requires_grad=True)
    value = ss.unit(zero * torch.tensor([0.0, 1.0, 1e-30]))
    assert not value.any()
    assert torch.isfinite(torch.autograd.grad(value.sum(), zero)[0]).all()


def check_encoding(values: np.ndarray) -> None:
    """Against sin and cos of π 2^k x in 40 digits, of the float32 that is encoded."""
    points = torch.tensor(values, dtype=torch.float32)[:, None].expand(-1, 3)
    got = encode(points).double().numpy()
    assert got.shape[1] == ENCODED
    assert not got[:, 3 + 6 * FREQUENCIES :].any()
    with mpmath.workdps(40):
        for row, x in zip(got, points[:, 0].double().numpy(), strict=True):
            for k in range(FREQUENCIES):
                angle = mpmath.pi * mpmath.mpf(float(x)) * 2**k
                assert abs(row[3 + 3 * k] - float(mpmath.sin(angle))) <= 3e-7, (x, k)
                assert abs(row[3 + 3 * FREQUENCIES + 3 * k] - float(mpmath.cos(angle))) <= 3e-7, (x, k)


def test_encoding_at_both_ends_and_between():
    check_encoding(
        np.concatenate(
            [
                [1.0, -1.0, 0.0, 0.5, -0.5, 1e-30, np.nextafter(np.float32(1), 0), np.nextafter(np.float32(-1), 0)],
                np.linspace(-1, 1, 101),
            ]
        )
    )


@pytest.mark.slow
def test_encoding_everywhere():
    check_encoding(np.random.default_rng(0).uniform(-1, 1, 20_000))


def test_encoding_has_the_derivative_of_what_it_encodes():
    p = (torch.rand(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: encode(x, 4), (p,))


def relative(low: torch.Tensor, high: torch.Tensor) -> float:
    return float((low.float() - high).norm() / high.norm())


def test_networks_of_the_fields_in_bfloat16():
    torch.manual_seed(0)
    points = torch.rand(2000, 3) * 2 - 1
    for network in (SdfNetwork(), MaterialNetwork()):
        with torch.no_grad():
            exact = network(points)
            with torch.autocast("cpu", torch.bfloat16):
                assert relative(network(points), exact) <= 2e-2


def test_a_row_with_nan_spoils_no_other_row():
    """oneDNN#5717: with inner sizes that are no multiple of 32, NaN leaked across rows of bfloat16 products."""
    torch.manual_seed(0)
    points = torch.rand(64, 3) * 2 - 1
    points[5] = math.nan
    network = MaterialNetwork()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        bad = torch.isnan(network(points)).any(-1)
    assert bad.nonzero()[:, 0].tolist() == [5]


def test_diffusion_network_in_bfloat16():
    from gdtool.diffusion.config import PRESETS
    from gdtool.diffusion.network.attention import Layout
    from gdtool.diffusion.network.model import Model

    torch.manual_seed(0)
    model = Model(
        msgspec.structs.replace(PRESETS["tiny"][0], channels=(16, 32), head_width=8, encoder_width=16, image_size=16)
    ).eval()
    for p in model.parameters():  # nothing at zero, so that every path shows
        if p.ndim >= 2 and not p.any():
            torch.nn.init.normal_(p, std=0.05)
    layout, views, rgba = Layout(1, (0, 1, 2), 2), torch.tensor([0, 3]), torch.rand(1, 4, 16, 16) * 2 - 1
    noisy = torch.randn(model.latent_shape(layout))

    def clean():
        return model.predict_clean(
            noisy, model.condition_latents(rgba, layout, views), torch.tensor([300]), model.encoder(rgba), layout, views
        )

    with torch.no_grad():
        exact = clean()
        with torch.autocast("cpu", torch.bfloat16):
            assert relative(clean(), exact) <= 2e-2
