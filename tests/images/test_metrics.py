"""Measure pictures for which the figures are known."""

import numpy as np
import pytest

from gdtool.images import metrics
from gdtool.images.color import linear_from_srgb


def noise(shape, seed=0):
    return np.random.default_rng(seed).uniform(0.2, 0.8, shape).astype(np.float32)


@pytest.mark.parametrize("error, decibel", [(0.1, 20), (0.01, 40), (1.0, 0), (0.0, 100)])
def test_psnr_of_a_constant_error(error, decibel):
    image = np.zeros((8, 8, 3))
    assert metrics.psnr(image + error, image) == pytest.approx(decibel)


def test_psnr_over_chosen_pixels():
    image, other = np.zeros((8, 8, 3)), np.zeros((8, 8, 3))
    other[:4] = 0.1
    upper = np.zeros((8, 8), bool)
    upper[:4] = True
    assert metrics.psnr(image, other, upper) == pytest.approx(20)
    assert metrics.psnr(image, other, ~upper) == 100
    assert metrics.psnr(image, other) == pytest.approx(20 + 10 * np.log10(2))


def test_ssim_of_equal_and_of_constant_pictures():
    image = noise((64, 64, 3))
    assert metrics.ssim(image, image) == pytest.approx(1)
    # Without structure only the luminance term is left: (2ab + c) / (a^2 + b^2 + c), c = 1e-4.
    a, b = np.full((32, 32), 0.4), np.full((32, 32), 0.6)
    assert metrics.ssim(a, b) == pytest.approx((2 * 0.4 * 0.6 + 1e-4) / (0.4**2 + 0.6**2 + 1e-4), rel=1e-6)
    assert metrics.ssim(image, 1 - image) < 0.1


def test_ssim_uses_a_fixed_range_of_one():
    dim = noise((64, 64)) * 0.1
    assert metrics.ssim(dim, dim + 0.05) == pytest.approx(
        metrics.ssim(np.pad(dim, 20), np.pad(dim + 0.05, 20), np.pad(np.ones((64, 64), bool), 20)), abs=0.1
    )


def test_resized_is_the_average_over_area():
    image = noise((512, 512, 3))
    np.testing.assert_allclose(metrics.resized(image, 256, 256)[3, 5], image[6:8, 10:12].mean((0, 1)), rtol=1e-6)
    assert metrics.resized(image, 512, 512) is image
    assert metrics.resized(noise((300, 300)), 256, 256).shape == (256, 256)


def test_color_protocols():
    """A square object is off by 0.1 in sRGB: masked gives 20 dB, published depends on the share of the frame."""
    mask = np.zeros((1, 256, 256), np.float32)
    mask[:, 64:192, 64:192] = 1  # a quarter of the frame
    a, b = (linear_from_srgb(np.full((1, 256, 256, 3), value)) * mask[..., None] for value in (0.5, 0.6))
    figures = metrics.color_metrics(a, mask, b, mask)
    assert figures["psnr_masked"] == pytest.approx(20, abs=1e-3)
    assert figures["psnr_published"] == pytest.approx(20 + 10 * np.log10(4), abs=1e-3)
    assert figures["ssim_published"] > figures["ssim_masked"]


def test_a_missing_object_is_black_in_the_mask_and_white_in_the_frame():
    mask = np.ones((1, 256, 256), np.float32)
    white = np.ones((1, 256, 256, 3), np.float32)
    figures = metrics.color_metrics(white * 0, mask * 0, white, mask)
    assert figures["psnr_masked"] == pytest.approx(0, abs=1e-5)
    assert figures["psnr_published"] == 100


def test_psnr_is_of_each_picture_and_then_the_mean():
    mask = np.ones((2, 256, 256), np.float32)
    a = linear_from_srgb(np.full((2, 256, 256, 3), 0.5))
    b = a.copy()
    b[0] = linear_from_srgb(0.6)
    assert metrics.color_metrics(a, mask, b, mask)["psnr_masked"] == pytest.approx((20 + 100) / 2, abs=1e-3)


def test_partly_covered_pixels_do_not_count_as_foreground():
    mask = np.ones((1, 256, 256), np.float32)
    mask[:, :, 128:] = 0.5
    a = np.zeros((1, 256, 256))
    b = a.copy()
    b[:, :, 128:] = 1
    assert metrics.scalar_error(a, b, mask) == 0
    assert metrics.scalar_error(a, b, np.ones_like(mask)) == 0.5


def test_normal_angle_of_a_known_rotation():
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(2, 16, 16, 3))
    normal[..., 1] = 0  # so that a turn about y turns each by the whole angle
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mask = np.ones((2, 16, 16))
    for degrees in (0, 1e-3, 12, 90, 179):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        turned = normal @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T
        assert metrics.normal_degrees(turned, mask, normal, mask) == pytest.approx(degrees, abs=1e-6)


def test_depth_and_masks():
    mask, other = np.zeros((1, 10, 10)), np.zeros((1, 10, 10))
    mask[:, :, :6], other[:, :, 4:] = 1, 1
    assert metrics.mask_iou(mask, other) == pytest.approx(0.2)
    assert metrics.mask_iou(mask * 0, mask * 0) == 1
    assert metrics.depth_error(np.full((1, 10, 10), 2.0), mask, np.full((1, 10, 10), 1.9), other) == pytest.approx(0.1)


def test_views_metrics_take_the_domains_that_both_have():
    mask = np.ones((1, 256, 256), np.float32)
    images = {
        "color": noise((1, 256, 256, 3)),
        "albedo": noise((1, 256, 256, 3)),
        "roughness": noise((1, 256, 256)),
        "depth": noise((1, 256, 256)),
    }
    figures = metrics.views_metrics(images, mask, {k: v for k, v in images.items() if k != "depth"}, mask)
    assert figures == pytest.approx(
        {
            "mask_iou": 1,
            "color_psnr_published": 100,
            "color_ssim_published": 1,
            "color_psnr_masked": 100,
            "color_ssim_masked": 1,
            "albedo_psnr_masked": 100,
            "albedo_ssim_masked": 1,
            "roughness_error": 0,
        }
    )


def test_nothing_in_common_gives_no_figure():
    mask = np.zeros((1, 256, 256), np.float32)
    normal = np.zeros((1, 256, 256, 3), np.float32)
    assert metrics.views_metrics({"normal": normal}, mask, {"normal": normal}, mask) == {"mask_iou": 1}


def test_views_are_resized_over_what_they_cover():
    """A half covered new pixel keeps the value of its covered half; a mean of normals is made unit."""
    mask = np.zeros((1, 4, 4), np.float32)
    mask[:, :, :1] = 1
    normal = np.zeros((1, 4, 4, 3), np.float32)
    normal[:, ::2, 0], normal[:, 1::2, 0] = (1, 0, 0), (0, 1, 0)
    images, small = metrics.resized_views({"depth": 2 * mask, "normal": normal}, mask, 2, 2)
    assert small[0].tolist() == [[0.5, 0]] * 2
    assert images["depth"][0].tolist() == [[2, 0]] * 2
    np.testing.assert_allclose(images["normal"][0, 0], [[0.5**0.5, 0.5**0.5, 0], [0, 0, 0]], atol=1e-6)
