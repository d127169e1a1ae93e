"""The numerics of explicit surface sampling against float64, brute force and finite differences."""

import math

import pytest
import torch

from gdtool.fields.neural import surface_sampling as ss
from gdtool.fields.neural.networks import ENCODED, MaterialNetwork, SdfNetwork, encode


def exact_alpha(f0, f1, s):
    """1 - sigmoid(s f1) / sigmoid(s f0) by mpmath."""
    from mpmath import exp, mp, mpf

    mp.dps = 60
    a, b = mpf(float(f0)) * mpf(float(s)), mpf(float(f1)) * mpf(float(s))
    return float(max(1 - (1 + exp(-a)) / (1 + exp(-b)), 0))


@pytest.mark.parametrize("sharpness", [1.0, 20.0, 1e3, 1e4, 1e6])
def test_neus_alpha_against_mpmath(sharpness):
    pairs = [
        (0.1, 0.05),
        (0.02, -0.02),
        (0.0, 0.0),
        (0.0, -0.01),
        (-0.01, -0.02),
        (-0.3, -0.4),
        (-0.4, -0.3),
        (0.3, 0.3),
        (1e-4, -1e-4),
    ]
    f0, f1 = (torch.tensor(x, dtype=torch.float32) for x in zip(*pairs, strict=True))
    alpha = ss.neus_alpha(f0, f1, sharpness)
    expected = torch.tensor([exact_alpha(a, b, sharpness) for a, b in zip(f0, f1, strict=True)])
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert (alpha - expected).abs().max() < 4e-5


def test_alpha_gradient_is_finite_everywhere():
    f = torch.tensor([0.0, 1e-9, -1e-9, 1.0, -1.0], requires_grad=True)
    for s in (1.0, 1e3, 1e6):
        (grad,) = torch.autograd.grad(ss.neus_alpha(f[:, None], f[None, :], s).sum(), f)
        assert torch.isfinite(grad).all()


def test_alpha_gradcheck():
    f0 = torch.tensor([0.05, 0.01, -0.01], dtype=torch.float64, requires_grad=True)
    f1 = torch.tensor([0.02, -0.02, -0.03], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda a, b: ss.neus_alpha(a, b, 40.0), (f0, f1))


def test_weights_sum_to_one_through_a_wall():
    t = torch.linspace(0, 1, 65, dtype=torch.float64)
    weights = ss.neus_weights((0.5 - t)[None], 1e3)
    assert abs(float(weights.sum()) - 1) < 1e-9
    assert abs(float((weights[0] * (t[1:] + t[:-1]) / 2).sum()) - 0.5) < 1e-3


def test_first_crossing_equals_brute_force_on_adversaries():
    nan = math.nan
    rows = [
        [1, 0, -1, 1],
        [0, -1, 0, -1],
        [1, 1, 1, 1],
        [-1, -1, -1, -1],
        [-1, 1, 1, -1],
        [-1, 0, 0, 0],
        [1, nan, -1, -1],
        [0, 0, 0, -0.1],
    ]
    found, idx = ss.first_crossing(torch.tensor(rows, dtype=torch.float32))
    for row, hit, k in zip(rows, found, idx, strict=True):
        expected = next((i for i in range(3) if row[i] >= 0 > row[i + 1]), None)
        assert bool(hit) == (expected is not None)
        assert int(k) == (expected or 0)


def test_secant_is_exact_on_a_plane_and_second_order_on_a_sphere():
    t0, t1 = torch.tensor([0.2], dtype=torch.float64), torch.tensor([0.6], dtype=torch.float64)
    assert float(ss.secant_root(t0, t1, 0.45 - t0, 0.45 - t1)) == pytest.approx(0.45, abs=1e-12)
    errors = []
    for width in (0.08, 0.04):
        # A ray past a sphere's centre at distance 0.3, radius 0.5: it enters at t = 0.6 (0.4 before the middle, at 1).
        def f(t):
            return torch.sqrt((t - 1) ** 2 + 0.09) - 0.5

        a, b = (
            torch.tensor([0.6 - 0.3 * width], dtype=torch.float64),
            torch.tensor([0.6 + 0.7 * width], dtype=torch.float64),
        )
        errors.append(abs(float(ss.secant_root(a, b, f(a), f(b))) - 0.6))
    assert errors[1] < 0.3 * errors[0]


def test_median_of_cdf_is_biased_at_low_sharpness_and_close_at_high():
    """The median of the CDF misses by up to 0.37 of the interval at s = 20 and 0.02 at s = 300."""
    worst = {}
    width = 3 / 64
    for sharpness in (20.0, 300.0):
        misses = []
        for root in torch.linspace(0.1, 0.9, 17, dtype=torch.float64):
            t = width * torch.linspace(0, 1, 8, dtype=torch.float64)[None]
            misses.append(abs(float(ss.median_of_cdf(t, width * root - t, sharpness)) / width - float(root)))
        worst[sharpness] = max(misses)
    assert worst[300.0] < 0.04
    assert 0.3 < worst[20.0] < 0.5


def test_implicit_points_move_with_the_field():
    """Growing a sphere by dr moves the point where a ray meets it by -dr / (n.v) along the ray."""
    radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    direction = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    point = torch.tensor([[0.3, 0.0, 0.4]], dtype=torch.float64)
    value, gradient = point.norm(dim=-1) - radius, point / point.norm(dim=-1, keepdim=True)
    moved = ss.implicit_points(point, direction, value, gradient)
    assert torch.allclose(moved, point)
    (slope,) = torch.autograd.grad(moved[0, 2], radius)
    assert float(slope) == pytest.approx(0.5 / 0.4)  # z = sqrt(r^2 - 0.09), dz/dr = r / z


def test_unit_of_zero_has_a_finite_gradient():
    v = torch.zeros(2, 3, requires_grad=True)
    (grad,) = torch.autograd.grad(ss.unit(v).sum(), v)
    assert torch.isfinite(grad).all()


def test_encoding_in_float32_matches_float64():
    points = torch.linspace(-1, 1, 4001, dtype=torch.float64)[:, None].expand(-1, 3)
    exact = encode(points)
    assert exact.shape[-1] == ENCODED
    # The float32 argument itself is rounded; encode the rounded points exactly.
    single = points.float()
    assert (encode(single).double() - encode(single.double())).abs().max() < 3e-7


def test_sdf_network_starts_as_a_sphere():
    torch.manual_seed(0)
    network = SdfNetwork(radius=0.4)
    points = torch.randn(2000, 3)
    points = points / points.norm(dim=-1, keepdim=True) * torch.linspace(0.1, 1.0, 2000)[:, None]
    value, gradient = network.with_gradient(points, create_graph=False)
    assert (value - (points.norm(dim=-1) - 0.4)).abs().mean() < 0.15
    assert (value[points.norm(dim=-1) < 0.15] < 0).all()
    assert (value[points.norm(dim=-1) > 0.9] > 0).all()
    assert ((gradient * points).sum(-1) > 0).all()


def test_material_network_stays_in_range():
    torch.manual_seed(0)
    out = MaterialNetwork()(torch.randn(100, 3) * 3).detach()
    assert out.shape == (100, 6)
    assert float(out.min()) >= 0
    assert float(out.max()) <= 1
