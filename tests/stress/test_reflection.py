"""Sweeps of reflection: Fresnel, G and V, the specular lobe, furnace, reciprocity, and what must not
matter."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdtool.shading.bsdf import brdf as models
from gdtool.shading.bsdf.closed_form import disney_mean, fresnel_loss, shade, shade_parts
from gdtool.shading.bsdf.sg import SphericalGaussians, normalize
from tests.stress.references import NODES, ULP, WEIGHTS, N, direction, light, reflected

settings.register_profile("stress", derandomize=True, deadline=None, print_blob=True)
settings.load_profile("stress")

FROZEN = json.loads(Path(__file__).with_name("frozen.json").read_text())
KINDS = ("gltf", "paper")


def cosines(count: int = 4001) -> torch.Tensor:
    """Even, and dense at both ends, with one beyond 1."""
    u = torch.linspace(0, 1, count)
    return torch.cat([u, u**6, 1 - u**6, torch.tensor([1 + 1e-7, 1e-30, 1e-45])])


def worst_ulp(low: torch.Tensor, high: torch.Tensor) -> float:
    return float(((low.double() - high) / high).abs().max() / ULP)


def test_fresnel():
    for f0 in (0.0, 0.02, 0.04, 0.5, 0.96, 1.0):
        start = torch.tensor([f0])
        value = models.fresnel(start, cosines())
        exact = models.fresnel(start.double(), cosines().double().clamp_max(1))
        assert float(value.min()) >= float(start)
        assert float(value.max()) <= 1
        # Below a dielectric's 0.04 the value goes to 0 with the fifth power of what is left of 1 − c: on the scale of
        # f0's range.
        assert float((value.double() - exact).abs().max()) <= 2 * ULP
        if f0 >= 0.04:
            assert worst_ulp(value, exact) <= 2


@pytest.mark.parametrize("kind", KINDS)
def test_visibility(kind):
    light, v = (x.reshape(-1) for x in torch.meshgrid(cosines(201), cosines(201), indexing="ij"))
    for r in (0.0, 1e-12, 0.045, 0.1, 0.3, 0.7, 1.0):
        roughness = torch.tensor(r)
        value = models.visibility(kind, roughness, light, v)
        assert torch.isfinite(value).all()
        assert (value > 0).all()
        alpha = models.alpha_of(roughness)
        if kind == "gltf":
            exact = models.visibility_gltf(alpha.double(), light.double(), v.double())
        else:
            exact = models.visibility_paper(
                roughness.double().clamp_min(float(torch.tensor(models.MIN_ROUGHNESS))), light.double(), v.double()
            )
        assert worst_ulp(value, exact) <= 4
        assert torch.allclose(value, models.visibility(kind, roughness, v, light), rtol=4 * ULP)  # reciprocal


def test_ndf_is_accurate_and_normalised():
    for r in (0.045, 0.1, 0.3, 0.7, 1.0):
        alpha = models.alpha_of(torch.tensor(r))
        assert worst_ulp(models.ndf(alpha, cosines()), models.ndf(alpha.double(), cosines().double().clamp_max(1))) <= 6
        # ∫ D(h) (n·h) dh = 1; tan² θ = α² x / (1 − x) makes the integrand constant.
        x = (torch.arange(20000, dtype=torch.float64) + 0.5) / 20000
        a2 = alpha.double() ** 2
        c2 = (1 - x) / (1 - x + a2 * x)
        density = a2 / (1 - x + a2 * x) ** 2  # − d(cos²)/dx
        assert float((models.ndf(alpha.double(), c2.sqrt()) * density).mean() * math.pi) == pytest.approx(1, abs=1e-9)


def test_cosine_weighted_means_of_the_diffuse_factors():
    """fresnel_loss and disney_mean against quadrature over the light's hemisphere."""
    u, w = torch.tensor(NODES), torch.tensor(WEIGHTS)
    squared = 0.5 * (u + 1)
    phi = (torch.arange(256, dtype=torch.float64) + 0.5) * 2 * math.pi / 256
    n_l, ring = squared.sqrt(), (1 - squared).sqrt()
    for n_v in (0.0, 0.05, 0.3, 0.7, 1.0):
        l_v = n_l[:, None] * n_v + ring[:, None] * phi.cos() * math.sqrt(1 - n_v * n_v)
        l_h = (0.5 + 0.5 * l_v).clamp(0, 1).sqrt()

        def mean(x):
            return float((x.mean(1) * w).sum() / 2)

        cosine = torch.tensor(n_v, dtype=torch.float64)
        assert float(fresnel_loss(cosine)) == pytest.approx(mean((1 - l_h) ** 5), abs=1.1e-5)
        for r in (0.0, 0.3, 1.0):
            exact = mean(models.disney_diffuse(torch.tensor(r, dtype=torch.float64), n_l[:, None], cosine, l_h))
            assert float(disney_mean(torch.tensor(r, dtype=torch.float64), cosine)) == pytest.approx(exact, rel=0.03)


