"""Colour and normal encodings of stored pixels."""

from __future__ import annotations

import numpy as np


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1 encoding; negative values clip at 0, values above 1 follow the curve."""
    linear = np.maximum(linear, 0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(np.maximum(linear, 0.0031308), 1 / 2.4) - 0.055)


def linear_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Inverse of srgb_from_linear."""
    srgb = np.maximum(srgb, 0)
    return np.where(srgb <= 0.04045, srgb / 12.92, np.power((np.maximum(srgb, 0.04045) + 0.055) / 1.055, 2.4))


def encode_normal(normal: np.ndarray) -> np.ndarray:
    """Unit vectors (..., 3) to stored values in [0, 1]: 0.5 n + 0.5."""
    return np.clip(0.5 * np.asarray(normal) + 0.5, 0, 1)


def decode_normal(stored: np.ndarray) -> np.ndarray:
    """Stored values (..., 3) in [0, 1] to unit vectors; what decodes to nearly zero (a background of 0.5) becomes 0."""
    vector = 2 * np.asarray(stored, np.float32) - 1
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.where(length > 1e-2, vector / np.maximum(length, 1e-12), 0).astype(np.float32)
