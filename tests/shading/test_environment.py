"""Check environments: directions, sampling, the bundled lights and their fits by spherical Gaussians."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gdtool.core.errors import InputError
from gdtool.shading.lights.bundled import BUNDLED, direction, random_lobes, rasterise_lobes
from gdtool.shading.lights.environment import METERED_WHITE, Environment
from gdtool.shading.lights.load import load_environment
from gdtool.shading.lights.prefilter import IrradianceMap
from gdtool.shading.lights.sg_fit import fit_sg
from gdtool.shading.lights.studio import studio


def test_directions_of_pixels():
    env = Environment(np.zeros((64, 128, 3)))
    d = env.directions
    assert d[0, 0, 1] > 0.99  # the top row is up
    assert d[-1, 0, 1] < -0.99
    assert d[32, 64, 0] > 0.99  # the middle is +X, three quarters +Z (three.js)
    assert d[32, 96, 2] > 0.99
    assert np.array_equal(env.pixel_of(d.reshape(-1, 3)), np.arange(64 * 128))
    assert env.solid_angles.sum() * 128 == pytest.approx(4 * np.pi)


def test_importance_sampling_is_exact():
    rng = np.random.default_rng(0)
    env = Environment((rng.random((32, 64, 3)) ** 6).astype(np.float32))
    directions, radiance, density = env.sample(rng.random((40_000, 2)))
    assert np.array_equal(env.radiance(directions), radiance)
    assert (env.pdf * env.solid_angles[:, None]).sum() == pytest.approx(1)
    truth = (env.image * env.solid_angles[:, None, None]).sum((0, 1))
    assert np.allclose((radiance / density[:, None]).mean(0), truth, rtol=0.02)
    # chi-square over rows: as many land in each as the density says
    row = env.pixel_of(directions) // 64
    expected = (env.pdf * env.solid_angles[:, None]).sum(1) * 40_000
    assert ((np.bincount(row, minlength=32) - expected) ** 2 / expected).sum() < 75


def test_black_rows_and_one_bright_pixel():
    image = np.zeros((16, 32, 3), np.float32)
    image[4, 7] = 100
    env = Environment(image)
    directions, _, density = env.sample(np.random.default_rng(1).random((1000, 2)))
    assert (env.pixel_of(directions) == 4 * 32 + 7).mean() > 0.9
    assert np.isfinite(density).all()
    assert (density > 0).all()


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_lights_are_metered_and_fitted(name):
    env, lobes, record = studio(name)
    assert env.name == record["environment"] == name
    assert np.isfinite(env.image).all()
    assert (env.image >= 0).all()
    around = Environment(np.zeros((24, 48, 3))).directions.reshape(-1, 3)
    white = (env.irradiance(around) @ [0.2126, 0.7152, 0.0722]).max() * 0.8 / np.pi
    assert white == pytest.approx(METERED_WHITE, rel=0.05)
    assert len(lobes.sharpness) == 16
    assert record["fit_error"]["irradiance_rms"] < 0.01
    assert abs(record["fit_error"]["energy"]) < 0.01


def test_a_light_made_of_lobes_is_fitted():
    axes = np.stack([direction(30, 40), direction(-100, 10)])
    env = rasterise_lobes(axes, np.array([20.0, 4.0]), np.array([[3.0, 2, 1], [0.5, 0.5, 1]]), 32)
    lobes, error = fit_sg(env)
    assert error["radiance_rms"] < 0.1
    assert error["irradiance_rms"] < 0.02
    assert fit_sg(env, steps=5)[1] == fit_sg(env, steps=5)[1]


def test_random_studios_differ_and_repeat():
    first, second = (random_lobes(np.random.default_rng(k)) for k in (1, 2))
    assert not np.allclose(first[2], second[2])
    assert all(np.array_equal(a, b) for a, b in zip(first, random_lobes(np.random.default_rng(1)), strict=True))
    for seed in range(20):
        _, lobes, record = studio(f"random:{seed}")
        assert (lobes.amplitudes >= 0).all()
        assert record["fit_error"]["irradiance_rms"] < 0.01


def test_files_that_are_no_environment_are_refused(tmp_path):
    with pytest.raises(InputError, match="bundled lights"):
        load_environment(tmp_path / "none.hdr")
    from gdtool.images.io import write_exr, write_png

    write_exr(tmp_path / "square.exr", np.ones((32, 32, 3), np.float32))
    with pytest.raises(InputError, match="twice as wide"):
        load_environment(tmp_path / "square.exr")
    write_png(tmp_path / "low.png", np.ones((32, 64, 3), np.float32))
    with pytest.raises(InputError, match="dynamic range"):
        load_environment(tmp_path / "low.png")
    write_exr(tmp_path / "black.exr", np.zeros((32, 64, 3), np.float32))
    with pytest.raises(InputError, match="black"):
        load_environment(tmp_path / "black.exr")
    write_exr(tmp_path / "good.exr", np.full((32, 64, 3), 2.0, np.float32))
    assert np.allclose(load_environment(tmp_path / "good.exr").metered().image, 1.0, rtol=0.01)


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (3, 7), (8, 16), (64, 128), (300, 100)])
def test_irradiance_does_not_depend_on_the_images_resolution(size):
    """Uniform light of 1 gives π, and light from above π (1 + n·y) / 2, by the table and by the sum."""
    normals = np.random.default_rng(0).normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    image = np.ones((*size, 3), np.float32)
    for up in (False, True):
        if up and size[0] % 2:
            continue
        image[size[0] // 2 :] = 0 if up else 1
        light = Environment(image.copy())
        wanted = np.pi * (0.5 * (1 + normals[:, 1]) if up else np.ones(200))
        for got in (
            light.irradiance(normals),
            IrradianceMap(light).lookup(torch.as_tensor(normals.T, dtype=torch.float32)).numpy().T,
        ):
            np.testing.assert_allclose(got, np.broadcast_to(wanted[:, None], (200, 3)), atol=0.008 * np.pi)
