"""Check the 8-bit arithmetic of pictures against Pillow, and compositing by hand."""

import numpy as np
import pytest
import torch

from gdtool.diffusion.data.framing import frame_as_wonder3d, whole_frame_as_wonder3d
from gdtool.diffusion.data.objects import condition_batch
from gdtool.diffusion.network.eight_bit import composite, resize_bicubic, resize_rgba
from gdtool.images.color import linear_from_srgb, srgb_from_linear

Image = pytest.importorskip("PIL.Image", reason="needs Pillow, which scikit-image brings along")

SIZES = [(64, 64, 224, 224), (256, 256, 224, 224), (90, 61, 48, 32), (7, 300, 1, 48), (5, 5, 192, 192)]


def random_picture(height, width):
    """Make random 8-bit RGBA, of which a third is transparent and a third opaque."""
    rng = np.random.default_rng(height * width)
    pixels = rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
    pixels[..., 3] = np.choose(rng.integers(0, 3, (height, width)), [0, 255, pixels[..., 3]])
    return pixels


@pytest.mark.parametrize("size", SIZES)
def test_color_is_resized_as_in_pillow(size):
    pixels = random_picture(*size[:2])[..., :3]
    expected = np.asarray(Image.fromarray(pixels).resize((size[3], size[2]), resample=Image.BICUBIC))
    out = resize_bicubic(torch.from_numpy(pixels).permute(2, 0, 1).float(), *size[2:])
    np.testing.assert_array_equal(out.permute(1, 2, 0).numpy(), expected)


def test_autocast_changes_nothing():
    pixels = torch.from_numpy(random_picture(64, 64)).permute(2, 0, 1).float()
    with torch.autocast("cpu", torch.bfloat16):
        resized = resize_bicubic(pixels, 224, 224)
    assert torch.equal(resized, resize_bicubic(pixels, 224, 224))


@pytest.mark.parametrize("size", SIZES)
def test_color_with_alpha_is_resized_as_in_pillow(size):
    pixels = random_picture(*size[:2])
    expected = np.asarray(Image.fromarray(pixels).resize((size[3], size[2]), resample=Image.BICUBIC))
    np.testing.assert_array_equal(resize_rgba(torch.from_numpy(pixels).float(), *size[2:]).numpy(), expected)


def linear_picture(pixels):
    return np.concatenate([linear_from_srgb(pixels[..., :3]), pixels[..., 3:].astype(np.float32) / 255], -1)


def pixels_of(framed):
    return np.rint(255 * np.concatenate([srgb_from_linear(framed[..., :3]), framed[..., 3:]], -1))


@pytest.fixture
def cut_out():
    """Make an 80 x 120 picture whose alpha is above 0 in rows 10 to 49 and columns 20 to 99."""
    pixels = random_picture(80, 120)
    pixels[:10, :, 3] = pixels[50:, :, 3] = 0
    pixels[:, :20, 3] = pixels[:, 100:, 3] = 0
    pixels[10, 20, 3] = pixels[49, 99, 3] = 1
    return pixels


def test_wonder3d_frames_the_box_without_its_last_row_and_column(cut_out):
    framed, _ = frame_as_wonder3d(linear_picture(cut_out), 64)
    box = Image.fromarray(cut_out[10:49, 20:99]).resize((48, 23), resample=Image.BICUBIC)  # 39 * 48 / 79 = 23.7
    expected = np.zeros((64, 64, 4))
    expected[20:43, 8:56] = np.asarray(box)
    np.testing.assert_array_equal(pixels_of(framed), expected)


def test_the_square_that_wonder3d_frames(cut_out):
    _, square = frame_as_wonder3d(linear_picture(cut_out), 64)
    assert square.side == pytest.approx(64 * 79 / 48)
    assert square.left == pytest.approx(20 - 8 * 79 / 48)
    assert square.top == pytest.approx(10 - 20 * 79 / 48)


def test_wonder3d_frames_a_subject_of_one_pixel():
    picture = np.zeros((40, 40, 4), np.float32)
    picture[7, 9] = 1
    framed, _ = frame_as_wonder3d(picture, 64)
    np.testing.assert_array_equal(framed[8:56, 8:56], 1)
    assert framed.sum() == 4 * 48**2


def test_without_a_crop_wonder3d_pads_to_a_square_and_resizes(cut_out):
    padded = np.zeros((120, 120, 4), np.uint8)
    padded[20:100] = cut_out
    expected = np.asarray(Image.fromarray(padded).resize((64, 64), resample=Image.BICUBIC))
    framed = pixels_of(whole_frame_as_wonder3d(linear_picture(cut_out), 64))
    np.testing.assert_array_equal(framed[..., 3], expected[..., 3])
    shown = expected[..., 3] > 0
    np.testing.assert_array_equal(framed[shown], expected[shown])


def test_a_framed_picture_is_kept_as_it_is(cut_out):
    square = linear_picture(cut_out[:64, :64])
    np.testing.assert_array_equal(pixels_of(whole_frame_as_wonder3d(square, 64)), cut_out[:64, :64])


def composited(color, alpha, background=1.0):
    pixel = np.array([[[*(linear_from_srgb(np.float32([c / 255]))[0] for c in color), alpha / 255]]], np.float32)
    out = composite(condition_batch(pixel), torch.tensor([background]))
    return (127.5 * (out[0, :, 0, 0] + 1)).tolist()


def test_every_opaque_value_is_kept():
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 4, -1)
    ramp[..., 3] = 255
    out = composite(condition_batch(linear_picture(ramp)), torch.ones(1))
    np.testing.assert_allclose(127.5 * (out[0, 0, 0] + 1), np.arange(256), atol=1e-4)


def test_what_is_transparent_is_the_background():
    assert composited((10, 20, 30), 0)[:3] == [255, 255, 255]
    assert composited((10, 20, 30), 0, background=-1.0)[:3] == [0, 0, 0]


def test_a_mixed_value_loses_its_fraction():
    # 10 * 100 / 255 + (255 - 100) = 158.92, 20: 162.84, 30: 166.76
    assert composited((10, 20, 30), 100) == pytest.approx([158, 162, 166, 100], abs=1e-3)