# The specular lobe
# -----------------------------------------------------------------------------------------------------

ROUGHNESS, VIEWS, LIGHTS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0), (0, 30, 60, 75, 85), (2.0, 10.0, 50.0, 300.0)


def specular_error(kind: str, roughness: float, view_angle: float, sharpness: float, rings: int) -> float:
    """Relative L1 error of a white metal's specular over lamps around the mirror direction."""
    view, errors, total = direction(view_angle), 0.0, 0.0
    for tilt, side in ((-40, 180), (-10, 180), (0, 180), (10, 180), (0, 150), (25, 160)):
        lights = light(direction(max(view_angle + tilt, 0.0), side), sharpness)
        got = shade_parts(N, view, torch.ones(3), torch.tensor(roughness), torch.tensor(1.0), lights, kind)[1]
        exact = reflected(
            view, torch.ones(3), max(roughness, models.MIN_ROUGHNESS), 1.0, lights, kind, rings=rings, spokes=rings
        )[1]
        errors, total = errors + abs(float(got[0]) - float(exact[0])), total + float(exact[0])
    return errors / total


def check_specular(kind: str, roughness: float, view_angle: float, rings: int, lights=LIGHTS) -> None:
    for sharpness in lights:
        frozen = FROZEN["specular"][kind][f"{roughness:g}/{view_angle}/{sharpness:g}"]
        assert specular_error(kind, roughness, view_angle, sharpness, rings) <= 1.05 * frozen + 1e-3, sharpness


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("roughness", (0.05, 0.3, 1.0))
@pytest.mark.parametrize("view_angle", (0, 60))
def test_specular_lobe_against_its_frozen_error(kind, roughness, view_angle):
    check_specular(kind, roughness, view_angle, 128, (2.0, 50.0))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("roughness", ROUGHNESS)
@pytest.mark.parametrize("view_angle", VIEWS)
def test_specular_lobe_against_its_frozen_error_at_512(kind, roughness, view_angle):
    check_specular(kind, roughness, view_angle, 512)


# Furnaces
# ---------------------------------------------------------------------------------------------------------------


def furnace(kind: str, roughness: float, view_angle: float, metallic: float, f0: float = 0.04) -> tuple[float, float]:
    """Diffuse and specular reflectance of white under uniform light of 1, closed form."""
    view = direction(view_angle)
    parts = shade_parts(
        N, view, torch.ones(3), torch.tensor(roughness), torch.tensor(metallic), light(N, 0.0), kind, f0
    )
    return float(parts[0][0]), float(parts[1][0])


def exact_furnace(kind: str, roughness: float, view_angle: float, metallic: float) -> tuple[float, float]:
    parts = reflected(
        direction(view_angle),
        torch.ones(3),
        max(roughness, models.MIN_ROUGHNESS),
        metallic,
        light(N, 0.0),
        kind,
        rings=512,
        spokes=256,
    )
    return float(parts[0][0]), float(parts[1][0])


@pytest.mark.parametrize("kind", KINDS)
def test_a_true_specular_lobe_alone_reflects_at_most_what_arrives(kind):
    for roughness in (0.05, 0.3, 0.6, 1.0):
        for angle in (0.0, 45.0, 75.0, 85.0):
            assert exact_furnace(kind, roughness, angle, 1.0)[1] <= 1.001


