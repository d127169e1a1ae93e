"""Convert colors and normals between the values that files store and those that gdtool computes with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_AT_ONCE = 1 << 15  # values at a time, so that intermediate arrays stay in the cache


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Encode linear values in [0, 1] as sRGB in [0, 1] (IEC 61966-2-1).

    float32 stays float32. Negative values give 0.
    """
    x = np.asarray(linear)
    return _by_blocks(_encoded, x if x.dtype.kind == "f" else x.astype(np.float32))


def _encoded(x: np.ndarray) -> np.ndarray:
    """Apply the sRGB curve."""
    x = np.maximum(x, 0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 0.0031308), 1 / 2.4) - 0.055)


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Decode sRGB values, in [0, 1] or as stored (uint8, uint16), to linear ones in [0, 1].

    The result is float32, for float64 float64.
    """
    return _by_blocks(_decoded, unit_range(encoded))


def _decoded(x: np.ndarray) -> np.ndarray:
    """Apply the inverse of the sRGB curve."""
    return np.where(x <= 0.04045, x / 12.92, np.power((np.maximum(x, 0.04045) + 0.055) / 1.055, 2.4))


def _by_blocks(curve: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """Apply a function to all values of x, as many at a time as stay in the processor's cache."""
    if x.size <= _AT_ONCE:
        return curve(x).astype(x.dtype)
    flat = x.ravel()
    out = np.empty_like(flat)
    for start in range(0, flat.size, _AT_ONCE):
        out[start : start + _AT_ONCE] = curve(flat[start : start + _AT_ONCE])
    return out.reshape(x.shape)


def unit_range(image: np.ndarray) -> np.ndarray:
    """Convert uint8 and uint16 as stored to float32 in [0, 1]; floats stay."""
    x = np.asarray(image)
    if x.dtype.kind in "ui":
        return x.astype(np.float32) / np.float32(np.iinfo(x.dtype).max)
    return x.astype(np.float32) if x.dtype == np.float16 else x


def encode_normal(normal: np.ndarray) -> np.ndarray:
    """Encode unit normals (..., 3) as 0.5 n + 0.5 in [0, 1]; the 0 of the background becomes 0.5."""
    return 0.5 * np.asarray(normal) + 0.5


def decode_normal(encoded: np.ndarray) -> np.ndarray:
    """Decode 0.5 n + 0.5 (..., 3), in [0, 1] or as stored (uint8, uint16), to unit normals.

    The middle value gives (0, 0, 0), as does anything that decodes to a length below 0.02: 8-bit storage has no exact
    0.5 (128 / 255 is 0.004 off).
    """
    n = 2 * unit_range(encoded) - 1
    length = np.linalg.norm(n, axis=-1, keepdims=True)
    return np.where(length > 0.02, n / np.maximum(length, 0.02), 0).astype(n.dtype)


def rgba(image: np.ndarray) -> np.ndarray:
    """Convert a stored image (h, w) or (h, w, 1..4) to (h, w, 4) float32 as encoded, alpha 1 where there is none."""
    x = unit_range(image).astype(np.float32)
    x = x.reshape(*x.shape[:2], -1)
    alpha = x[..., -1:] if x.shape[2] in (2, 4) else np.ones_like(x[..., :1])
    color = x[..., :3] if x.shape[2] >= 3 else np.repeat(x[..., :1], 3, -1)
    return np.concatenate([color, alpha], -1)
