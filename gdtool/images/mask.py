"""Find the subject of a picture: by a mask, its alpha, a network, or its difference from the background."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.images.color import rgba, srgb_from_linear, unit_range

WORKING_SIDE = 384  # pixels; larger pictures are segmented at this size
# Shares of the picture between which a subject is believed: less is a speck, more is no background.
MIN_SUBJECT, MAX_SUBJECT = 0.002, 0.95
# Lab units from the background at which a pixel is the subject: at least, and as a multiple of the background's noise.
SUBJECT_DISTANCE, SUBJECT_NOISE = 5.0, 5
SHADOW_WEIGHT = 0.5  # of the lightness below the background's: a soft shadow darkens without changing hue
BORDER_SHARE = 0.03  # width of the border that the background is fitted to, as a share of the picture's side
MAX_NOISE = 5  # Lab units; a background with more noise is not plain
_CURE = "give a mask with --mask, a network with --matting, or cut the subject out (RGBA)"


def foreground(
    image: np.ndarray,
    mask: np.ndarray | None = None,
    subject: object = "image",
    tell: Callable[[str], None] = lambda text: None,
    network: str | Path | None = None,
) -> np.ndarray:
    """Find the coverage (h, w) of a picture's subject, float32 in [0, 1].

    image (h, w, c): as read_image returns it. mask (h, w[, c]): of the same size, the subject brighter or more opaque.

    The first of these decides: the mask; the picture's alpha, unless it is opaque everywhere; the network (matting.py),
    where one is given; segmentation where the background is plain, gradients and soft shadows included; GrabCut where
    it is not. GrabCut guesses: one result in four that it does not refuse lacks a part or has too much
    (docs/benchmarks/cutout.md). So `tell` gets a warning.

    Raises InputError, naming `subject`, for a picture or mask without a subject, or a subject that blends into its
    background.
    """
    image = image.reshape(*image.shape[:2], -1)
    if mask is not None:
        coverage = _mask_coverage(mask)
        if coverage.shape != image.shape[:2]:
            raise InputError(
                subject,
                f"is {image.shape[1]}x{image.shape[0]}, its mask {coverage.shape[1]}x{coverage.shape[0]}",
                "scale the mask to the size of the picture",
            )
        if not (coverage > 0.5).any():
            raise InputError(subject, "has an empty mask", "paint the subject white in it")
        return coverage
    if image.shape[2] in (2, 4):
        alpha = np.clip(unit_range(image[..., -1]), 0, 1).astype(np.float32)
        if not (alpha > 0.5).any():
            raise InputError(subject, "is transparent everywhere", "save it with a subject that is opaque")
        if (alpha < 0.5).any():
            return alpha
    if network is not None:
        return _salient(image, subject, network)
    return _segmented(image, subject, tell)


def _mask_coverage(mask: np.ndarray) -> np.ndarray:
    """Convert a mask picture to coverage: its alpha where that has transparent parts, else its brightness."""
    pixels = np.clip(unit_range(mask), 0, 1).astype(np.float32).reshape(*mask.shape[:2], -1)
    if pixels.shape[2] in (2, 4) and pixels[..., -1].min() < 0.5:
        return pixels[..., -1]
    return pixels[..., : 1 if pixels.shape[2] < 3 else 3].mean(-1)


def _encoded(image: np.ndarray) -> np.ndarray:
    """Return the sRGB color (h, w, 3) in [0, 1] of a picture as read_image returns it."""
    color = rgba(image)[..., :3]
    return srgb_from_linear(np.clip(color, 0, 1)) if image.dtype.kind == "f" else color


def _salient(image: np.ndarray, subject: object, network: str | Path) -> np.ndarray:
    """Find the coverage by a trained network. Raises InputError where it finds nothing, or all of the picture."""
    from gdtool.images.matting import saliency

    coverage = _without_specks(saliency(_encoded(image), network)).astype(np.float32)
    if not MIN_SUBJECT < (coverage > 0.5).mean() < MAX_SUBJECT:
        raise InputError(subject, f"shows {network} no subject that stands off its background", _CURE)
    return coverage


def _segmented(image: np.ndarray, subject: object, tell: Callable[[str], None]) -> np.ndarray:
    """Find the coverage by the difference from a plain background, its edge by random walks (Grady 2006)."""
    from skimage.color import rgb2lab
    from skimage.segmentation import random_walker
    from skimage.transform import resize

    color = _encoded(image)
    height, width = color.shape[:2]
    scale = min(1.0, WORKING_SIDE / max(height, width))
    small = (max(8, round(height * scale)), max(8, round(width * scale)))
    if scale < 1:
        color = resize(color, small, order=1, anti_aliasing=True)
    lab = rgb2lab(color)
    labels = _labels(lab, color, subject, tell)
    coverage = (labels == 1).astype(np.float64)
    if (labels == 0).any() and (labels == 2).any():
        with warnings.catch_warnings():
            # the solver's last digits leave [0, 1]; the result is clipped below
            warnings.filterwarnings("ignore", message="The probability range", category=UserWarning)
            coverage = random_walker(
                lab / 20, labels, beta=200, mode="cg_j", tol=1e-3, return_full_prob=True, channel_axis=-1
            )[0]
    coverage = np.clip(_without_specks(coverage), 0, 1)
    if (coverage > 0.5).mean() < MIN_SUBJECT:
        raise InputError(subject, "shows no subject that stands off its background", _CURE)
    if scale < 1:
        coverage = resize(coverage, (height, width), order=1)
    return np.clip(coverage, 0, 1).astype(np.float32)


def _labels(lab: np.ndarray, color: np.ndarray, subject: object, tell: Callable[[str], None]) -> np.ndarray:
    """Label pixels as _trimap does, by the difference from a plain background, else by GrabCut.

    lab and color (h, w, 3) are the same picture.
    """
    fitted = _background(lab)
    if fitted is None:
        labels = _labels_without_plain_background(color, subject)
        tell(
            f"{subject}: the background is not plain; the subject was cut out by its colors and may lack parts: look "
            f"at it, or give a mask"
        )
        return labels
    background, spread = fitted
    difference = lab - background
    weight = np.where(difference[..., :1] < 0, SHADOW_WEIGHT, 1.0) * (1, 0, 0) + (0, 1, 1)
    distance = np.sqrt(np.square(difference * weight).sum(-1))
    labels = _trimap(distance, max(SUBJECT_DISTANCE, SUBJECT_NOISE * spread), spread)
    if not (labels == 1).any():
        raise InputError(subject, "shows no subject that stands off its background", _CURE)
    if float((labels == 1).mean()) > MAX_SUBJECT:
        raise InputError(subject, "is filled by its subject, or its background is not plain", _CURE)
    return labels


def _labels_without_plain_background(color: np.ndarray, subject: object) -> np.ndarray:
    """Label pixels as _trimap does, by GrabCut; a band along its edge is undecided."""
    from scipy import ndimage

    from gdtool.images.cutout import cut_out

    inside = cut_out(color, subject, _CURE)
    labels = np.zeros(inside.shape, np.int32)
    labels[ndimage.binary_erosion(inside, iterations=2, border_value=1)] = 1
    labels[~ndimage.binary_dilation(inside, iterations=2)] = 2
    return labels


def _background(lab: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Fit a plain background to the border: a quadratic in x and y for each Lab channel.

    Returns the background's Lab (h, w, 3) and its noise. Pixels far from the fit are left out repeatedly, so a subject
    may touch a part of the border. None where no fit holds for more than half of it.
    """
    height, width = lab.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    ring = np.ones((height, width), bool)
    inset = max(2, round(BORDER_SHARE * min(height, width)))
    ring[inset:-inset, inset:-inset] = False
    samples, rows = lab[ring], basis[ring]
    # Start with the pixels near the median color, which a subject on the border hardly changes.
    keep = np.linalg.norm(samples - np.median(samples, 0), axis=1)
    keep = keep <= max(8.0, 3 * float(np.median(keep)))
    spread = 0.0
    for _ in range(10):
        fit = np.linalg.lstsq(rows[keep], samples[keep], rcond=None)[0]
        residual = np.linalg.norm(samples - rows @ fit, axis=1)
        spread = float(np.median(residual[keep]))
        again = residual <= max(3.0, 4 * spread)
        if (again == keep).all():
            break
        keep = again
        if keep.sum() < 50:
            break
    if keep.mean() < 0.5 or spread > MAX_NOISE:
        return None
    return basis @ fit, spread


