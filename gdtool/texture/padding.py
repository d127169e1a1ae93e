"""Filling the texels that no chart owns, so that filtering and mip levels never mix in a foreign colour."""

from __future__ import annotations

import numpy as np


def push_pull(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Fill the texels outside mask from those inside, near ones counting most; those inside stay as they are.

    image (h, w, c) or (h, w) float, mask (h, w) bool. Averages of what is known are pushed up a pyramid, and pulled down
    into what is not (Gortler et al. 1996, "The Lumigraph", section 3.5). An all-empty mask gives the image back.
    """
    flat = image.ndim == 2
    values = np.ascontiguousarray(image[..., None] if flat else image, np.float32)
    mask = np.asarray(mask, bool)
    if not mask.any() or mask.all():
        return image.copy()
    filled = _fill(values, mask.astype(np.float32))
    return filled[..., 0] if flat else filled


def _fill(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """values (h, w, c) where weight (h, w) in [0, 1] is 1, blended toward the coarser level's fill where it is less."""
    height, width = weight.shape
    if weight.min() > 0 or (height == 1 and width == 1):
        return values.copy()
    w, v = weight, values * weight[..., None]
    if height % 2 or width % 2:
        pad = ((0, height % 2), (0, width % 2))
        w, v = np.pad(w, pad), np.pad(v, (*pad, (0, 0)))
    pooled_w = w[0::2, 0::2] + w[1::2, 0::2] + w[0::2, 1::2] + w[1::2, 1::2]
    pooled_v = v[0::2, 0::2] + v[1::2, 0::2] + v[0::2, 1::2] + v[1::2, 1::2]
    del v
    known = pooled_w > 0
    pooled_v[known] /= pooled_w[known][:, None]
    coarse = _fill(pooled_v, np.minimum(pooled_w, 1))
    row, column = np.nonzero(weight < 1)
    return _blend(values, weight, coarse, row, column)


def _blend(values: np.ndarray, weight: np.ndarray, coarse: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """values with texels (row, column) blended toward the bilinear lookup of the level above, by what weight leaves."""
    out = values.copy()
    last_row, last_column = coarse.shape[0] - 1, coarse.shape[1] - 1
    # A texel's centre lies a quarter of a coarse texel from its parent's: weights 9, 3, 3, 1 sixteenths.
    r0, c0 = row // 2, column // 2
    r1 = np.clip(r0 + np.where(row % 2, 1, -1), 0, last_row)
    c1 = np.clip(c0 + np.where(column % 2, 1, -1), 0, last_column)
    looked = (9 * coarse[r0, c0] + 3 * coarse[r1, c0] + 3 * coarse[r0, c1] + coarse[r1, c1]) / 16
    share = weight[row, column][:, None]
    out[row, column] = share * out[row, column] + (1 - share) * looked
    return out


def fill_gutters(image: np.ndarray, mask: np.ndarray, padding: int | None = None, background: float | np.ndarray | None = None) -> np.ndarray:
    """Fill `padding` texels around the charts (all texels when None); farther ones get background (default: the mean).

    image (h, w, c) or (h, w) float, mask (h, w) bool of the texels that are known.
    """
    filled = push_pull(image, mask)
    if padding is None or not mask.any() or mask.all():
        return filled
    from scipy.ndimage import distance_transform_edt

    far = distance_transform_edt(~mask) > padding
    filled[far] = image[mask].mean(0) if background is None else background
    return filled
