"""Sweeps of spherical Gaussians: integral, product, hemisphere, cosine. λ from 0 and 1e-45 to float32's
largest."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdtool.shading.bsdf import sg
from tests.stress.references import ANGLES, SHARPNESS, ULP, product_of_lobes, ring_integrals, sphere_integral

settings.register_profile("stress", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("stress")

GAPS = (
    0.0,
    1e-8,
    1e-6,
    1e-4,
    1e-3,
    0.01,
    0.1,
    0.5,
    1.0,
    1.5,
    math.pi / 2,
    2.0,
    3.0,
    math.pi - 1e-3,
    math.pi - 1e-6,
    math.pi,
)


def test_integral_over_the_sphere_is_within_four_ulp():
    values = torch.tensor(SHARPNESS, dtype=torch.float32)
    exact = np.array([sphere_integral(float(x)) for x in values])
    got = sg.integral(values).double().numpy()
    # A denormal result has fewer digits than four units of the last place of a normal one.
    assert (np.abs(got - exact) <= np.maximum(4 * ULP * exact, 2.0**-149)).all()
    assert float(sg.integral(torch.tensor(math.inf))) == 0.0


@settings(max_examples=300)
@given(st.floats(0, 1e10, width=32))
def test_integral_at_any_sharpness(value):
    assert abs(float(sg.integral(torch.tensor(value))) / sphere_integral(value) - 1) <= 4 * ULP


def check_product(p1: torch.Tensor, s1: float, p2: torch.Tensor, s2: float) -> None:
    a, b = torch.tensor(s1), torch.tensor(s2)
    axis, sharpness, exponent = (x.double().numpy() for x in sg.product(p1, a, p2, b))
    direction, length, drop = product_of_lobes(p1.double().numpy(), a, p2.double().numpy(), b)
    total, length, drop = float(a) + float(b), float(length), float(drop)
    assert np.isfinite(axis).all()
    assert math.isfinite(sharpness)
    assert exponent <= 0
    assert np.linalg.norm(axis) < 1 + 1e-6
    assert abs(sharpness - length) <= 2e-6 * max(total, 1e-20), (s1, s2)
    # The amplitude exp(exponent), relative while float32 can hold it, where its logarithm is
    # moderate.
    if drop > -80:
        assert abs(exponent - drop) <= 2e-6 * max(1.0, abs(drop)), (s1, s2)
    if length > 1e-2 * total > 1e-20:
        assert np.abs(axis - np.array([float(x) for x in direction])).max() < 2e-5, (s1, s2)


@pytest.mark.parametrize("gap", GAPS)
def test_product_against_sixty_digits(gap):
    p1, p2 = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([math.sin(gap), 0.0, math.cos(gap)])
    for s1, s2 in itertools.product((0.0, 1e-8, 1e-3, 1.0, 50.0, 1e4, 2e8), (1e-8, 0.5, 50.0, 1e6, 2e8)):
        check_product(p1, s1, p2, s2)


@pytest.mark.slow
@pytest.mark.parametrize("gap", GAPS)
def test_product_against_sixty_digits_on_the_whole_grid(gap):
    generator = torch.Generator().manual_seed(int(gap * 1000))
    for s1, s2 in itertools.combinations_with_replacement(10.0 ** np.arange(-8, 11), 2):
        pole = sg.normalize(torch.randn(3, generator=generator, dtype=torch.float64))
        side = sg.normalize(torch.linalg.cross(pole, torch.randn(3, generator=generator, dtype=torch.float64)))
        check_product(pole.float(), s1, (math.cos(gap) * pole + math.sin(gap) * side).float(), s2)


def test_product_of_antipodal_equal_lobes_is_flat():
    p = torch.tensor([0.0, 0.0, 1.0])
    for s in (1e-8, 1.0, 1e4, 1e10):
        _, sharpness, exponent = sg.product(p, torch.tensor(s), -p, torch.tensor(s))
        assert float(sharpness) <= 2e-6 * s
        assert float(exponent) == pytest.approx(-2 * s, rel=1e-6)


def check_integrals(value: float, angles: np.ndarray) -> None:
    cosine = torch.tensor(np.cos(angles), dtype=torch.float32)
    s = torch.full((len(angles),), value, dtype=torch.float32)
    exact, half = ring_integrals(float(s[0]), cosine.double().numpy())
    peak = ring_integrals(float(s[0]), np.array([1.0]))[0][0]
    got, got_half = sg.cosine_integral(s, cosine).double().numpy(), sg.hemisphere_integral(s, cosine).double().numpy()
    assert (got >= 0).all(), value
    assert np.abs(got - exact).max() <= 2e-3 * peak, value
    assert (got_half >= 0).all(), value
    assert np.abs(got_half - half).max() <= 5e-3 * sphere_integral(float(s[0])), value


@pytest.mark.parametrize("value", [0.0, 1e-8, 1e-3, 0.1, 0.499, 0.501, 1.0, 3.0, 10.0, 30.0, 1e3, 1e6, 1e10])
def test_hemisphere_and_cosine_against_quadrature(value):
    check_integrals(value, ANGLES[::4])


@pytest.mark.slow
@pytest.mark.parametrize("value", [x for x in SHARPNESS if x <= 1e10])
def test_hemisphere_and_cosine_against_quadrature_at_all_angles(value):
    check_integrals(value, ANGLES)


@pytest.mark.parametrize("value", SHARPNESS)
def test_rounding_of_hemisphere_and_cosine(value):
    """float32 against the same formula in float64, on the scale of the peak."""
    c = torch.tensor(np.cos(ANGLES), dtype=torch.float32)
    for function in (sg.cosine_integral, sg.hemisphere_integral):
        low = function(torch.tensor(value, dtype=torch.float32), c).double()
        high = function(torch.tensor(float(np.float32(value)), dtype=torch.float64), c.double())
        assert torch.isfinite(low).all()
        assert (low >= 0).all()
        assert float((low - high).abs().max() / high.max()) <= 5e-7


@pytest.mark.parametrize("value", [0.0, 1e-8, 1.0, 300.0])
def test_hemispheres_add_up_to_the_sphere(value):
    s, c = torch.tensor(value, dtype=torch.float64), torch.linspace(-1, 1, 41, dtype=torch.float64)
    both = sg.hemisphere_integral(s, c) + sg.hemisphere_integral(s, -c)
    assert torch.allclose(both, sg.integral(s).expand_as(both), rtol=1e-6)


@settings(max_examples=200)
@given(st.floats(0, 1e10, width=32), st.floats(-1, 1, width=32), st.floats(-1, 1, width=32))
def test_cosine_integral_grows_with_the_cosine(value, one, two):
    """A lobe that leans further into the hemisphere gives no less light."""
    low, high = sorted((one, two))
    s = torch.tensor(value)
    at_low, at_high, peak = (float(sg.cosine_integral(s, torch.tensor(x))) for x in (low, high, 1.0))
    assert 0 <= at_low <= at_high + 1e-6 * peak
    assert at_high <= peak * (1 + 1e-6)


@pytest.mark.parametrize("value", [1.0, 1e2, 1e4, 1e6, 1e7, 1e10])
def test_lobes_keep_their_digits_when_sharp(value):
    """Evaluated where exp is between 1 and e⁻⁸: the direction is stored in float32, and its rounding is the
    caller's."""
    p, s = torch.tensor([0.0, 0.0, 1.0]), torch.tensor(value)
    angles = np.minimum(np.linspace(0, 4, 33) / math.sqrt(value), np.pi)
    v = torch.tensor(np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1), dtype=torch.float32)
    exact = sg.lobe(p.double(), s.double(), v.double())
    assert float(((sg.lobe(p, s, v).double() - exact) / exact).abs().max()) <= 2e-6