def _trimap(distance: np.ndarray, sure: float, spread: float) -> np.ndarray:
    """Label pixels (h, w) by their colour distance (h, w) from the background.

    1 is the subject, 2 the background, 0 undecided. sure: the distance above which a pixel is the subject. spread: the
    noise of the background.
    """
    from scipy import ndimage

    near = distance < sure
    regions, count = ndimage.label(near)
    outside = np.zeros(count + 1, bool)
    outside[np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))] = True
    if count:
        # An enclosed part is a hole only where it is the background to within its noise, and of some size: a pale
        # part of the subject is not.
        index = np.arange(1, count + 1)
        mean = ndimage.mean(distance, regions, index)
        area = ndimage.sum_labels(near, regions, index)
        outside[1:] |= (mean < max(1.5, 2 * spread)) & (area > 0.001 * distance.size)
    outside[0] = False
    background = outside[regions]
    inside = ndimage.binary_opening(~background, iterations=1)
    labels = np.zeros(distance.shape, np.int32)
    labels[ndimage.binary_erosion(background, iterations=2, border_value=1)] = 2
    labels[
        ndimage.binary_erosion(
            inside & (distance > sure) | ndimage.binary_erosion(inside, iterations=3), iterations=1, border_value=1
        )
    ] = 1
    return labels


def _without_specks(coverage: np.ndarray) -> np.ndarray:
    """Remove pieces that are smaller than a hundredth of the largest."""
    from scipy import ndimage

    pieces, count = ndimage.label(coverage > 0.5)
    if count < 2:
        return coverage
    area = ndimage.sum_labels(np.ones_like(coverage), pieces, np.arange(count + 1))
    area[0] = 0
    small = area < 0.01 * area.max()
    small[0] = False
    return np.where(
        ndimage.binary_dilation(small[pieces], iterations=2) & ~(area >= 0.01 * area.max())[pieces], 0, coverage
    )
