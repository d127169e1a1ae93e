"""Check measures of agreement between views: exact spheres agree, disturbed ones do not."""

from dataclasses import replace

import numpy as np
import pytest

from gdtool.cameras import rig
from gdtool.diffusion.reports.consistency import consistency, reprojection, rerendered_psnr, slope_degrees
from tests.diffusion.spheres import sphere_views

VIEWS = sphere_views(0, 64)


def with_image(domain, value):
    return replace(VIEWS, images={**VIEWS.images, domain: value.astype(np.float32)})


def test_a_sphere_agrees_with_itself():
    figures = consistency(VIEWS)
    assert figures["slope_degrees"] < 1.0
    assert figures["reprojection_depth"] < 0.02
    assert figures["reprojection_share"] > 0.6


def test_maps_shaded_under_one_light_match_the_color():
    """Shade the maps in closed form and use the result as color: the PSNR is high, and low with the views swapped."""
    import torch

    from gdtool.shading.bsdf.closed_form import shade
    from gdtool.shading.bsdf.sg import SphericalGaussians

    light = SphericalGaussians(
        torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]),
        torch.tensor([2.0, 4.0]),
        torch.tensor([[0.6, 0.6, 0.6], [0.3, 0.2, 0.1]]),
    )
    maps = {d: torch.from_numpy(VIEWS.images[d]) for d in ("normal", "albedo", "roughness", "metallic")}
    view = torch.tensor(np.stack([c.backward for c in rig("six", 64)]), dtype=torch.float32)[:, None, None].expand(
        -1, 64, 64, -1
    )
    color = (
        shade(maps["normal"], view, maps["albedo"], maps["roughness"], maps["metallic"], light).numpy()
        * (VIEWS.mask > 0)[..., None]
    )
    exact = rerendered_psnr(with_image("color", color))
    swapped = rerendered_psnr(with_image("color", color[::-1]))
    assert exact > 28
    assert exact > swapped + 6


def test_slopes_see_turned_normals():
    turn = np.radians(20)
    normal = VIEWS.images["normal"]
    turned = np.stack(
        [
            normal[..., 0],
            np.cos(turn) * normal[..., 1] - np.sin(turn) * normal[..., 2],
            np.sin(turn) * normal[..., 1] + np.cos(turn) * normal[..., 2],
        ],
        -1,
    )
    assert slope_degrees(with_image("normal", turned)) == pytest.approx(15, abs=5)


def test_reprojection_sees_a_moved_view():
    depth = VIEWS.images["depth"].copy()
    depth[0] += 0.05 * (VIEWS.mask[0] > 0)
    assert reprojection(with_image("depth", depth))[1] < reprojection(VIEWS)[1] - 0.05
