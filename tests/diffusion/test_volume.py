"""Check volumes: carved from views, turned into views, and rendered."""

import numpy as np
import pytest
import torch

from gdtool.cameras import rays, rig
from gdtool.diffusion.data.volumes import pack_volume, silhouette_space, unpack_volume
from gdtool.diffusion.network.encoding import planes_from_images
from gdtool.diffusion.shape import volume as volumes
from gdtool.diffusion.shape.losses import shape_errors
from gdtool.diffusion.shape.render import render_volume
from gdtool.diffusion.shape.volume import carve, turn, volume_side
from tests.diffusion.spheres import sphere_views

SIZE = 64
VIEWS = tuple(camera.name for camera in rig("six", SIZE))
VOXEL = 1.44 / SIZE  # world units
CENTRE, RADIUS = np.array([0.1, -0.05, 0.15]), 0.3


def ball(dtype=torch.float32) -> torch.Tensor:
    """Return the soft occupancy (1, z, y, x) of a ball that is off the middle."""
    c = torch.tensor(volumes._centres(volume_side(SIZE)), dtype=dtype)
    z, y, x = torch.meshgrid(c, -c, c, indexing="ij")
    distance = ((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2 + (z - CENTRE[2]) ** 2).sqrt()
    return torch.sigmoid((RADIUS - distance) / VOXEL * 2)[None]


def ball_views():
    """Yield each view's name, and the ball's exact coverage, depth and normals in it."""
    for camera in rig("six", SIZE):
        origins, directions = rays(camera)
        origins = origins - CENTRE
        b = (origins * directions).sum(-1)
        square = b * b - ((origins**2).sum(-1) - RADIUS**2)
        depth = -b - np.sqrt(np.maximum(square, 0))
        yield camera.name, square > 0, depth, (origins + depth[..., None] * directions) / RADIUS


def test_a_rendered_ball_has_the_silhouette_depth_and_normals_of_the_ball():
    rendered = render_volume(ball(), VIEWS, SIZE)
    for k, (name, covered, depth, normal) in enumerate(ball_views()):
        inside = rendered.mask[0, k].numpy() > 0.5
        assert (inside & covered).sum() / (inside | covered).sum() > 0.98, name
        both = inside & covered
        assert np.abs(rendered.depth[0, k].numpy() - depth)[both].mean() < 0.1 * VOXEL, name
        cosine = (np.moveaxis(rendered.normal[0, k].numpy(), 0, -1) * normal).sum(-1)[both]
        assert np.degrees(np.arccos(cosine.clip(-1, 1))).mean() < 3, name


def test_rendering_in_float32_is_that_in_float64_up_to_rounding():
    single, double = render_volume(ball(), VIEWS, SIZE), render_volume(ball(torch.float64), VIEWS, SIZE)
    inside = double.mask > 0.6
    assert (single.mask - double.mask).abs().max() < 1e-5
    assert (single.depth - double.depth)[inside].abs().max() < 1e-4
    assert (single.normal - double.normal).movedim(2, -1)[inside].abs().max() < 1e-3


@pytest.mark.parametrize("name", ["front", "back", "right", "left"])
def test_views_along_an_axis_equal_interpolated_ones(name, monkeypatch):
    random = torch.rand(1, *(volume_side(SIZE),) * 3, generator=torch.Generator().manual_seed(0))
    exact = turn(random, name, SIZE)
    monkeypatch.delitem(volumes._ALONG_AXES, name)
    along = volumes._centres(volume_side(SIZE))[::-1]
    monkeypatch.setattr(volumes, "ray_positions", lambda name, size: along)
    volumes._turning_grid.cache_clear()
    torch.testing.assert_close(turn(random, name, SIZE), exact, atol=2e-5, rtol=0)
    volumes._turning_grid.cache_clear()


def test_views_of_a_sphere_carve_the_sphere():
    views = sphere_views(0, SIZE)
    carved = carve(views.mask, views.images["depth"], VIEWS)
    c = volumes._centres(volume_side(SIZE))
    z, y, x = np.meshgrid(c, c, c, indexing="ij")
    distance = np.sqrt(x * x + y * y + z * z)
    assert carved[distance < 0.5 - VOXEL].all()
    # From the sides the sphere's top and bottom are not seen, so some voxels beyond them stay.
    seen = np.abs(y) < 0.3
    assert not carved[(distance > 0.5 + 2 * VOXEL) & seen].any()


def test_silhouettes_alone_carve_the_visual_hull():
    views = sphere_views(0, SIZE)
    hull, carved = carve(views.mask, None, VIEWS), carve(views.mask, views.images["depth"], VIEWS)
    assert (hull & carved).sum() == carved.sum()
    assert hull.sum() > carved.sum()


def test_packed_volumes_unpack_to_what_the_views_carve():
    views = sphere_views(0, SIZE)
    planes = planes_from_images(views.images, views.mask)
    unpacked = unpack_volume(pack_volume(planes, VIEWS), SIZE)
    carved = carve(views.mask, views.images["depth"], VIEWS)
    assert (unpacked != carved).mean() < 1e-3


@pytest.mark.parametrize("name", VIEWS)
def test_a_volumes_silhouette_leaves_space_for_the_volume(name):
    occupancy = ball()[0].numpy() > 0.5
    space = silhouette_space(occupancy, name, SIZE)
    assert space[occupancy].all()
    assert space.mean() < 0.5


@pytest.mark.parametrize("fill", [0.0, 1.0])
def test_empty_and_full_volumes_render_finite(fill):
    side = volume_side(SIZE)
    rendered = render_volume(torch.full((1, side, side, side), fill), VIEWS, SIZE)
    assert all(torch.isfinite(x).all() for x in rendered)
    assert float(rendered.mask.max()) == fill
    torch.testing.assert_close(rendered.normal.norm(dim=2)[:, :, 8:-8], torch.ones(1, 6, SIZE - 16, SIZE))


@pytest.mark.parametrize("logit", [-1e4, 0.0, 1e4])
def test_the_loss_is_finite_for_saturated_volumes(logit):
    side = volume_side(SIZE)
    logits = torch.full((1, side, side, side), logit, requires_grad=True)
    occupancy = (ball() > 0.5).float()
    loss = sum(shape_errors(logits, occupancy, torch.ones_like(occupancy), 0, SIZE).values())
    loss.backward()
    assert torch.isfinite(loss)
    assert torch.isfinite(logits.grad).all()
