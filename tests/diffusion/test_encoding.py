"""Check that domain images survive encoding and decoding, and how sampled images become views."""

import numpy as np
import pytest
import torch

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.data.framing import FRONT_EXTENT, frame, whole_frame
from gdtool.diffusion.network.encoding import coverage, decode, encode, mirror_images, planes_from_images
from tests.diffusion.spheres import sphere_views


@pytest.fixture(scope="module")
def sphere():
    views = sphere_views(3)
    return views, torch.from_numpy(planes_from_images(views.images, views.mask))[None]


@pytest.mark.parametrize("background", [1.0, 0.0, -1.0])
def test_encode_then_decode_is_the_identity(sphere, background):
    from gdtool.images.color import srgb_from_linear

    views, planes = sphere
    encoded = encode(planes, tuple(range(6)), torch.tensor([background]))[0]
    images = {d: encoded[i] for i, d in enumerate(DOMAINS)}
    mask = coverage(images, background)
    np.testing.assert_allclose(mask, views.mask, atol=1e-6)
    values = decode(images, mask, background)
    inside = views.mask > 0
    for domain in ("color", "albedo"):
        expected = srgb_from_linear(views.images[domain])
        np.testing.assert_allclose(np.moveaxis(values[domain].numpy(), 1, -1)[inside], expected[inside], atol=1e-5)
    np.testing.assert_allclose(
        np.moveaxis(values["normal"].numpy(), 1, -1)[inside], views.images["normal"][inside], atol=1e-5
    )
    for domain in ("depth", "roughness", "metallic"):
        np.testing.assert_allclose(values[domain].numpy()[inside], views.images[domain][inside], atol=1e-5)


def test_half_covered_pixels_keep_their_values(sphere):
    views, _ = sphere
    planes = torch.from_numpy(planes_from_images(views.images, 0.5 * views.mask))[None]
    encoded = encode(planes, tuple(range(6)), torch.tensor([1.0]))[0]
    images = {d: encoded[i] for i, d in enumerate(DOMAINS)}
    mask = coverage(images, 1.0)
    np.testing.assert_allclose(mask, 0.5 * views.mask, atol=1e-6)
    inside = views.mask > 0
    np.testing.assert_allclose(
        decode(images, mask, 1.0)["depth"].numpy()[inside], views.images["depth"][inside], atol=1e-5
    )


@pytest.mark.parametrize("domains", [("normal",), ("color",), ("depth", "albedo")])
def test_every_subset_has_a_mask(sphere, domains):
    views, planes = sphere
    encoded = encode(planes, tuple(DOMAINS.index(d) for d in domains), torch.tensor([1.0]))[0]
    mask = coverage({d: encoded[i] for i, d in enumerate(domains)}, 1.0).numpy()
    assert np.mean((mask > 0.5) == (views.mask > 0.5)) > 0.99