ADVERSARIES = [
    (value, angle)
    for value in SHARPNESS
    for angle in (0.0, 1e-4, np.pi / 2 - 1e-6, np.pi / 2, np.pi / 2 + 1e-6, 3.0, np.pi)
]


def test_gradients_are_finite_at_every_adversary():
    s = torch.tensor([x for x, _ in ADVERSARIES], dtype=torch.float32, requires_grad=True)
    angle = np.array([x for _, x in ADVERSARIES])
    p = torch.tensor(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1), dtype=torch.float32, requires_grad=True)
    q = torch.tensor([0.0, 0.0, 1.0]).expand(len(s), 3).clone().requires_grad_()
    for name, function in {
        "product axis": lambda: sg.product(p, s, q, s)[0].sum(-1),
        "product sharpness": lambda: sg.product(p, s, q, s)[1],
        "product amplitude": lambda: sg.product(p, s, q, s)[2].exp(),
        "unequal product": lambda: sg.product(p, s, q, 2 * s.clamp_max(1e12))[2].exp(),
        "lobe": lambda: sg.lobe(p, s, q),
        "integral": lambda: sg.integral(s),
        "hemisphere": lambda: sg.hemisphere_integral(s, (p * q).sum(-1)),
        "cosine": lambda: sg.cosine_integral(s, (p * q).sum(-1)),
    }.items():
        value = function()
        assert torch.isfinite(value).all(), name
        for tensor, gradient in zip("spq", torch.autograd.grad(value.sum(), (s, p, q), allow_unused=True), strict=True):
            if gradient is not None:
                bad = ~torch.isfinite(gradient).reshape(len(s), -1).all(1)
                assert not bad.any(), (name, tensor, ADVERSARIES[int(bad.nonzero()[0])])


@pytest.mark.parametrize("low, high", [(0.3, 40.0), (1e-5, 9e-5), (2e-4, 9e-4), (0.45, 0.55)])
def test_gradcheck(low, high):
    s = torch.linspace(low, high, 5, dtype=torch.float64).requires_grad_()
    c = torch.tensor([-0.9, -0.4, 0.01, 0.2, 0.9], dtype=torch.float64, requires_grad=True)
    for function in (sg.cosine_integral, sg.hemisphere_integral):
        # Steps smaller than the stretches between the places where the form changes.
        assert torch.autograd.gradcheck(function, (s, c), eps=low * 1e-4, atol=1e-4, rtol=1e-3)
    assert torch.autograd.gradcheck(sg.integral, (s,), eps=low * 1e-4, atol=1e-4, rtol=1e-3)
    p, q = (
        sg.normalize(torch.tensor(v, dtype=torch.float64)).requires_grad_()
        for v in ([0.3, -0.5, 0.8], [-0.2, 0.9, 0.1])
    )
    assert torch.autograd.gradcheck(
        lambda a, b, t: sg.product(a, t, b, 2 * t), (p, q, s[0].detach().requires_grad_()), atol=1e-4, rtol=1e-3
    )
