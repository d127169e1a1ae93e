"""Find the subject of a picture: by a mask, its alpha, a network, or its difference from the background."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.images.color import rgba, srgb_from_linear, unit_range

WORKING_SIDE = 384  # pixels; larger pictures are segmented at this size
_MIN_WORKING_SIDE = 8  # pixels, of the shorter side of a very long picture at that size
# Shares of the picture that a subject may cover: less is a speck, with more there is too little background to judge by.
MIN_SUBJECT, MAX_SUBJECT = 0.002, 0.95
# A pixel is the subject from this distance to the background on, in Lab units: the larger of a fixed distance and a
# multiple of the background's noise.
SUBJECT_DISTANCE, SUBJECT_NOISE = 5.0, 5
SHADOW_WEIGHT = 0.5  # of lightness below the background's in the distance: a soft shadow darkens without changing hue
BORDER_SHARE = 0.03  # width of the border that the background is fitted to, as a share of the picture's side
MAX_NOISE = 5  # Lab units; a background with more noise is not plain

# Of the fit to the border. A color is left out where it is farther from the median color, or from the fit, than the
# larger of a distance in Lab units and a multiple of the median distance. The first fit has the looser bounds, since a
# gradient takes colors away from their median.
_START_DISTANCE, _START_NOISE = 8.0, 3
_FIT_DISTANCE, _FIT_NOISE = 3.0, 4
_FIT_ROUNDS = 10  # rounds at most; the fit ends sooner where the set of fitting pixels no longer changes
_MIN_FIT_PIXELS = 50  # pixels that a fit of six coefficients needs to mean something
_MIN_FIT_SHARE = 0.5  # of the border, that has to fit: a subject may cover the rest

# Of the regions inside the subject that look like background. A region is a hole where its mean distance is below the
# larger of a distance in Lab units and a multiple of the noise, and its area above this share of the picture:
# a pale part of the subject is not the background to within its noise, or not of that size.
_HOLE_DISTANCE, _HOLE_NOISE = 1.5, 2
_MIN_HOLE_SHARE = 0.001

# Of the band around the edge that stays undecided, pixels: the random walk finds the edge in it, so it has to hold the
# edge's blur on both sides.
_BACKGROUND_INSET, _SUBJECT_INSET = 2, 1
_SURE_INSET = 3  # pixels from the edge, beyond which a pixel of any color is the subject
_GRABCUT_BAND = 2  # pixels on both sides of GrabCut's edge

# Of specks: pieces that cover less than this share of the largest piece, and their blurred rim in pixels.
_SPECK_SHARE, _SPECK_RIM = 0.01, 2

# Of the random walk (skimage's random_walker): Lab units are divided by the first, to the order of 1; the second, beta,
# says how much a color difference hinders the walk.
_WALK_UNIT, _WALK_BETA = 20, 200
_CURE = "give a mask with --mask, a network with --matting, or cut the subject out (RGBA)"


def foreground(
    image: np.ndarray,
    mask: np.ndarray | None = None,
    subject: object = "image",
    warn: Callable[[str], None] = lambda text: None,
    network: str | Path | None = None,
) -> np.ndarray:
    """Find the coverage (h, w) of a picture's subject, float32 in [0, 1].

    image (h, w, c): as read_image returns it. mask (h, w[, c]): of the same size, the subject brighter or more opaque.
    subject: what errors name. warn: called with a sentence where the result is uncertain. network: the ONNX file of a
    segmentation network (matting.py).

    The first of these that applies gives the coverage: the mask; the picture's alpha, unless it is opaque everywhere;
    the network, where one is given; segmentation where the background is plain, gradients and soft shadows included;
    GrabCut where it is not. GrabCut guesses: one result in four that it does not refuse lacks a part or has too much
    (docs/benchmarks/cutout.md). So `warn` is called then.

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
    return _segmented(image, subject, warn)


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
        raise InputError(subject, f"has no subject that {network} can tell from its background", _CURE)
    return coverage


def _segmented(image: np.ndarray, subject: object, warn: Callable[[str], None]) -> np.ndarray:
    """Find the coverage (h, w) of the subject by its difference from a plain background.

    image (h, w, c): as read_image returns it. Pixels near the subject's edge get their share by random walks (Grady
    2006). warn: called with a sentence where the background is not plain.
    """
    from skimage.color import rgb2lab
    from skimage.segmentation import random_walker
    from skimage.transform import resize

    color = _encoded(image)
    height, width = color.shape[:2]
    scale = min(1.0, WORKING_SIDE / max(height, width))
    small = (max(_MIN_WORKING_SIDE, round(height * scale)), max(_MIN_WORKING_SIDE, round(width * scale)))
    if scale < 1:
        color = resize(color, small, order=1, anti_aliasing=True)
    lab = rgb2lab(color)
    labels = _labels(lab, color, subject, warn)
    coverage = (labels == 1).astype(np.float64)
    if (labels == 0).any() and (labels == 2).any():
        with warnings.catch_warnings():
            # the solver's last digits leave [0, 1]; the result is clipped below
            warnings.filterwarnings("ignore", message="The probability range", category=UserWarning)
            coverage = random_walker(
                lab / _WALK_UNIT, labels, beta=_WALK_BETA, mode="cg_j", tol=1e-3, return_full_prob=True, channel_axis=-1
            )[0]
    coverage = np.clip(_without_specks(coverage), 0, 1)
    if (coverage > 0.5).mean() < MIN_SUBJECT:
        raise InputError(subject, "shows no subject that stands out from its background", _CURE)
    if scale < 1:
        coverage = resize(coverage, (height, width), order=1)
    return np.clip(coverage, 0, 1).astype(np.float32)


