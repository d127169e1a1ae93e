"""Fill the texels that no chart covers, so that filtering and mip levels mix in no foreign color."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

_ROWS_AT_ONCE = 32  # few enough that intermediate rows stay in the cache


class Gutters:
    """Fill the texels outside a mask (h, w) from those inside, by push and pull.

    Averages of known texels are pushed up a pyramid, and pulled down into unknown ones (Gortler et al. 1996, "The
    Lumigraph", section 3.5). Texels more than `padding` away from the mask get the channel's mean inside; None: no
    limit. The pyramid of weights is made once for all channels.
    """

    def __init__(self, mask: np.ndarray, padding: int | None = None):
        self.mask = np.asarray(mask, bool)
        self._empty = ~self.mask
        self._far = None
        if padding is not None and self.mask.any():
            from scipy.ndimage import distance_transform_edt

            self._far = distance_transform_edt(self._empty) > padding
        # For each level above the finest: weights in [0, 1], and the inverse of the sum of weights below.
        self._weights: list[np.ndarray] = []
        self._inverse: list[np.ndarray] = []
        weight = self.mask.astype(np.float32)
        while self.mask.any() and weight.min() == 0 and weight.size > 1:
            known = _summed(weight)
            self._inverse.append(np.divide(1, known, out=np.zeros_like(known), where=known > 0))
            weight = np.minimum(known, 1)
            self._weights.append(weight)

    def fill(self, channel: np.ndarray, background: float | None = None) -> np.ndarray:
        """Fill a channel (h, w) float32 in place and return it; it has to be 0 outside the mask.

        Far texels get `background` instead of the channel's mean, where it is given.
        """
        if not self._weights:
            return channel
        if self._far is not None and background is None:
            background = float(channel[self.mask].mean())
        levels = [_summed(channel) * self._inverse[0]]
        for weight, inverse in zip(self._weights, self._inverse[1:], strict=False):
            levels.append(_summed(levels[-1] * weight) * inverse)
        filled = levels.pop()
        while levels:
            value, weight = levels.pop(), self._weights[len(levels)]
            value *= weight
            value += (1 - weight) * _doubled(filled, value.shape)
            filled = value
        for rows, band in _doubled_rows(filled, channel.shape):
            np.copyto(channel[rows], band, where=self._empty[rows])
        if self._far is not None:
            channel[self._far] = background
        return channel


def _summed(image: np.ndarray) -> np.ndarray:
    """Sum 2 x 2 texels of (h, w); an odd last row or column is padded with 0."""
    height, width = image.shape
    if height % 2 or width % 2:
        image = np.pad(image, ((0, height % 2), (0, width % 2)))
    rows = image[0::2] + image[1::2]
    return rows[:, 0::2] + rows[:, 1::2]


def _doubled(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Enlarge an image (h, w) twofold, linearly, and crop it to shape."""
    out = np.empty(shape, image.dtype)
    for rows, band in _doubled_rows(image, shape):
        out[rows] = band
    return out


def _doubled_rows(image: np.ndarray, shape: tuple[int, int]) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield the rows of _doubled in bands.

    A texel's centre lies a quarter of a coarse texel from its parent's: linear weights are 3/4 and 1/4.
    """
    height, width = image.shape
    for first in range(0, height, _ROWS_AT_ONCE):
        rows = np.arange(first, min(first + _ROWS_AT_ONCE, height))
        near, out = image[rows] * np.float32(0.75), np.empty((2 * len(rows), 2 * width), image.dtype)
        for side in (0, 1):
            beside = image[np.clip(rows + 2 * side - 1, 0, height - 1)] * np.float32(0.25)
            beside += near
            column, other, line = beside * np.float32(0.75), beside * np.float32(0.25), out[side::2]
            np.add(column[:, 1:], other[:, :-1], out=line[:, 2::2])
            np.add(column[:, :-1], other[:, 1:], out=line[:, 1:-1:2])
            line[:, 0], line[:, -1] = column[:, 0] + other[:, 0], column[:, -1] + other[:, -1]
        end = min(2 * first + len(out), shape[0])
        yield slice(2 * first, end), out[: end - 2 * first, : shape[1]]


def push_pull(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Fill all texels outside mask (h, w) from those inside: image (h, w, c) or (h, w), float32.

    An empty mask returns the image unchanged.
    """
    return fill_gutters(image, mask)


def fill_gutters(
    image: np.ndarray, mask: np.ndarray, padding: int | None = None, background: float | None = None
) -> np.ndarray:
    """Fill `padding` texels around the mask, or all texels if it is None.

    Texels farther away get `background`, or the mean of the known texels if that is None. image (h, w, c) or (h, w)
    float; mask (h, w) bool of the known texels, which stay unchanged.
    """
    mask = np.asarray(mask, bool)
    if not mask.any() or mask.all():
        return image.copy()
    gutters = Gutters(mask, padding)
    out = np.empty(image.shape, np.float32)
    for k in np.ndindex(image.shape[2:]):
        out[(..., *k)] = gutters.fill(np.where(mask, image[(..., *k)], 0).astype(np.float32), background)
    return out