@pytest.mark.parametrize("kind", KINDS)
def test_furnace_of_the_closed_forms_against_the_frozen_table(kind):
    """The specular lobe alone (F = 1), and the sum of a white dielectric, whose models are not energy-conserving."""
    for roughness in ROUGHNESS:
        for angle in VIEWS:
            alone, total = FROZEN["furnace"][kind][f"{roughness:g}/{angle}"]
            got = furnace(kind, roughness, float(angle), 1.0)[1]
            assert got == pytest.approx(alone, rel=0.01, abs=1e-3)
            assert sum(furnace(kind, roughness, float(angle), 0.0)) == pytest.approx(total, rel=0.01, abs=1e-3)


def test_what_method_says_of_the_models_sums():
    """glTF's white dielectric at r = .3 reaches 1.15 at 75° and 1.29 at 85°; the paper's at r = 1 1.21 and 1.44."""
    for kind, roughness, angle, wanted in (
        ("gltf", 0.3, 75, 1.15),
        ("gltf", 0.3, 85, 1.29),
        ("paper", 1.0, 75, 1.21),
        ("paper", 1.0, 85, 1.44),
    ):
        assert sum(exact_furnace(kind, roughness, angle, 0.0)) == pytest.approx(wanted, abs=0.01)


# What must not matter
# -----------------------------------------------------------------------------------------------------


def unit_vectors():
    value = st.floats(-1, 1, width=32)
    return (
        st.tuples(value, value, value)
        .filter(lambda v: sum(x * x for x in v) > 0.05)
        .map(lambda v: normalize(torch.tensor(v)))
    )


SCENES = st.fixed_dictionaries(
    {
        "normal": unit_vectors(),
        "view": unit_vectors(),
        "axes": st.tuples(unit_vectors(), unit_vectors(), unit_vectors()),
        "sharpness": st.tuples(*[st.floats(0, 3e3, width=32)] * 3),
        "amplitudes": st.lists(st.floats(0, 8, width=32), min_size=9, max_size=9),
        "albedo": st.tuples(*[st.floats(0, 1, width=32)] * 3),
        "roughness": st.floats(0, 1, width=32),
        "metallic": st.floats(0, 1, width=32),
        "kind": st.sampled_from(KINDS),
    }
)


def lit(scene, lights=None, normal=None, view=None, albedo=None) -> torch.Tensor:
    """float64, so that what is compared is the form and not its rounding near the borders of its clamps."""

    def tensor(x):
        return torch.as_tensor(x, dtype=torch.float64)

    normal, view = (tensor(scene[n] if x is None else x) for n, x in (("normal", normal), ("view", view)))
    return shade(
        normalize(normal),
        normalize(view),
        tensor(scene["albedo"] if albedo is None else albedo),
        tensor(scene["roughness"]),
        tensor(scene["metallic"]),
        lobes(scene) if lights is None else lights,
        scene["kind"],
    )


def lobes(scene) -> SphericalGaussians:
    axes = normalize(torch.stack(scene["axes"]).double())
    return SphericalGaussians(
        axes,
        torch.tensor(scene["sharpness"], dtype=torch.float64),
        torch.tensor(scene["amplitudes"], dtype=torch.float64).reshape(3, 3),
    )


@settings(max_examples=150)
@given(SCENES)
def test_light_adds_up(scene):
    g = lobes(scene)
    whole = lit(scene)
    assert torch.isfinite(whole).all()
    assert (whole >= 0).all()
    parts = sum(
        lit(scene, SphericalGaussians(g.axes[i : i + 1], g.sharpness[i : i + 1], g.amplitudes[i : i + 1]))
        for i in range(3)
    )
    assert torch.allclose(whole, parts, rtol=1e-9, atol=1e-12)
    twice = lit(scene, SphericalGaussians(g.axes, g.sharpness, 1024 * g.amplitudes))
    assert torch.allclose(twice, 1024 * whole, rtol=1e-12)


@settings(max_examples=150)
@given(SCENES, st.integers(0, 10**6))
def test_no_frame_and_no_channel_is_special(scene, seed):
    g = lobes(scene)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))
    turned = lit(
        scene,
        SphericalGaussians(g.axes @ turn.T, g.sharpness, g.amplitudes),
        turn @ scene["normal"].double(),
        turn @ scene["view"].double(),
    )
    whole = lit(scene)
    assert torch.allclose(whole, turned, rtol=1e-6, atol=1e-9)
    order = [2, 0, 1]
    swapped = lit(
        scene,
        SphericalGaussians(g.axes, g.sharpness, g.amplitudes[:, order]),
        albedo=torch.tensor(scene["albedo"])[order],
    )
    assert torch.allclose(whole[order], swapped, rtol=1e-12)