def _labels(lab: np.ndarray, color: np.ndarray, subject: object, warn: Callable[[str], None]) -> np.ndarray:
    """Label pixels as subject (1), background (2) or undecided (0), by the difference from a plain background.

    Where the background is not plain GrabCut decides, and `warn` is called with a sentence. lab and color (h, w, 3) are
    the same picture in CIELAB and in sRGB.
    """
    fitted = _background(lab)
    if fitted is None:
        labels = _labels_without_plain_background(color, subject)
        warn(
            f"{subject}: the background is not plain; the subject was cut out by its colors and may lack parts: look "
            f"at it, or give a mask"
        )
        return labels
    background, noise = fitted
    difference = lab - background
    weight = np.where(difference[..., :1] < 0, SHADOW_WEIGHT, 1.0) * (1, 0, 0) + (0, 1, 1)
    distance = np.sqrt(np.square(difference * weight).sum(-1))
    labels = _trimap(distance, max(SUBJECT_DISTANCE, SUBJECT_NOISE * noise), noise)
    if not (labels == 1).any():
        raise InputError(subject, "shows no subject that stands out from its background", _CURE)
    if float((labels == 1).mean()) > MAX_SUBJECT:
        raise InputError(subject, "is filled by its subject, or its background is not plain", _CURE)
    return labels


def _labels_without_plain_background(color: np.ndarray, subject: object) -> np.ndarray:
    """Label pixels as subject (1), background (2) or undecided (0) by GrabCut; a band along the subject's edge is
    undecided.

    color (h, w, 3): sRGB in [0, 1].
    """
    from scipy import ndimage

    from gdtool.images.cutout import cut_out

    inside = cut_out(color, subject, _CURE)
    labels = np.zeros(inside.shape, np.int32)
    labels[ndimage.binary_erosion(inside, iterations=_GRABCUT_BAND, border_value=1)] = 1
    labels[~ndimage.binary_dilation(inside, iterations=_GRABCUT_BAND)] = 2
    return labels


def _background(lab: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Fit a plain background to the border of a picture: a quadratic in x and y for each Lab channel.

    lab (h, w, 3). Returns the background's Lab (h, w, 3) and its noise, the median distance from the fit in Lab units.
    Pixels far from the fit are left out repeatedly, so a subject may touch a part of the border. Returns None where no
    fit holds for more than half of the border.
    """
    height, width = lab.shape[:2]
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)
    ring = np.ones((height, width), bool)
    inset = max(2, round(BORDER_SHARE * min(height, width)))
    ring[inset:-inset, inset:-inset] = False
    samples, rows = lab[ring], basis[ring]
    # Start with the pixels near the median color, which a subject on the border hardly changes.
    distance = np.linalg.norm(samples - np.median(samples, 0), axis=1)
    keep = distance <= max(_START_DISTANCE, _START_NOISE * float(np.median(distance)))
    noise = 0.0
    for _ in range(_FIT_ROUNDS):
        fit = np.linalg.lstsq(rows[keep], samples[keep], rcond=None)[0]
        residual = np.linalg.norm(samples - rows @ fit, axis=1)
        noise = float(np.median(residual[keep]))
        fits = residual <= max(_FIT_DISTANCE, _FIT_NOISE * noise)
        if (fits == keep).all():
            break
        keep = fits
        if keep.sum() < _MIN_FIT_PIXELS:
            break
    if keep.mean() < _MIN_FIT_SHARE or noise > MAX_NOISE:
        return None
    return basis @ fit, noise


def _trimap(distance: np.ndarray, sure: float, noise: float) -> np.ndarray:
    """Label pixels as subject (1), background (2) or undecided (0) by their colour distance from the background.

    distance (h, w): in Lab units. sure: the distance above which a pixel is the subject. noise: the median distance of
    background pixels.
    """
    from scipy import ndimage

    near = distance < sure
    regions, count = ndimage.label(near)
    outside = np.zeros(count + 1, bool)
    outside[np.unique(np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]]))] = True
    if count:
        # Regions that do not touch the picture's border are holes, or pale parts of the subject.
        index = np.arange(1, count + 1)
        mean = ndimage.mean(distance, regions, index)
        area = ndimage.sum_labels(near, regions, index)
        outside[1:] |= (mean < max(_HOLE_DISTANCE, _HOLE_NOISE * noise)) & (area > _MIN_HOLE_SHARE * distance.size)
    outside[0] = False
    background = outside[regions]
    inside = ndimage.binary_opening(~background, iterations=1)
    labels = np.zeros(distance.shape, np.int32)
    labels[ndimage.binary_erosion(background, iterations=_BACKGROUND_INSET, border_value=1)] = 2
    certain = inside & (distance > sure) | ndimage.binary_erosion(inside, iterations=_SURE_INSET)
    labels[ndimage.binary_erosion(certain, iterations=_SUBJECT_INSET, border_value=1)] = 1
    return labels


def _without_specks(coverage: np.ndarray) -> np.ndarray:
    """Set the coverage (h, w) of pieces that are smaller than a hundredth of the largest to 0."""
    from scipy import ndimage

    pieces, count = ndimage.label(coverage > 0.5)
    if count < 2:
        return coverage
    area = ndimage.sum_labels(np.ones_like(coverage), pieces, np.arange(count + 1))
    area[0] = 0
    is_large = area >= _SPECK_SHARE * area.max()
    is_speck = ~is_large
    is_speck[0] = False
    specks = ndimage.binary_dilation(is_speck[pieces], iterations=_SPECK_RIM)
    return np.where(specks & ~is_large[pieces], 0, coverage)
