"""What the picture's own view shows and the fused views lost."""

import numpy as np
import pytest

from gdtool.fields.grid.fusion import FusionOptions, fuse_views, grid_step, is_closed_manifold, prepare_all
from gdtool.fields.grid.picture_silhouette import missing_pixels, opposite, restore_picture_silhouette
from gdtool.geometry.distance import closest_points
from gdtool.geometry.grids import grid_over

from .shapes import views_of

SIZE, CHORD, HIGH = 96, 0.12, 0.03


def box(points, half):
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0)


def body(points):
    return box(points, np.array([0.12, 0.12, 0.4]))


def plane(points):
    """A body along z with a wing along x, four pixels high and twelve deep."""
    return np.minimum(body(points), box(points, np.array([0.4, HIGH, CHORD])))


@pytest.fixture(scope="module")
def seen():
    """The plane from the front and back, from elsewhere its body alone; depths as wavy as a model's."""
    cameras, images, mask = views_of(plane, SIZE)
    _, of_body, body_mask = views_of(body, SIZE)
    y, x = np.mgrid[:SIZE, :SIZE]
    for k, camera in enumerate(cameras):
        if camera.name not in ("front", "back"):
            mask[k] = body_mask[k]
            for domain in images:
                images[domain][k] = of_body[domain][k]
        images["depth"][k] += np.where(images["depth"][k] > 0, 0.005 * np.sin(0.6 * x + k) * np.sin(0.5 * y - 2 * k), 0)
    return prepare_all(cameras, mask, images["depth"], images["normal"])


def test_a_wing_that_the_other_views_look_through_is_there(seen):
    step = grid_step([prepared_view.camera for prepared_view in seen], 0)
    without, found = (
        fuse_views(seen, step, FusionOptions(noise=0.5 * step, picture_view=known)) for known in ("", "front")
    )
    assert without.restored == 0
    assert np.abs(without.mesh.vertices[:, 0]).max() < 0.3
    wing = found.mesh.vertices[np.abs(found.mesh.vertices[:, 0]) > 0.2]
    assert is_closed_manifold(found.mesh.faces)
    assert 0.2 < found.restored < 0.8
    assert np.abs(wing[:, 0]).max() == pytest.approx(0.4, abs=0.02)
    assert np.abs(wing[:, 1]).max() == pytest.approx(HIGH, abs=0.015)  # a pixel
    assert np.abs(wing[:, 2]).max() == pytest.approx(CHORD, abs=0.02)
    # The body is as it was.
    tail = without.mesh.vertices[np.abs(without.mesh.vertices[:, 2]) > 0.25]
    assert closest_points(tail, found.mesh)[0].max() < 0.5 * step


def test_views_that_agree_are_left_alone(seen):
    step = grid_step([prepared_view.camera for prepared_view in seen], 0)
    plain, with_picture = (
        fuse_views(seen, step, FusionOptions(noise=0.0, picture_view=known)) for known in ("", "front")
    )
    assert with_picture.restored == 0
    assert np.array_equal(plain.mesh.vertices, with_picture.mesh.vertices)


def test_without_a_view_from_behind_a_part_is_as_thick_as_wide(seen):
    front = next(prepared_view for prepared_view in seen if prepared_view.camera.name == "front")
    assert opposite(seen, front).camera.name == "back"
    assert opposite([front], front) is None
    grid = grid_over(np.full(3, -0.45), np.full(3, 0.45), 0.01, margin=2)
    index = np.argwhere(np.ones(grid.shape, bool))
    values = body(grid.points(index)).reshape(grid.shape).astype(np.float32)
    lost = missing_pixels(values, grid, front)
    assert lost.sum() == pytest.approx(2 * 0.28 * 2 * HIGH / front.camera.pixel_size**2, rel=0.15)
    alone, share = restore_picture_silhouette(values, grid, [front], front)
    assert share == pytest.approx(lost.sum() / (front.mask > 0.5).sum())
    wing = grid.points(index[(alone < 0).ravel() & (np.abs(grid.points(index)[:, 0]) > 0.2)])
    # Thin, where its front edge is seen.
    assert np.ptp(wing[:, 2]) < 0.08
    assert wing[:, 2].max() == pytest.approx(CHORD, abs=0.03)
    assert (alone <= values).all()
    # What is there needs nothing, and a view without depth says nothing of where.
    whole = plane(grid.points(index)).reshape(grid.shape).astype(np.float32)
    same, share = restore_picture_silhouette(whole, grid, seen, front)
    assert share == 0
    assert same is whole
    blind = prepare_all([front.camera], front.mask[None], None, None)[0]
    assert restore_picture_silhouette(values, grid, [blind], blind) == (values, 0.0)