@settings(max_examples=200)
@given(unit_vectors(), unit_vectors(), st.floats(0, 1, width=32), st.floats(0, 1, width=32), st.sampled_from(KINDS))
def test_the_models_are_reciprocal(light_direction, view, roughness, metallic, kind):
    """Both BRDFs, pointwise; not their closed forms, which are evaluated at the mirror direction."""
    light, v = light_direction.double(), view.double()
    h = normalize(light + v)
    r, m, albedo = (torch.tensor(x, dtype=torch.float64) for x in (roughness, metallic, [0.8, 0.4, 0.1]))
    args = models.f0_of(albedo, m, 0.04)

    def value(a, b):
        return torch.cat(
            models.reflectance(kind, albedo, r, m, args, a[2].abs(), b[2].abs(), h[2].abs(), (h * v).sum().clamp(0, 1))
        )

    assert torch.allclose(value(light, v), value(v, light), rtol=1e-12)


def adversaries():
    """Every combination of bad normals, views, roughness, sharpness and lights."""
    normals = torch.stack([N, torch.zeros(3), -N, direction(89.9999), N * 1e-20])
    views = torch.stack([N, direction(90.0), direction(90.0001), direction(120.0), -N])
    axes = torch.stack([N, -N, direction(90.0), direction(90.00006), -direction(120.0), -direction(90.0)])
    roughness, sharpness = (
        torch.tensor([0.0, 1e-12, 0.045, 1.0]),
        torch.tensor([0.0, 1e-38, 1e-8, 1e-4, 1.0, 1e4, 1e7, 1e10, 3e38]),
    )
    n, v, r, s, a = (
        x.reshape(-1)
        for x in torch.meshgrid(
            *(torch.arange(len(t)) for t in (normals, views, roughness, sharpness, axes)), indexing="ij"
        )
    )
    return normals[n], views[v], roughness[r], sharpness[s], axes[a]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("metallic", (0.0, 0.5, 1.0))
@pytest.mark.parametrize("amplitude", (0.0, 1.0, 1e6))
def test_finite_and_never_negative_with_finite_gradients_at_every_adversary(kind, metallic, amplitude):
    normal, view, roughness, sharpness, axis = adversaries()
    count = len(normal)
    tensors = [
        t.clone().requires_grad_()
        for t in (
            normal,
            view,
            torch.tensor([0.0, 0.5, 1.0]).expand(count, 3),
            roughness,
            torch.full((count,), metallic),
            axis[:, None],
            sharpness[:, None],
            torch.full((count, 1, 3), amplitude),
        )
    ]
    value = shade(*tensors[:5], SphericalGaussians(*tensors[5:]), kind)
    assert torch.isfinite(value).all()
    assert (value >= 0).all()
    value.sum().backward()
    for name, t in zip(
        ("normal", "view", "albedo", "roughness", "metallic", "axis", "sharpness", "amplitude"), tensors, strict=True
    ):
        bad = ~torch.isfinite(t.grad).reshape(count, -1).all(1)
        assert not bad.any(), (name, *(x[bad][0].tolist() for x in (normal, view, roughness, sharpness, axis)))


@pytest.mark.parametrize("kind", KINDS)
def test_gradcheck(kind):
    generator = torch.Generator().manual_seed(1)

    def random(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    axes = normalize(random(2, 3) - 0.3).requires_grad_()
    arguments = (
        normalize(random(3)).requires_grad_(),
        normalize(random(3)).requires_grad_(),
        random(3).requires_grad_(),
        (0.2 + 0.6 * random(1)[0]).requires_grad_(),
        random(1)[0].requires_grad_(),
        axes,
        (1 + 20 * random(2)).requires_grad_(),
        random(2, 3).requires_grad_(),
    )
    assert torch.autograd.gradcheck(
        lambda n, v, a, r, m, p, s, mu: shade(n, v, a, r, m, SphericalGaussians(p, s, mu), kind), arguments
    )
