"""Check closed-form shading against quadrature of both BRDFs, and its values and gradients at extreme inputs."""

from __future__ import annotations

import math

import pytest
import torch

from gdtool.shading.bsdf import brdf as models
from gdtool.shading.bsdf.closed_form import shade, shade_parts
from gdtool.shading.bsdf.sg import SphericalGaussians, evaluate, normalize

N = torch.tensor([0.0, 0.0, 1.0])


def direction(degrees: float, azimuth: float = 0.0) -> torch.Tensor:
    a, b = math.radians(degrees), math.radians(azimuth)
    return torch.tensor([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)])


def light(axis: torch.Tensor, sharpness: float, amplitude: float = 1.0) -> SphericalGaussians:
    return SphericalGaussians(
        axis[None], torch.tensor([sharpness], dtype=axis.dtype), torch.full((1, 3), amplitude, dtype=axis.dtype)
    )


def quadrature(view, albedo, roughness, metallic, lights, kind="gltf", rings=240, spokes=160, around=None):
    """Integrate the diffuse and the specular part of the exact BRDF over light directions, in float64.

    around: axis of the polar grid, that of the sharpest lobe.
    """
    dtype = torch.float64
    # cos θ from a power warp about the mirror direction, so that sharp lobes are resolved
    u = (torch.arange(rings, dtype=dtype) + 0.5) / rings
    drop = 2 * u**4
    weight = 8 * u**3 / rings * (2 * math.pi / spokes)
    phi = (torch.arange(spokes, dtype=dtype) + 0.5) * 2 * math.pi / spokes
    mu, ring = 1 - drop, torch.sqrt(drop * (2 - drop))
    local = torch.stack(
        [ring[:, None] * phi.cos(), ring[:, None] * phi.sin(), mu[:, None].expand(-1, spokes)], -1
    ).reshape(-1, 3)
    pole = normalize(around.to(dtype))
    helper = torch.tensor([0.0, 1.0, 0.0], dtype=dtype)
    x = normalize(torch.linalg.cross(helper, pole))
    y = torch.linalg.cross(pole, x)
    toward = local[:, :1] * x + local[:, 1:2] * y + local[:, 2:] * pole
    w = weight[:, None].expand(-1, spokes).reshape(-1)
    v = view.to(dtype)
    h = normalize(toward + v)
    n_l = toward[:, 2].clamp_min(0)
    a, r, m = (torch.as_tensor(t, dtype=dtype) for t in (albedo, roughness, metallic))
    f0 = models.f0_of(a, m, 0.04)
    diffuse, specular = models.reflectance(
        kind, a, r, m, f0, n_l, v[2].expand_as(n_l), h[:, 2], (h * v).sum(-1).clamp(0, 1)
    )
    radiance = evaluate(lights.to(dtype), toward) * (n_l * w)[:, None]
    return (diffuse * radiance).sum(0), (specular * radiance).sum(0)


@pytest.mark.parametrize("kind", ["gltf", "paper"])
@pytest.mark.parametrize("sharpness", [1.0, 20.0, 200.0])
@pytest.mark.parametrize("angle", [0.0, 40.0, 70.0])
def test_diffuse_against_quadrature(kind, sharpness, angle):
    lights, view = light(direction(30.0, 100.0), sharpness), direction(angle)
    albedo = torch.tensor([0.8, 0.4, 0.1])
    got, _ = shade_parts(N, view, albedo, torch.tensor(0.5), torch.tensor(0.0), lights, kind)
    exact, _ = quadrature(view, albedo, 0.5, 0.0, lights, kind, around=lights.axes[0])
    # Cosine-weighted averages of the angle-dependent factors: exact for uniform light, within this for one lamp.
    assert torch.allclose(got.double(), exact, rtol=0.12 if kind == "paper" else 0.03)


# Relative L1 error of the specular lobe over lamps around the mirror direction, worst of three sharpnesses, by
# (roughness, view angle): measured, frozen with 5 % slack.
FROZEN = {
    (0.1, 0): 0.095,
    (0.3, 0): 0.2,
    (0.5, 0): 0.113,
    (1.0, 0): 0.109,
    (0.1, 60): 0.077,
    (0.3, 60): 0.143,
    (0.5, 60): 0.156,
    (1.0, 60): 0.272,
}


def specular_error(roughness: float, angle: float, sharpness: float) -> float:
    view = direction(angle)
    errors, total = 0.0, 0.0
    for tilt in (-40.0, -15.0, 0.0, 10.0, 25.0):
        for side in (180.0, 150.0):
            lights = light(direction(max(angle + tilt, 0.0), side), sharpness)
            _, got = shade_parts(N, view, torch.ones(3), torch.tensor(roughness), torch.tensor(1.0), lights)
            around = direction(angle, 180.0) if 2 / roughness**4 > sharpness else lights.axes[0]
            _, exact = quadrature(view, torch.ones(3), roughness, 1.0, lights, around=around)
            errors += abs(float(got[0]) - float(exact[0]))
            total += float(exact[0])
    return errors / total


@pytest.mark.parametrize("roughness, angle", list(FROZEN))
def test_specular_error_is_no_worse_than_measured(roughness, angle):
    worst = max(specular_error(roughness, float(angle), s) for s in (3.0, 30.0, 250.0))
    assert worst <= 1.05 * FROZEN[roughness, angle]


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.6, 1.0])
@pytest.mark.parametrize("angle", [0.0, 45.0, 75.0])
def test_furnace_of_the_specular_lobe(roughness, angle):
    """Under uniform light of 1 a white metal reflects at most 1, up to the error of the lobe's fit."""
    uniform = light(N, 0.0)
    _, got = shade_parts(N, direction(angle), torch.ones(3), torch.tensor(roughness), torch.tensor(1.0), uniform)
    assert 0.3 < float(got[0]) <= 1.06


