"""Look up textures: wrap modes, bilinear filter, box-filtered mip levels, sRGB decoded before filtering."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from gdtool.assets.scene import Texture
from gdtool.core.threads import cores
from gdtool.images.color import linear_from_srgb

# Rows that a thread works on when a level is built; bounds the memory for a 4k texture.
BAND = 256
# Rows that are decoded at once: few enough that intermediate values stay in the cache.
CACHED_ROWS = 16
# DECODE_SHARE: lookups, as a share of the finest level's texels, above which it is cheaper to decode the whole level
# than single texels. MAX_DECODED: most float32 numbers of a level that is decoded whole (256 MB).
DECODE_SHARE = 0.15
MAX_DECODED = 1 << 26


def transform_uv(texture: Texture, uv: np.ndarray) -> np.ndarray:
    """Apply KHR_texture_transform to uv (n, 2): offset + rotation * (scale * uv).

    A positive angle turns uv counter-clockwise where v points down, so the picture turns clockwise.
    """
    if texture.rotation == 0.0 and texture.scale == (1.0, 1.0) and texture.offset == (0.0, 0.0):
        return uv
    c, s = np.cos(texture.rotation), np.sin(texture.rotation)
    u, v = uv[:, 0] * texture.scale[0], uv[:, 1] * texture.scale[1]
    return np.stack([c * u + s * v + texture.offset[0], -s * u + c * v + texture.offset[1]], 1)


def wrap_index(index: np.ndarray, size: int, wrap: str) -> np.ndarray:
    """Wrap texel indices (n,) int64 of any value into [0, size), by a glTF wrap mode."""
    if wrap == "clamp":
        return np.clip(index, 0, size - 1)
    if wrap == "mirror":
        folded = index % (2 * size)
        return np.where(folded < size, folded, 2 * size - 1 - folded)
    return index % size


def same_layout(texture: Texture) -> tuple:
    """Return a key of all properties that decide which texels, with which weights, a UV coordinate reads.

    Textures with the same key can be read together.
    """
    return (
        texture.uv_set,
        texture.offset,
        texture.rotation,
        texture.scale,
        texture.wrap_u,
        texture.wrap_v,
        texture.filter,
        texture.image.shape[:2],
        texture.image.dtype.str,
    )


class TextureReader:
    """Read textures of one layout (see same_layout) as linear float32, with their channels side by side.

    The finest level stays as the images store it. Coarser levels are box averages of about 2 x 2 texels, made when
    first needed. Several threads may read at once.
    """

    def __init__(self, *textures: Texture):
        self.texture = textures[0]
        self.images = [np.ascontiguousarray(t.image if t.image.ndim == 3 else t.image[..., None]) for t in textures]
        ends = np.cumsum([image.shape[2] for image in self.images])
        self.parts = [slice(int(end) - image.shape[2], int(end)) for image, end in zip(self.images, ends, strict=True)]
        self.colored = [t.encoding == "srgb" for t in textures]
        # Coarser levels: half the size, a quarter, …
        self.levels: list[np.ndarray] = []
        top = {"u1": 255, "u2": 65535}.get(self.images[0].dtype.str[1:])
        self._unit = np.float32(1.0 if top is None else 1.0 / top)
        self._table = (
            None if top is None else linear_from_srgb(np.arange(top + 1, dtype=self.images[0].dtype)).astype(np.float32)
        )
        self._lock = threading.Lock()
        # Number of lookups of the finest level so far, and that level decoded, once there are many.
        self._lookups = 0
        self._decoded: np.ndarray | None = None

    @property
    def channels(self) -> int:
        """Return the number of channels of all textures together."""
        return self.parts[-1].stop

    @property
    def depth(self) -> int:
        """Return the number of mip levels, down to one texel."""
        return max(self.images[0].shape[:2]).bit_length()

    def stored(self, index: np.ndarray) -> np.ndarray:
        """Decode texels of the finest level to (n, c) linear float32; alpha is never sRGB.

        index (n,): row-major.
        """
        out = np.empty((len(index), self.channels), np.float32)
        for image, part, colored in zip(self.images, self.parts, self.colored, strict=True):
            texels = np.take(image.reshape(-1, image.shape[2]), index, axis=0)
            self._decode(texels, colored, out[:, part])
        return out

    def _decode(self, texels: np.ndarray, colored: bool, out: np.ndarray) -> None:
        """Decode stored texels (..., c) of one image into out (..., c), linear float32.

        colored: whether the image is sRGB. Channels are decoded one at a time, since numpy is slow on rows as short as
        a texel.
        """
        for i, srgb in enumerate(_srgb_channels(texels.shape[-1], colored)):
            if srgb:
                out[..., i] = self._linear(texels[..., i])
            else:
                np.multiply(texels[..., i], self._unit, out=out[..., i], dtype=np.float32, casting="same_kind")

    def _linear(self, values: np.ndarray) -> np.ndarray:
        """Decode stored sRGB values of any shape to linear float32."""
        return (
            linear_from_srgb(values).astype(np.float32, copy=False)
            if self._table is None
            else np.take(self._table, values)
        )

    def level(self, k: int) -> np.ndarray:
        """Return level k: (h // 2^k, w // 2^k, c) linear float32, at least 1 by 1."""
        if k == 0:
            out = np.empty((*self.images[0].shape[:2], self.channels), np.float32)

            def decode(row: int) -> None:
                for image, part, colored in zip(self.images, self.parts, self.colored, strict=True):
                    for start in range(row, min(row + BAND, len(out)), CACHED_ROWS):
                        rows = slice(start, min(start + CACHED_ROWS, row + BAND))
                        self._decode(image[rows], colored, out[rows, :, part])

            _each_band(decode, len(out), BAND)
            return out
        with self._lock:
            while len(self.levels) < k:
                self._make_next()
            return self.levels[k - 1]

    def _decoded_level(self, k: int, count: int) -> np.ndarray | None:
        """Return level k decoded, or None where it is cheaper to decode only the texels of `count` more lookups."""
        if k:
            return self.level(k)
        with self._lock:
            texels = self.images[0].shape[0] * self.images[0].shape[1]
            self._lookups += count
            if (
                self._decoded is None
                and self._lookups > DECODE_SHARE * texels
                and texels * self.channels <= MAX_DECODED
            ):
                self._decoded = self.level(0)
            return self._decoded

    def _make_next(self) -> None:
        """Compute the next coarser level and append it to the levels."""
        finer = self.levels[-1:] or self.images
        parts = [slice(0, self.channels)] if self.levels else self.parts
        height, width = finer[0].shape[:2]
        coarse = np.empty((max(height // 2, 1), max(width // 2, 1), self.channels), np.float32)
        halve = self._halve_even if height % 2 == width % 2 == 0 else self._halve_odd
        # Coarser levels are linear already.
        colored = None if self.levels else self.colored

        def make(row: int) -> None:
            for i, (image, part) in enumerate(zip(finer, parts, strict=True)):
                halve(image, coarse[row : row + BAND // 2, :, part], row, None if colored is None else colored[i])

        _each_band(make, len(coarse), BAND // 2)
        self.levels.append(coarse)

    def _halve_even(self, finer: np.ndarray, out: np.ndarray, row: int, colored: bool | None) -> None:
        """Average 2 x 2 texels of finer (h, w, c) into out, the rows of the coarser level from `row` on.

        Both sides of finer are even. colored: whether it is stored in sRGB; None where it is linear float32 already.
        """
        band = finer[2 * row : 2 * (row + len(out))]
        wide = {"u1": np.uint16, "u2": np.uint32}.get(band.dtype.str[1:], np.float32)
        for i, srgb in enumerate(
            [False] * band.shape[2] if colored is None else _srgb_channels(band.shape[2], colored)
        ):
            values = band[..., i]
            if srgb:
                values = self._linear(values)
            # Sums of four stored integers are exact; so only a quarter as many numbers need scaling.
            pairs = np.add(values[0::2], values[1::2], dtype=np.float32 if srgb else wide)
            unit = np.float32(0.25) * (np.float32(1) if srgb or colored is None else self._unit)
            np.multiply(pairs[:, 0::2] + pairs[:, 1::2], unit, out=out[..., i], casting="same_kind", dtype=np.float32)

    def _halve_odd(self, finer: np.ndarray, out: np.ndarray, row: int, colored: bool | None) -> None:
        """Average as _halve_even, where a side is odd: a coarser texel covers parts of three finer ones, by area."""
        rows, columns = _area_shares(finer.shape[0])[:, row : row + len(out)], _area_shares(finer.shape[1])
        band = finer[2 * row : 2 * (row + len(out)) + 1]
        if colored is not None:
            linear = np.empty(band.shape, np.float32)
            self._decode(band, colored, linear)
            band = linear
        across = sum(share[:, None] * band[:, tap::2][:, : len(share)] for tap, share in enumerate(columns))
        out[...] = sum(share[:, None, None] * across[tap::2][: len(share)] for tap, share in enumerate(rows))

    def read(self, uv: np.ndarray, texels_per_sample: np.ndarray | None = None) -> np.ndarray:
        """Read (n, c) linear float32 at uv (n, 2), to which the texture transform is applied.

        texels_per_sample (n,): width of a sample's footprint, in texels of the finest level; NaN counts as 0. The
        coarsest level is read that is still sharp enough for the footprint. So supersampling converges to the finest
        level's box average.
        """
        uv = transform_uv(self.texture, np.nan_to_num(np.asarray(uv, np.float64), posinf=0.0, neginf=0.0))
        if texels_per_sample is None or self.depth == 1 or self.texture.filter == "nearest":
            return self._read_level(uv, 0)
        # fmax passes over NaN; the clip comes first, since infinity is no integer.
        wanted = np.clip(np.floor(np.log2(np.fmax(texels_per_sample, 1.0)) + 0.25), 0, self.depth - 1).astype(np.int64)
        low, high = int(wanted.min(initial=0)), int(wanted.max(initial=0))
        if low == high:
            return self._read_level(uv, low)
        out = np.empty((len(uv), self.channels), np.float32)
        for k in range(low, high + 1):
            chosen = np.flatnonzero(wanted == k)
            if len(chosen):
                out[chosen] = self._read_level(uv[chosen], k)
        return out

    def _read_level(self, uv: np.ndarray, k: int) -> np.ndarray:
        """Read (n, c) linear float32 from level k at transformed uv (n, 2)."""
        image = self._decoded_level(k, len(uv))
        height, width = self.images[0].shape[:2] if image is None else image.shape[:2]
        flat = None if image is None else image.reshape(-1, self.channels)

        def texels(index: np.ndarray) -> np.ndarray:
            return self.stored(index) if flat is None else np.take(flat, index, axis=0)

        # One period is enough for every wrap mode but clamp, and keeps huge coordinates exact enough.
        period = {"repeat": 1.0, "mirror": 2.0}
        u = uv[:, 0] % period[self.texture.wrap_u] if self.texture.wrap_u in period else np.clip(uv[:, 0], -1, 2)
        v = uv[:, 1] % period[self.texture.wrap_v] if self.texture.wrap_v in period else np.clip(uv[:, 1], -1, 2)
        x, y = u * width, v * height
        if self.texture.filter == "nearest":
            column = wrap_index(np.floor(x).astype(np.int64), width, self.texture.wrap_u)
            row = wrap_index(np.floor(y).astype(np.int64), height, self.texture.wrap_v)
            return texels(row * width + column)
        x, y = x - 0.5, y - 0.5
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
        x0, y0 = x0.astype(np.int64), y0.astype(np.int64)
        left, right = (wrap_index(x0 + i, width, self.texture.wrap_u) for i in (0, 1))
        top, bottom = (wrap_index(y0 + i, height, self.texture.wrap_v) * width for i in (0, 1))
        upper = _lerp(texels(top + left), texels(top + right), fx)
        return _lerp(upper, _lerp(texels(bottom + left), texels(bottom + right), fx), fy)


def _each_band(work, rows: int, band: int) -> None:
    """Call work(first row) for every band of `band` rows, in threads on all cores."""
    starts = range(0, rows, band)
    if len(starts) > 1:
        with ThreadPoolExecutor(cores()) as pool:
            list(pool.map(work, starts))
    else:
        work(0)


def _srgb_channels(channels: int, colored: bool) -> list[bool]:
    """List for each channel of an image whether it is sRGB; alpha never is."""
    last = channels if channels in (1, 3) else channels - 1
    return [colored and i < last for i in range(channels)]


def _area_shares(size: int) -> np.ndarray:
    """Compute the share by area of finer texels 2i, 2i + 1, … in coarser texel i: (taps, max(size // 2, 1)) float32."""
    half = size // 2
    if half == 0:
        return np.ones((1, 1), np.float32)
    if size % 2 == 0:
        return np.full((2, half), 0.5, np.float32)
    i = np.arange(half)
    return (np.stack([half - i, np.full(half, half), i + 1]) / size).astype(np.float32)


def _lerp(a: np.ndarray, b: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Interpolate a + fraction (b − a) for arrays that broadcast, overwriting b."""
    b -= a
    b *= fraction
    b += a
    return b
