"""Multiply vectors stored coordinate by coordinate, (3, ...), which is several times faster than (..., 3)."""

from __future__ import annotations

import numpy as np


def cross(a, b) -> np.ndarray:
    """Return the vector products (3, ...) of a and b, each three arrays (...) or one (3, ...)."""
    out = np.empty((3, *np.broadcast(a[0], b[0]).shape), np.result_type(a[0], b[0]))
    for product, (j, k) in zip(out, ((1, 2), (2, 0), (0, 1)), strict=True):
        np.multiply(a[j], b[k], out=product)
        product -= a[k] * b[j]
    return out


def dot(a, b) -> np.ndarray:
    """Return the scalar products (...) of a and b, each three arrays (...) or one (3, ...)."""
    out = a[0] * b[0]
    out += a[1] * b[1]
    out += a[2] * b[2]
    return out