def test_white_lambert_under_uniform_light_is_white():
    diffuse, _ = shade_parts(N, N, torch.ones(3), torch.tensor(1.0), torch.tensor(0.0), light(N, 0.0), f0=0.0)
    assert float(diffuse[0]) == pytest.approx(1.0, abs=2e-4)


def test_linear_in_the_light_and_independent_of_the_frame():
    generator = torch.Generator().manual_seed(0)
    axes = normalize(torch.randn(5, 3, generator=generator))
    lights = SphericalGaussians(
        axes, torch.tensor([0.5, 3.0, 20.0, 90.0, 300.0]), torch.rand(5, 3, generator=generator)
    )
    view = direction(35.0)
    maps = (torch.tensor([0.7, 0.3, 0.2]), torch.tensor(0.4), torch.tensor(0.6))
    whole = shade(N, view, *maps, lights)
    parts = sum(
        shade(
            N,
            view,
            *maps,
            SphericalGaussians(lights.axes[i : i + 1], lights.sharpness[i : i + 1], lights.amplitudes[i : i + 1]),
        )
        for i in range(5)
    )
    assert torch.allclose(whole, parts, rtol=1e-5)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=generator))
    turned = shade(turn @ N, turn @ view, *maps, SphericalGaussians(axes @ turn.T, lights.sharpness, lights.amplitudes))
    assert torch.allclose(whole, turned, rtol=1e-4)
    swapped = shade(
        N, view, maps[0].flip(0), *maps[1:], SphericalGaussians(axes, lights.sharpness, lights.amplitudes.flip(1))
    )
    assert torch.allclose(whole.flip(0), swapped, rtol=1e-6)


@pytest.mark.parametrize("kind", ["gltf", "paper"])
def test_finite_and_never_negative_at_extreme_inputs(kind):
    normals = torch.stack([N, torch.zeros(3), -N, direction(89.9999)])
    views = torch.stack([N, direction(90.0), direction(120.0), -N])
    axes = torch.stack([N, -N, direction(90.0), -direction(120.0)])
    normal, view, roughness, sharpness, axis = (
        t.reshape(-1) for t in torch.meshgrid(*(torch.arange(n) for n in (4, 4, 4, 6, 4)), indexing="ij")
    )
    roughness, sharpness = (
        torch.tensor([0.0, 1e-12, 0.045, 1.0])[roughness],
        torch.tensor([0.0, 1e-30, 1e-8, 1.0, 1e4, 1e10])[sharpness],
    )
    count = len(normal)
    tensors = [
        normals[normal],
        torch.tensor([0.0, 0.5, 1.0]).expand(count, 3).clone(),
        roughness.clone(),
        torch.full((count,), 0.5),
        axes[axis][:, None],
        sharpness[:, None].clone(),
        torch.ones(count, 1, 3),
    ]
    tensors = [t.detach().requires_grad_() for t in tensors]
    # One light a point: lights broadcast like everything else.
    lights = SphericalGaussians(tensors[4], tensors[5], tensors[6])
    value = shade(tensors[0], views[view], *tensors[1:4], lights, kind)
    assert torch.isfinite(value).all()
    assert (value >= 0).all()
    value.sum().backward()
    for t in tensors:
        bad = ~torch.isfinite(t.grad).reshape(count, -1).all(1)
        assert not bad.any(), (
            normals[normal[bad]][0],
            views[view[bad]][0],
            roughness[bad][0],
            sharpness[bad][0],
            axes[axis[bad]][0],
        )


def test_a_zero_normal_is_black():
    assert not shade(torch.zeros(3), N, torch.ones(3), torch.tensor(0.5), torch.tensor(0.5), light(N, 3.0)).any()


def test_gradcheck_in_float64():
    generator = torch.Generator().manual_seed(1)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    axes = normalize(random(2, 3) - 0.3).requires_grad_()
    sharpness, amplitudes = (1 + 20 * random(2)).requires_grad_(), random(2, 3).requires_grad_()
    normal, view = normalize(random(3)).requires_grad_(), normalize(random(3))
    albedo, roughness, metallic = (
        random(3).requires_grad_(),
        (0.2 + 0.6 * random(1)[0]).requires_grad_(),
        random(1)[0].requires_grad_(),
    )

    def function(n, a, r, m, p, s, mu):
        return shade(n, view, a, r, m, SphericalGaussians(p, s, mu))

    assert torch.autograd.gradcheck(function, (normal, albedo, roughness, metallic, axes, sharpness, amplitudes))


def test_visibility_and_fresnel_at_their_ends():
    one = torch.tensor(1.0)
    for kind in ("gltf", "paper"):
        for r in (0.0, 0.5, 1.0):
            values = models.visibility(
                kind, torch.tensor(r), torch.tensor([0.0, 1.0, 1.0 + 1e-7, 0.0]), torch.tensor([0.0, 1.0, 1.0, 1.0])
            )
            assert torch.isfinite(values).all()
            assert (values > 0).all()
            # At cosines of 1 there is no masking, which leaves 1/4.
            assert float(values[1]) == pytest.approx(0.25, rel=1e-6)
    f0 = torch.tensor([0.04, 0.5, 1.0])
    assert torch.equal(models.fresnel(f0, one * (1 + 1e-7)), f0)
    assert torch.allclose(models.fresnel(f0, one * 0), torch.ones(3))