def disc(size=200, radius=30, centre=(70, 120)):
    y, x = np.mgrid[:size, :size] + 0.5
    alpha = ((x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2).astype(np.float32)
    return np.concatenate([np.broadcast_to([0.2, 0.4, 0.6], (size, size, 3)), alpha[..., None]], -1).astype(np.float32)


def test_framing_centres_and_scales():
    out = frame(disc(), 64)
    rows, columns = np.nonzero(out[..., 3] > 0.5)
    assert abs(rows.mean() - 31.5) < 0.3
    assert abs(columns.mean() - 31.5) < 0.3
    assert abs((np.ptp(rows) + 1) - FRONT_EXTENT * 64) <= 1.5
    np.testing.assert_allclose(
        out[out[..., 3] > 0.1][:, :3], np.broadcast_to([0.2, 0.4, 0.6], (int((out[..., 3] > 0.1).sum()), 3)), atol=1e-4
    )


def test_framing_a_framed_front_view_changes_nothing():
    views = sphere_views(1, size=64)
    image = np.concatenate([views.images["color"][0], views.mask[0][..., None]], -1)
    out = frame(image, 64)
    assert np.abs(out[..., 3] - image[..., 3]).mean() < 0.01
    np.testing.assert_allclose(whole_frame(image, 64), image, atol=1e-5)


def test_whole_frame_pads_to_a_square():
    image = np.ones((20, 40, 4), np.float32)
    out = whole_frame(image, 40)
    assert out[:10, :, 3].max() < 1e-5
    assert out[30:, :, 3].max() < 1e-5
    assert out[12:28, :, 3].min() > 0.99


def test_front_and_back_silhouettes_are_the_pictures(sphere):
    """The sampled images show a sphere, the picture a slanted shape: front and back get the picture's silhouette."""
    from gdtool.cameras import rig
    from gdtool.diffusion.inference.result import views_from_images

    views, planes = sphere
    encoded = encode(planes, tuple(range(6)), torch.tensor([0.0]))[0]
    alpha = np.tril(np.ones((32, 32), np.float32))
    out, report = views_from_images({d: encoded[i] for i, d in enumerate(DOMAINS)}, rig("six", 32), 0.0, DOMAINS, alpha)
    names = list(out.names)
    np.testing.assert_array_equal(out.mask[names.index("front")], alpha)
    np.testing.assert_array_equal(out.mask[names.index("back")], alpha[:, ::-1])
    # The slanted shape is taller than the sphere: the others show what goes beyond it, and are as they were elsewhere.
    right, guessed = out.mask[names.index("right")], views.mask[names.index("right")]
    changed = np.abs(right - guessed) > 1e-6
    assert report["drawn_share"] > 0.1
    assert (right[changed] == 1).all()
    assert changed[guessed.max(1) == 0].any()
    assert changed[guessed > 0.5].sum() == 0
    assert all(np.isfinite(image).all() for image in out.images.values())
    assert (out.images["depth"][names.index("front")][alpha == 0] == 0).all()


def test_mirrored_images_are_the_images_of_the_mirrored_object():
    from gdtool.cameras import rig
    from gdtool.diffusion.data.objects import mirror_object

    generator, names = torch.Generator().manual_seed(0), tuple(camera.name for camera in rig("six", 8))
    planes = 2 * torch.rand(6, 13, 8, 8, generator=generator) - 1
    mirrored_planes = mirror_object(planes, torch.zeros(4, 8, 8), torch.zeros(16, 7), names)[0]
    for domains in (tuple(range(6)), (0, 1), (2, 3)):
        images, images_of_mirrored = (encode(x[None], domains, torch.tensor([1.0])) for x in (planes, mirrored_planes))
        torch.testing.assert_close(mirror_images(images, domains, names), images_of_mirrored)
        torch.testing.assert_close(mirror_images(images_of_mirrored, domains, names), images)


def test_metallic_is_pushed_to_its_ends_and_edges_stay_soft():
    from gdtool.diffusion.inference.result import sharpen_metallic

    metallic = torch.linspace(0, 1, 101, dtype=torch.float64)
    out = sharpen_metallic(metallic)
    assert out[0] == 0
    assert out[50] == 0.5
    assert out[100] == 1
    assert (out.diff() > 0).all()
    torch.testing.assert_close(out, 1 - out.flip(0))  # metal and no metal weigh the same
    assert out[20] < 0.01
    assert out[80] > 0.99
    assert out[40] > 0.1


def test_only_metallic_is_sharpened(sphere):
    from gdtool.cameras import rig
    from gdtool.diffusion.inference.result import sharpen_metallic, views_from_images

    views, _ = sphere
    grey = np.full(views.mask.shape, 0.3, np.float32)
    planes = planes_from_images(views.images | {"roughness": grey, "metallic": grey}, views.mask)
    encoded = encode(torch.from_numpy(planes)[None], tuple(range(6)), torch.tensor([0.0]))[0]
    out, _ = views_from_images({d: encoded[i] for i, d in enumerate(DOMAINS)}, rig("six", 32), 0.0, DOMAINS)
    inside = out.mask > 0.99
    np.testing.assert_allclose(out.images["roughness"][inside], 0.3, atol=1e-3)
    np.testing.assert_allclose(out.images["metallic"][inside], float(sharpen_metallic(torch.tensor(0.3))), atol=1e-3)


def test_views_from_opposite_sides_get_one_outline():
    """Two opposite views with different outlines both get the mean of the two."""
    from gdtool.cameras import rig
    from gdtool.diffusion.inference.result import average_opposite_views

    cameras = rig("six", 8)
    names, soft = [camera.name for camera in cameras], torch.rand(6, 8, 8, generator=torch.Generator().manual_seed(1))
    out = average_opposite_views(soft, cameras)
    right, left, slanted = (names.index(name) for name in ("right", "left", "front_right"))
    torch.testing.assert_close(out[right], (soft[right] + soft[left].flip(-1)) / 2)
    torch.testing.assert_close(out[left], out[right].flip(-1))
    torch.testing.assert_close(out[slanted], soft[slanted])


def test_depth_stays_within_the_outlines_of_other_views():
    """Displace a ball's depth, too far out in the right view and too far in in the front view.

    Both are moved back within the ball's outlines, and correct depth stays.
    """
    from gdtool.cameras import backproject
    from gdtool.diffusion.inference.result import move_depth_within_silhouettes
    from tests.fields.shapes import sphere, views_of

    cameras, images, mask = views_of(lambda points: sphere(points, 0.4), 64)
    pixel = cameras[0].pixel_size
    moved = np.abs(move_depth_within_silhouettes(images["depth"], mask, cameras) - images["depth"])[mask > 0.99]
    # At the poles rows are as wide as the square root of their height.
    assert moved.max() < 3 * pixel
    assert moved.mean() < 0.2 * pixel
    names = [camera.name for camera in cameras]
    wrong = images["depth"].copy()
    wrong[names.index("right")] -= 0.1 * (mask[names.index("right")] > 0.5)
    wrong[names.index("front")] += 0.9 * (mask[names.index("front")] > 0.5)
    result = move_depth_within_silhouettes(wrong, mask, cameras)
    for name in ("right", "front"):
        k = names.index(name)
        points = backproject(cameras[k], result[k].astype(float))[mask[k] > 0.99]
        before = backproject(cameras[k], wrong[k].astype(float))[mask[k] > 0.99]
        # Within the ball's width in every row that the others show, though the ray alone would allow more.
        reach = np.hypot(points[:, 0], points[:, 2]) - np.sqrt(np.maximum(0.4**2 - points[:, 1] ** 2, 0))
        assert reach.max() < 0.1 * 0.4 + 2 * pixel
        assert (np.hypot(before[:, 0], before[:, 2]) > 0.45).any()
    others = [k for k, name in enumerate(names) if name not in ("right", "front")]
    np.testing.assert_allclose(
        result[others][mask[others] > 0.99], images["depth"][others][mask[others] > 0.99], atol=3 * pixel
    )
    flat = mask * 0
    assert (move_depth_within_silhouettes(wrong, flat, cameras) == wrong).all()
    # Outlines of another object, at the very border of their pictures.
    elsewhere = mask.copy()
    elsewhere[1::2] = 0
    elsewhere[1::2, :, :2] = 1
    result = move_depth_within_silhouettes(images["depth"], elsewhere, cameras)
    inside = elsewhere > 0.5
    assert result[inside].min() >= cameras[0].near
    assert result[inside].max() <= cameras[0].far


def test_an_outline_between_pixels_moves_depth_by_a_fraction_of_a_pixel():
    """A wall leans by a fifth of a pixel a row: its depth in the facing view has no steps of whole pixels."""
    from gdtool.cameras import rig
    from gdtool.diffusion.inference.result import move_depth_within_silhouettes

    size, lean = 64, 1 / 5
    cameras = rig("six", size)
    names, pixel = [camera.name for camera in cameras], cameras[0].pixel_size
    front, right = names.index("front"), names.index("right")
    row, column = np.mgrid[:size, :size]
    edge = 8 + lean * row[:, 0]  # pixels from the middle
    mask = np.zeros((6, size, size), np.float32)
    mask[front, :, 20:-20] = 1
    mask[right] = np.clip(edge[:, None] - np.abs(column + 0.5 - size / 2) + 0.5, 0, 1)
    depth = np.where(mask > 0, np.linalg.norm(cameras[front].position) - 0.5, 0).astype(np.float32)
    result = move_depth_within_silhouettes(depth, mask, cameras)[front, :, size // 2]
    wall = np.linalg.norm(cameras[front].position) - edge * pixel
    np.testing.assert_allclose(result, wall, atol=0.1 * pixel)
