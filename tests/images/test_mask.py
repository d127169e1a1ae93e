"""Find the subject of synthetic pictures."""

import numpy as np
import pytest

from gdtool.core.errors import InputError
from gdtool.images.mask import foreground


def scene(
    size: int = 160,
    background=(0.9, 0.9, 0.9),
    subject=(0.7, 0.2, 0.1),
    center=(0.0, 0.0),
    gradient: float = 0.0,
    noise: float = 0.01,
):
    """Draw a disc of radius 0.5 with a hole of radius 0.2; returns picture (uint8) and coverage."""
    y, x = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size), indexing="ij")
    r = np.hypot(x - center[0], y - center[1])
    coverage = np.clip((0.5 - r) * size / 2 + 0.5, 0, 1) * np.clip((r - 0.2) * size / 2 + 0.5, 0, 1)
    ground = np.array(background) * (1 - gradient * (y[..., None] + 1) / 2)
    image = np.array(subject) * coverage[..., None] + ground * (1 - coverage[..., None])
    image += np.random.default_rng(0).normal(0, noise, image.shape)
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), coverage


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float(((a > 0.5) & (b > 0.5)).sum() / ((a > 0.5) | (b > 0.5)).sum())


@pytest.mark.parametrize("gradient", [0.0, 0.4])
@pytest.mark.parametrize("background", [(0.95, 0.95, 0.95), (0.2, 0.3, 0.35)])
def test_a_plain_background_and_its_part_in_a_hole_are_removed(background, gradient):
    image, truth = scene(background=background, gradient=gradient)
    mask = foreground(image)
    assert mask.shape == truth.shape
    assert mask.dtype == np.float32
    assert overlap(mask, truth) > 0.95
    assert mask[80, 80] < 0.5


def test_larger_pictures_and_sixteen_bits():
    image, truth = scene(size=700)
    assert overlap(foreground(image.astype(np.uint16) * 257), truth) > 0.97


def test_a_pale_part_of_the_subject_is_not_a_hole():
    image, _ = scene(background=(0.95, 0.95, 0.95))
    y, x = np.meshgrid(np.linspace(-1, 1, 160), np.linspace(-1, 1, 160), indexing="ij")
    image[np.hypot(x, y) < 0.2] = (215, 225, 235)  # near the background's white, but not it
    assert foreground(image)[80, 80] > 0.5


def test_a_subject_at_the_border_is_found():
    image, truth = scene(center=(0.75, 0.0))
    mask = foreground(image)
    assert overlap(mask, truth) > 0.9


def test_alpha_comes_first():
    image, truth = scene()
    alpha = np.rint(truth * 255).astype(np.uint8)
    np.testing.assert_allclose(foreground(np.dstack([image, alpha])), truth, atol=1 / 255)


def test_opaque_alpha_is_segmented():
    image, truth = scene()
    assert overlap(foreground(np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])), truth) > 0.95


def test_a_mask_argument_comes_first():
    image, _ = scene()
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[10:20, 10:20] = 255
    np.testing.assert_array_equal(foreground(image, mask), mask / 255)
    np.testing.assert_array_equal(foreground(image, np.dstack([mask] * 3)), mask / 255)


@pytest.mark.parametrize(
    ("image", "mask", "fact"),
    [
        (np.dstack([scene()[0], np.zeros((160, 160), np.uint8)]), None, "transparent everywhere"),
        (np.random.default_rng(0).integers(0, 256, (100, 100, 3), np.uint8), None, "--mask"),
        (np.full((100, 100, 3), 200, np.uint8), None, "--mask"),
        (scene()[0], np.zeros((160, 160), np.uint8), "empty mask"),
        (scene()[0], np.ones((80, 160), np.uint8), "its mask"),
    ],
)
def test_a_picture_without_a_subject_is_refused(image, mask, fact):
    with pytest.raises(InputError, match=fact) as caught:
        foreground(image, mask, "cat.png")
    assert str(caught.value).startswith("cat.png: ")


def busy_scene(size: int = 320, contrast: float = 1.0):
    """Draw a reddish disc with stripes on leaves of greens and blues; returns picture (uint8) and coverage."""
    y, x = np.meshgrid(np.linspace(-1, 1, size), np.linspace(-1, 1, size), indexing="ij")
    coverage = np.clip((0.55 - np.hypot(x, y)) * size / 2 + 0.5, 0, 1)
    leaves = np.repeat(np.repeat(np.random.default_rng(1).random((size // 8, size // 8, 1)), 8, 0), 8, 1)
    ground = np.array([0.1, 0.6, 0.2]) * (1 - leaves) + np.array([0.2, 0.3, 0.8]) * leaves
    stripes = 0.8 + 0.2 * np.sign(np.sin(14 * (x + y)))[..., None]
    disc = contrast * np.array([0.85, 0.3, 0.15]) * stripes + (1 - contrast) * ground
    image = disc * coverage[..., None] + ground * (1 - coverage[..., None])
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8), coverage


def test_a_busy_background_is_removed_with_a_warning_or_refused():
    image, truth = busy_scene()
    warned = []
    mask = foreground(image, None, "leaf.png", warned.append)
    assert mask.dtype == np.float32
    assert overlap(mask, truth) > 0.95
    assert len(warned) == 1
    assert warned[0].startswith("leaf.png: the background is not plain")
    foreground(scene()[0], None, "plain.png", warned.append)
    assert len(warned) == 1
    np.testing.assert_array_equal(mask, foreground(image))  # the same every time
    hidden, _ = busy_scene(contrast=0.0)
    with pytest.raises(InputError, match="do not tell the subject from it"):
        foreground(hidden, subject="leaf.png")
