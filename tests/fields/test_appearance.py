"""Materials fused from views, and light recovered from color, where the answers are known."""

import numpy as np
import pytest
import torch

from gdtool.fields.appearance.light import (
    ColorSamples,
    ShadedPoints,
    Visibility,
    fit_amplitudes,
    materials_from_color,
    recover_light,
    unoccluded,
    visibility,
)
from gdtool.fields.appearance.materials import Observations, confidence, fuse, spread
from gdtool.geometry.meshes import TriMesh
from gdtool.shading.bsdf.closed_form import shade
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.sampling import fibonacci


def directions(count, seed=0):
    v = np.random.default_rng(seed).standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def lit(normals, view, albedo, roughness, metallic, light):
    tensors = (torch.as_tensor(x, dtype=torch.float32) for x in (normals, view, albedo, roughness, metallic))
    return shade(*tensors, SphericalGaussians.from_record(light)).numpy()


LIGHT = {
    "kind": "spherical_gaussians",
    "axes": fibonacci(16).tolist(),
    "sharpness": [12.0] * 16,
    "amplitudes": np.random.default_rng(3).uniform(0, 1.5, (16, 3)).tolist(),
}


def test_light_of_known_materials_is_recovered():
    normals, view = directions(3000), directions(3000, 1)
    view = np.where((normals * view).sum(1, keepdims=True) < 0, -view, view)
    albedo, roughness, metallic = np.full((3000, 3), 0.6), np.full(3000, 0.5), np.zeros(3000)
    color = lit(normals, view, albedo, roughness, metallic, LIGHT)
    found, residual = recover_light(
        ShadedPoints(normals, view, albedo, roughness, metallic, unoccluded(normals)), color
    )
    assert residual < 0.01
    again = lit(normals, view, albedo, roughness, metallic, found)
    assert np.abs(again - color).mean() < 0.01 * color.mean()


def test_shadowed_samples_do_not_darken_the_light():
    response = np.repeat(np.eye(2)[np.arange(400) % 2][:, None], 3, 1)  # every sample sees one of two lobes
    color = np.full((400, 3), 0.8)
    color[:60] = 0.05
    amplitudes, _ = fit_amplitudes(response, color)
    assert amplitudes == pytest.approx(np.full((2, 3), 0.8), abs=0.03)


def test_albedo_from_color_under_a_known_light():
    normals = directions(2000)
    albedo = 0.2 + 0.5 * (normals[:, :1] > 0) * np.array([[1.0, 0.6, 0.3]])
    color = lit(normals, normals, albedo, np.full(2000, 0.5), np.zeros(2000), LIGHT)
    samples = (np.arange(2000), normals, color)
    found, roughness, metallic, _, _ = materials_from_color(
        normals, color, np.ones(2000), unoccluded(normals), samples, LIGHT | {"fit_error": {"rms": 0.1}}
    )
    assert metallic == 0.0
    assert np.abs(found - albedo).mean() < 0.03


def test_one_wrong_view_loses_against_three():
    images = np.full((4, 4, 4, 1), 0.5, np.float32)
    images[0] = 1.0
    seen = Observations(np.ones((4, 5), np.float32), np.full((4, 5, 2), 2.0))
    value, weight, residual = fuse(images, np.ones((4, 4, 4), np.float32), seen)
    assert value[:, 0] == pytest.approx(np.full(5, 0.5), abs=0.02)
    assert weight == pytest.approx(np.full(5, 4.0))
    assert (residual > 0.05).all()


def test_spread_fills_the_unseen_and_keeps_the_seen():
    """A strip of vertices: seen at both ends, linear in between."""
    n = 21
    low, high = np.arange(n), np.arange(n) + n
    faces = np.concatenate([np.stack([low[:-1], low[1:], high[:-1]], 1), np.stack([low[1:], high[1:], high[:-1]], 1)])
    values = np.zeros((2 * n, 1))
    weight = np.zeros(2 * n)
    values[[n - 1, 2 * n - 1]], weight[[0, n, n - 1, 2 * n - 1]] = 1.0, 1.0
    out = spread(values, weight, faces)[:, 0]
    assert abs(out[0]) < 0.02
    assert abs(out[n - 1] - 1) < 0.02
    assert out[:n] == pytest.approx(np.linspace(0, 1, n), abs=0.08)


def test_confidence_grows_with_views_and_falls_with_their_quarrel():
    c = confidence(np.array([0.0, 0.2, 2.0, 2.0]), np.array([0.0, 0.0, 0.0, 0.2]))
    assert c[0] == 0
    assert c[0] < c[1] < c[2] <= 1
    assert c[3] < 0.2


def test_a_wall_hides_the_light_behind_it_alone():
    """Points on a floor beside a high wall at x = 0: light from beyond the wall does not arrive, light from this side
    does."""
    floor = np.array([[0.0, 0, -9], [9, 0, -9], [9, 0, 9], [0, 0, 9]])
    wall = np.array([[0.0, 0, -9], [0, 9, -9], [0, 9, 9], [0, 0, 9]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    points = np.array([[0.05, 0.0, 0.0], [0.1, 0.0, 1.0]])
    mesh = np.concatenate([floor, wall, points])
    normals = np.tile([0.0, 1.0, 0.0], (len(mesh), 1))
    seen = visibility(TriMesh(mesh, faces), normals, 1e-3, np.random.default_rng(0), rays=64).at(np.array([8, 9]))
    axes = np.array([[-0.8, 0.6, 0.0], [0.8, 0.6, 0.0], [0.0, 1.0, 0.0]])
    share = seen.of_lobes(axes, np.full(3, 12.0))
    assert (share[:, 0] < 0.15).all()
    assert (share[:, 1] > 0.95).all()
    assert share[:, 2] == pytest.approx(0.5, abs=0.15)
    assert unoccluded(normals).of_lobes(axes, np.full(3, 12.0)) == pytest.approx(1.0)


def test_shadow_stays_out_of_the_albedo():
    """One albedo, half the points in the shadow of one lobe: with visibility it comes back even, without it does
    not."""
    normals = directions(2000)
    rng = np.random.default_rng(4)
    rays = directions(2000 * 64, 5).reshape(2000, 64, 3)
    rays = np.where((rays * normals[:, None]).sum(-1, keepdims=True) < 0, -rays, rays).astype(np.float32)
    dark = rng.random(2000) < 0.5
    seen = Visibility(rays, ~(dark[:, None] & (rays[..., 0] > 0.2)))
    arrives = seen.of_lobes(np.array(LIGHT["axes"]), np.array(LIGHT["sharpness"]))
    color = sum(
        lit(
            normals,
            normals,
            np.full((2000, 3), 0.5),
            np.full(2000, 0.8),
            np.zeros(2000),
            {n: v if n == "kind" else v[k : k + 1] for n, v in LIGHT.items()},
        )
        * arrives[:, k : k + 1]
        for k in range(16)
    )
    uneven = []
    for visible in (seen, unoccluded(normals)):
        albedo = materials_from_color(
            normals, color, np.ones(2000), visible, ColorSamples(np.arange(2000), normals, color), LIGHT
        )[0]
        uneven.append(float(albedo.std() / albedo.mean()))
    assert uneven[0] < 0.1
    assert uneven[1] > 2 * uneven[0]
