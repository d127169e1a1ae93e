"""Encodings of colours and normals in files."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

_AT_ONCE = 1 << 15  # numbers: what is computed of them stays in the cache


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Linear values [0, 1] -> sRGB-encoded [0, 1] (IEC 61966-2-1); float32 stays float32. Negative values give 0."""
    x = np.asarray(linear)
    return _by_blocks(_encoded, x if x.dtype.kind == "f" else x.astype(np.float32))


def _encoded(x: np.ndarray) -> np.ndarray:
    x = np.maximum(x, 0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 0.0031308), 1 / 2.4) - 0.055)


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """sRGB-encoded [0, 1] (or uint8, uint16 as stored) -> linear [0, 1], float32 unless float64 is given."""
    return _by_blocks(_decoded, unit_range(encoded))


def _decoded(x: np.ndarray) -> np.ndarray:
    return np.where(x <= 0.04045, x / 12.92, np.power((np.maximum(x, 0.04045) + 0.055) / 1.055, 2.4))


def _by_blocks(curve: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> np.ndarray:
    """curve of each of x, some at a time."""
    if x.size <= _AT_ONCE:
        return curve(x).astype(x.dtype)
    flat = x.ravel()
    out = np.empty_like(flat)
    for start in range(0, flat.size, _AT_ONCE):
        out[start : start + _AT_ONCE] = curve(flat[start : start + _AT_ONCE])
    return out.reshape(x.shape)


def unit_range(image: np.ndarray) -> np.ndarray:
    """uint8 and uint16 as stored -> float32 [0, 1]; floats as they are."""
    x = np.asarray(image)
    if x.dtype.kind in "ui":
        return x.astype(np.float32) / np.float32(np.iinfo(x.dtype).max)
    return x.astype(np.float32) if x.dtype == np.float16 else x


def encode_normal(normal: np.ndarray) -> np.ndarray:
    """Return unit normals (..., 3), or 0 for background -> 0.5 n + 0.5 in [0, 1]."""
    return 0.5 * np.asarray(normal) + 0.5


def decode_normal(encoded: np.ndarray) -> np.ndarray:
    """0.5 n + 0.5 (..., 3) in [0, 1] (or uint8, uint16) -> unit normals; (0, 0, 0) where the stored value is the
    middle.

    Shorter than 0.02 is the middle: 8-bit storage has no exact 0.5 (128 / 255 is 0.004 off it).
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
