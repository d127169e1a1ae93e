"""Cut a subject out of a busy background by GrabCut (Rother et al. 2004, OpenCV), and refuse an uncertain result."""

from __future__ import annotations

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.native import imported

INSETS = (0.02, 0.06)  # widths of the two frames that are taken for background, as shares of the picture
# Least intersection over union of the two frames' results; docs/benchmarks/cutout.md measures how many wrong results it
# refuses.
AGREEMENT = 0.85
MIN_SUBJECT, MAX_SUBJECT = 0.005, 0.8  # shares of the picture that a subject may cover; others are refused


def cut_out(color: np.ndarray, subject: object, cure: str) -> np.ndarray:
    """Find the one subject inside a picture; returns a boolean mask (h, w).

    color (h, w, 3): sRGB in [0, 1]. The colors along the picture's edge are taken for background, in a narrow and in a
    wide frame. Where the two results differ, colors do not tell the subject from its background, and InputError is
    raised with `cure`.
    """
    _, wide, agreement = both_frames(color)
    if agreement < AGREEMENT or not MIN_SUBJECT < float(wide.mean()) < MAX_SUBJECT:
        raise InputError(
            subject, "has a background that is not plain, and its colors do not tell the subject from it", cure
        )
    return wide


def both_frames(color: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Segment a picture by GrabCut twice: with a narrow and with a wide frame along its edge taken for background.

    color (h, w, 3): sRGB in [0, 1]. Returns both foreground masks (h, w), boolean, and their intersection over union.
    """
    narrow, wide = (_grabcut(color, inset) for inset in INSETS)
    either = (narrow | wide).sum()
    return narrow, wide, float((narrow & wide).sum() / either) if either else 0.0


def _grabcut(color: np.ndarray, inset: float) -> np.ndarray:
    """Return the largest piece of GrabCut's foreground, with its holes."""
    from scipy import ndimage

    cv2 = imported("cv2")
    height, width = color.shape[:2]
    picture = np.ascontiguousarray(np.rint(np.clip(color[..., ::-1], 0, 1) * 255).astype(np.uint8))
    margin_x, margin_y = (max(2, round(inset * side)) for side in (width, height))
    labels = np.full((height, width), cv2.GC_BGD, np.uint8)
    labels[margin_y:-margin_y, margin_x:-margin_x] = cv2.GC_PR_FGD
    threads = cv2.getNumThreads()
    cv2.setRNGSeed(0)  # the colors' first clustering is random
    cv2.setNumThreads(1)
    try:
        cv2.grabCut(picture, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 6, cv2.GC_INIT_WITH_MASK)
    finally:
        cv2.setNumThreads(threads)
    foreground = ndimage.binary_opening((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))
    pieces, count = ndimage.label(foreground)
    if not count:
        return foreground
    return pieces == 1 + int(np.argmax(ndimage.sum_labels(foreground, pieces, np.arange(1, count + 1))))
