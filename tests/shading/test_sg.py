"""Check spherical Gaussians against mpmath and float64 quadrature, over sweeps of sharpness and angle."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch

from gdtool.shading.bsdf import sg

NODES, WEIGHTS = np.polynomial.legendre.leggauss(300)
SHARPNESS = [0.0, 1e-30, 1e-8, 1e-4, 0.01, 0.3, 0.5, 1.0, 3.0, 10.0, 100.0, 1e4, 1e6, 1e8, 1e10]


def axis_at(angle: float) -> torch.Tensor:
    return torch.tensor([np.sin(angle), 0.0, np.cos(angle)])


@pytest.mark.parametrize("value", SHARPNESS)
def test_integral_over_the_sphere(value):
    x = mpmath.mpf(float(np.float32(value)))
    exact = 4 * mpmath.pi if x == 0 else -2 * mpmath.pi * mpmath.expm1(-2 * x) / x
    got = float(sg.integral(torch.tensor(value, dtype=torch.float32)))
    assert abs(got / float(exact) - 1) <= 4 * np.finfo(np.float32).eps


@pytest.mark.parametrize("value", [1.0, 1e4, 1e6, 1e7])
def test_lobe_keeps_float32_accuracy_when_sharp(value):
    angle = np.float32(0.7 / np.sqrt(value))
    p = torch.tensor([0.0, 0.0, 1.0])
    v = torch.tensor([np.sin(np.float64(angle)), 0.0, np.cos(np.float64(angle))], dtype=torch.float64)
    got = float(sg.lobe(p, torch.tensor(value), v.float()))
    # The reference takes the direction as it was stored: that rounding is the caller's.
    exact = float(sg.lobe(p.double(), torch.tensor(value, dtype=torch.float64), v.float().double()))
    assert abs(got / exact - 1) < 1e-6


@pytest.mark.parametrize("gap", [0.0, 1e-8, 1e-4, 0.01, 0.3, 1.5, 3.0, np.pi - 1e-4, np.pi])
def test_product_against_mpmath(gap):
    p1, p2 = axis_at(0.0), axis_at(gap)
    a, b = p1.double().numpy(), p2.double().numpy()
    worst = 0.0
    for s1 in (1e-8, 1e-2, 1.0, 50.0, 1e4, 2e8):
        for s2 in (1e-8, 0.5, 50.0, 2e8):
            axis, sharpness, exponent = sg.product(p1, torch.tensor(s1), p2, torch.tensor(s2))
            with mpmath.workdps(50):
                t1, t2 = mpmath.mpf(float(np.float32(s1))), mpmath.mpf(float(np.float32(s2)))
                norm1, norm2 = (mpmath.sqrt(sum(mpmath.mpf(float(x)) ** 2 for x in v)) for v in (a, b))
                total = [
                    t1 * mpmath.mpf(float(x)) / norm1 + t2 * mpmath.mpf(float(y)) / norm2
                    for x, y in zip(a, b, strict=True)
                ]
                length = mpmath.sqrt(sum(x * x for x in total))
                drop = length - t1 - t2
            scale = float(t1 + t2)
            worst = max(worst, abs(float(sharpness) - float(length)) / scale)
            assert np.isfinite(float(exponent))
            assert float(exponent) <= 0
            # The amplitude exp(exponent): relative while it is not negligible.
            if drop > -30:
                error = abs(float(exponent) - float(drop))
                assert error <= 2e-6 * max(1.0, abs(float(drop))), (s1, s2)
            if float(length) > 1e-3 * scale:
                direction = np.array([float(x / length) for x in total])
                assert np.abs(axis.double().numpy() - direction).max() < 1e-5
    assert worst < 2e-6


def cosine_by_quadrature(sharpness: float, cosine: float, clamped: bool) -> float:
    """Integrate exp(λ(cos θ − 1)) max(0, v·n) in polar coordinates about the axis, in float64.

    clamped: whether the factor is the clamped cosine; otherwise it is the indicator of the hemisphere.
    """
    z, w = NODES, WEIGHTS
    # x = λ (1 − cos θ) cut where the lobe has vanished
    reach = min(2.0, 60.0 / max(sharpness, 1e-9))
    drop = 0.5 * reach * (z + 1)
    mu = 1 - drop
    ring = np.sqrt(np.maximum(drop * (2 - drop), 0))
    across = np.sqrt(max(1 - cosine * cosine, 0.0))
    a, b = mu * cosine, ring * across
    if clamped:
        # ∫ over azimuth of max(0, a + b cos φ), in closed form
        x = np.clip(-a / np.maximum(b, 1e-300), -1, 1)
        phi = np.arccos(x)
        inner = 2 * (a * phi + b * np.sin(phi))
    else:
        inner = 2 * np.arccos(np.clip(-a / np.maximum(b, 1e-300), -1, 1))
    return float((np.exp(-sharpness * drop) * inner * w).sum() * 0.5 * reach)


ANGLES = np.concatenate([np.linspace(0, np.pi, 61), [np.pi / 2 - 1e-6, np.pi / 2 + 1e-6]])


@pytest.mark.parametrize("value", [1e-6, 0.1, 0.49, 0.51, 1.0, 5.0, 10.0, 30.0, 100.0, 1e4])
def test_cosine_and_hemisphere_integrals(value):
    cosine = np.cos(ANGLES)
    s = torch.full((len(ANGLES),), value, dtype=torch.float32)
    c = torch.tensor(cosine, dtype=torch.float32)
    peak = cosine_by_quadrature(value, 1.0, True)
    exact = np.array([cosine_by_quadrature(value, x, True) for x in cosine])
    got = sg.cosine_integral(s, c).double().numpy()
    assert (got >= 0).all()
    assert np.abs(got - exact).max() / peak < 2e-3
    half = np.array([cosine_by_quadrature(value, x, False) for x in cosine])
    assert np.abs(sg.hemisphere_integral(s, c).double().numpy() - half).max() / float(sg.integral(s[0])) < 1.2e-2


@pytest.mark.parametrize("value", SHARPNESS)
def test_float32_rounding_of_the_integrals(value):
    c = torch.linspace(-1, 1, 181)
    for function in (sg.cosine_integral, sg.hemisphere_integral):
        low = function(torch.tensor(value, dtype=torch.float32), c).double()
        high = function(torch.tensor(float(np.float32(value)), dtype=torch.float64), c.double())
        assert torch.isfinite(low).all()
        assert (low >= 0).all()
        # Sharp lobes turn a rounding of the cosine into one of the result: compare on the scale of the peak.
        assert float((low - high).abs().max() / high.max()) < 2e-6


@pytest.mark.parametrize("value", SHARPNESS)
def test_gradients_are_finite_everywhere(value):
    for angle in (0.0, 1e-4, np.pi / 2 - 1e-6, np.pi / 2, 3.0, np.pi):
        p = axis_at(angle).requires_grad_()
        q = torch.tensor([0.0, 0.0, 1.0], requires_grad=True)
        s = torch.tensor(value, dtype=torch.float32, requires_grad=True)
        axis, sharpness, exponent = sg.product(p, s, q, s)
        c = (p * q).sum()
        total = (
            sg.cosine_integral(s, c)
            + sg.hemisphere_integral(s, c)
            + sg.integral(s)
            + sg.lobe(p, s, q)
            + axis.sum()
            + exponent.exp()
        )
        (total + sg.cosine_integral(sharpness, axis[2])).backward()
        for tensor in (p, q, s):
            assert torch.isfinite(tensor.grad).all(), (value, angle)


def test_gradcheck_in_float64():
    s = torch.tensor([0.3, 2.0, 40.0], dtype=torch.float64, requires_grad=True)
    c = torch.tensor([-0.4, 0.2, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(sg.cosine_integral, (s, c))
    assert torch.autograd.gradcheck(sg.hemisphere_integral, (s, c))
