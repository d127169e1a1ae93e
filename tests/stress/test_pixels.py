"""Rendered pixels against a converged reference, as Mitsuba 3 tests its own: a z-test a pixel, Šidák-corrected.

Renderings that differ in their seed only are draws of each pixel; their mean must agree with the reference within what
their variance allows. A bias that no picture shows fails here.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import t as student

from gdtool.assets.scene import Material, Scene
from gdtool.cameras import camera_at
from gdtool.shading.lights.bundled import bundled
from gdtool.shading.render.direct import DirectLight, LightOptions
from gdtool.shading.render.render import Renderer
from tests.stress.test_scenes import ball

SIZE, DRAWS, SAMPLES = 12, 24, 16
# One in a hundred over all eighteen cases together.
SIGNIFICANCE = 0.01 / 18
CAMERA = camera_at(25.0, 20.0, name="v", size=SIZE)


def stage(material: Material) -> Scene:
    """A ball over a floor: light, shadow, and pixels that edges cut."""
    vertices, faces = ball(10)
    floor = np.array([[-0.6, -0.3, -0.6], [0.6, -0.3, -0.6], [0.6, -0.3, 0.6], [-0.6, -0.3, 0.6]])
    return Scene(
        vertices=np.concatenate([vertices * 0.5, floor]),
        faces=np.concatenate([faces, len(vertices) + np.array([[0, 2, 1], [0, 3, 2]])]).astype(np.int32),
        materials=(material,),
    )


def picture(renderer: Renderer, environment, seed: int, directions: int, brdf: str = "gltf", **options) -> np.ndarray:
    return renderer.buffers(
        CAMERA, SAMPLES, DirectLight(renderer, environment, directions, seed, brdf, LightOptions(**options)).color()
    )["color"].astype(np.float64)


def z_test(draws: np.ndarray, reference: np.ndarray, reference_error: np.ndarray, bias: float = 0.0) -> float:
    """The smallest p of all pixels' two-sided t-tests, corrected for their number (Šidák 1967).

    bias: share of the reference by which an estimate that is not unbiased may be off.
    """
    count = len(draws)
    mean, variance = draws.mean(0), draws.var(0, ddof=1)
    # float32 sums differ by rounding where there is no noise at all.
    error = np.sqrt(variance / count + reference_error**2 + (1e-5 * reference) ** 2)
    seen = reference > 0
    off = np.maximum(np.abs(mean - reference) - bias * reference, 0)
    p = 2 * student.sf(off[seen] / error[seen], count - 1)
    return 1 - (1 - float(p.min())) ** int(seen.sum())


MATERIALS = {
    "plaster": Material(base_color=(0.7, 0.5, 0.3, 1), metallic=0.0, roughness=1.0),
    "plastic": Material(base_color=(0.2, 0.5, 0.8, 1), metallic=0.0, roughness=0.3),
    "metal": Material(base_color=(0.9, 0.7, 0.4, 1), metallic=1.0, roughness=0.4),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "brdf, known", [("gltf", False), ("gltf", True), ("paper", False)], ids=["gltf", "gltf known irradiance", "paper"]
)
@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("light", ["mid", "bright"])
def test_sampled_light_agrees_with_the_converged(material, light, brdf, known):
    """The plain estimate is unbiased; the one that is used for glTF's Lambert, the known irradiance times the visible
    share, is a ratio of two estimates, off by up to 0.1 % where a pixel is half in shadow."""
    renderer, environment = Renderer(stage(MATERIALS[material]), 1), bundled(light).downsampled(64)
    reference = [picture(renderer, environment, 1000 + k, 1024, brdf, control_variate=False) for k in range(4)]
    error = np.std(reference, 0, ddof=1) / 2
    draws = np.stack([picture(renderer, environment, seed, 16, brdf, control_variate=known) for seed in range(DRAWS)])
    assert z_test(draws, np.mean(reference, 0), error, 2e-3 if known else 0.0) > SIGNIFICANCE


def test_the_test_finds_a_bias_of_two_percent():
    """The same statistic of an estimate that is 2 % too bright fails; of one that is not, it passes."""
    renderer, environment = Renderer(stage(MATERIALS["plaster"]), 1), bundled("mid").downsampled(32)
    draws = np.stack([picture(renderer, environment, seed, 8) for seed in range(8)])
    reference = picture(renderer, environment, 99, 256)
    spread = 0.25 * draws.std(0, ddof=1)
    assert z_test(draws * 1.02, reference, 0 * spread) < 1e-3
    assert math.isfinite(z_test(draws, reference, spread))
    assert z_test(draws, reference, spread) > SIGNIFICANCE
