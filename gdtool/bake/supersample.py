"""Average several samples in the texels where the source varies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from gdtool.bake.target import TEXELS_AT_ONCE, Target, Texels
from gdtool.core.threads import mapped
from gdtool.geometry.tangents import unit
from gdtool.geometry.uv_raster import Barycentrics, owners_of

# The largest difference, in stored units, between neighbouring texels that need one sample each: eight steps of 8 bits.
TOLERANCE = 0.03
_COMPARED = ("albedo", "roughness", "metallic", "tangent_normal", "alpha", "emissive")
_ROWS_AT_ONCE = 64


def varying(
    texels: Texels, values: dict[str, np.ndarray], threads: int = 1, tolerance: float = TOLERANCE
) -> np.ndarray:
    """Find the texels (m,) with a value that differs from one of the eight neighbours' by more than `tolerance`.

    Values are compared as maps store them.
    """
    from gdtool.images.color import srgb_from_linear

    size, mask = texels.size, texels.mask()
    out = np.zeros((size, size), bool)
    for name in _COMPARED:
        if name not in values:
            continue
        for channel in np.moveaxis(values[name].reshape(len(texels), -1), 1, 0):
            image = texels.image(
                srgb_from_linear(np.clip(channel, 0, 1)) if name in ("albedo", "emissive") else channel
            )

            def compare(row: int, image: np.ndarray = image) -> None:
                rows, first = slice(max(row - 1, 0), row + _ROWS_AT_ONCE + 1), min(row, 1)
                low, high = (
                    _extreme(np.where(mask[rows], image[rows], worst), pick)[first : first + _ROWS_AT_ONCE]
                    for worst, pick in ((np.float32(np.inf), np.minimum), (np.float32(-np.inf), np.maximum))
                )
                out[row : row + _ROWS_AT_ONCE] |= high - low > tolerance

            for _ in mapped(compare, list(range(0, size, _ROWS_AT_ONCE)), threads):
                pass
    return np.flatnonzero(out.ravel()[texels.texel])


def _extreme(image: np.ndarray, pick: Callable) -> np.ndarray:
    """Apply pick (np.minimum or np.maximum) to each texel of (h, w) and its eight neighbours."""
    for axis in (0, 1):
        image = np.moveaxis(image, axis, 0)
        out = image.copy()
        pick(out[1:], image[:-1], out=out[1:])
        pick(out[:-1], image[1:], out=out[:-1])
        image = np.moveaxis(out, 0, axis)
    return image


def supersample(
    target: Target,
    texels: Texels,
    values: dict[str, np.ndarray],
    read: Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]],
    samples: int,
    threads: int = 1,
) -> float:
    """Replace the values (n, …) of varying texels by means over several samples; changes `values`.

    samples: per texel, a square number. read(face_idx, barycentric) returns values by name at points of the target.
    Each sample is read in the triangle that covers it; a sample that no triangle covers is left out. So a texel gets
    the mean over the part of it that charts cover. A texel without a covered sample keeps its value. Color is weighted
    by alpha, and tangent_normal is scaled to unit length. Returns the share of texels that vary.
    """
    side, size, chosen = int(round(samples**0.5)), texels.size, varying(texels, values, threads)
    barycentrics, texel = Barycentrics(target.uv, target.face_uvs), texels.texel[chosen]
    offsets = [((k % side + 0.5) / side, (k // side + 0.5) / side) for k in range(side * side)]

    def owners(offset: tuple[float, float]) -> np.ndarray:
        return owners_of(target.uv + (0.5 - np.array(offset)) / size, target.face_uvs, size)[texel]

    owned = list(mapped(owners, offsets, threads))

    def run(part: slice) -> None:
        def sample_values() -> Iterator[tuple[np.ndarray, dict[str, np.ndarray]]]:
            for (along, down), owner in zip(offsets, owned, strict=True):
                covered = np.flatnonzero(owner[part] >= 0)
                face_idx, at = owner[part][covered], texel[part][covered]
                place = np.clip(barycentrics.at(face_idx, (at % size + along) / size, (at // size + down) / size), 0, 1)
                yield covered, read(face_idx, (place / place.sum(1, keepdims=True)).astype(np.float32))

        known, means = _means(sample_values(), part.stop - part.start, values)
        for name, mean in means.items():
            values[name][chosen[part][known]] = mean

    step = TEXELS_AT_ONCE // 4
    for _ in mapped(run, [slice(s, min(s + step, len(chosen))) for s in range(0, len(chosen), step)], threads):
        pass
    return float((chosen < texels.inside).sum() / max(texels.inside, 1))


def _means(
    sample_values: Iterable[tuple[np.ndarray, dict[str, np.ndarray]]], count: int, like: dict[str, np.ndarray]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Average samples of `count` texels: returns the texels with any sample (m,), and the means (m, …) by name.

    sample_values: yields once for each sample position in a texel: the texels (k,) that are covered there, and their
    values (k, …) by name. like: values with the names and shapes to average.
    """
    total = {name: np.zeros((count, *value.shape[1:]), np.float32) for name, value in like.items()}
    samples, alpha_sum = np.zeros(count, np.float32), np.zeros(count, np.float32)
    for covered, read in sample_values:
        samples[covered] += 1
        if "alpha" in read:
            alpha = np.maximum(read["alpha"], np.float32(1e-4))
            alpha_sum[covered] += alpha
            read["albedo"] = read["albedo"] * alpha[:, None]
        for name, sums in total.items():
            sums[covered] += read[name]
    known = np.flatnonzero(samples)
    out = {}
    for name, sums in total.items():
        weight = (alpha_sum if name == "albedo" and "alpha" in total else samples)[known]
        mean = sums[known] / weight.reshape(-1, *[1] * (sums.ndim - 1))
        out[name] = unit(mean) if name == "tangent_normal" else mean
    return known, out
