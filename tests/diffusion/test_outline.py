"""Check that parts which the picture shows and the sampled outlines lost are added to all views, and nothing else."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from gdtool.diffusion.inference.outline import add_part_to_masks, draw_part, find_lost_part
from tests.fields.shapes import cube, sphere, torus, views_of

SIZE = 96
FORWARD = 0.15  # the post stands this far in front of the ball's middle


def ball_with_post(points):
    post = np.maximum(
        np.hypot(points[..., 0] + 0.1, points[..., 2] - FORWARD) - 0.04, np.abs(points[..., 1] - 0.35) - 0.2
    )
    return np.minimum(sphere(points, 0.3), post)


@pytest.fixture(scope="module")
def views():
    """Return views of a ball with a post, and masks in which only the front and the back view show the post."""
    cameras, images, mask = views_of(ball_with_post, SIZE)
    ball = views_of(lambda points: sphere(points, 0.3), SIZE)[2]
    guessed = np.array(
        [
            with_post if camera.name in ("front", "back") else np.minimum(with_post, np.maximum(without, 0.2))
            for camera, with_post, without in zip(cameras, mask, ball, strict=True)
        ]
    )
    return cameras, images, mask, guessed


@pytest.mark.parametrize("deep", [True, False])
def test_a_post_that_the_sampled_views_lost_is_placed_correctly(views, deep):
    cameras, images, mask, guessed = views
    front = [camera.name for camera in cameras].index("front")
    pixel = cameras[0].pixel_size
    known = np.where(guessed >= 0.5, guessed, 0)
    part = find_lost_part(guessed, known, cameras, front, images["depth"][front] if deep else None)
    assert np.abs(part.middle - (2 - FORWARD))[part.lost].mean() < pixel
    grown = add_part_to_masks(part, known, cameras, front)
    for k in range(len(cameras)):
        post = (mask[k] > 0.5) & (known[k] <= 0.5)
        assert (grown[k] >= known[k]).all()
        if k != front and post.any():
            assert (grown[k] > 0.5)[post].mean() > 0.7  # but for a rim of half a pixel
            beyond = (grown[k] > 0.5) & ~binary_dilation(mask[k] > 0.5, np.ones((3, 3)))
            assert beyond.sum() < 8  # where it joins the ball


def test_every_view_shows_the_part_with_the_known_views_values(views):
    cameras, images, mask, guessed = views
    names = [camera.name for camera in cameras]
    front, right = names.index("front"), names.index("right")
    known = np.where(guessed >= 0.5, guessed, 0)
    wrong = {
        domain: np.where((known > 0.5).reshape(known.shape + (1,) * (x.ndim - 3)), x, 0) for domain, x in images.items()
    }
    part = find_lost_part(guessed, known, cameras, front, images["depth"][front])
    before = {domain: x.copy() for domain, x in wrong.items()}
    draw_part(part, wrong, known, cameras, front)
    for domain in set(wrong) - {"depth"}:
        covered = known > 0.5
        np.testing.assert_array_equal(wrong[domain][covered], before[domain][covered])
    post = (mask[right] > 0.9) & (known[right] <= 0.5) & (add_part_to_masks(part, known, cameras, front)[right] > 0.5)
    off = wrong["depth"][right] - images["depth"][right]
    assert post.sum() > 40
    assert np.abs(off[post]).mean() < 2 * cameras[0].pixel_size
    cosine = (wrong["normal"][right] * images["normal"][right]).sum(-1)[post]
    assert np.median(cosine) > 0.7
    assert (wrong["normal"][right] @ cameras[right].backward)[post].min() > 0
    np.testing.assert_allclose(np.linalg.norm(wrong["normal"][right][post], axis=-1), 1, atol=1e-5)
    assert np.abs(wrong["albedo"][right] - images["albedo"][right])[post].mean() < 0.1


@pytest.mark.parametrize("solid", [sphere, cube, torus, ball_with_post])
def test_views_with_space_for_all_of_the_picture_stay(solid):
    cameras, images, mask = views_of(solid, 64)
    front = [camera.name for camera in cameras].index("front")
    assert find_lost_part(mask, mask, cameras, front, images["depth"][front]) is None
