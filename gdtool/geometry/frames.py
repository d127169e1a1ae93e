"""Compute similarities between a source's frame and the normalised world frame."""

from __future__ import annotations

import numpy as np


def unit_box(vertices: np.ndarray) -> np.ndarray:
    """Return source_from_world (4, 4) for vertices (v, 3) in the source's frame.

    In the world frame their bounding box is centred and its longest side is 1.
    """
    low, high = vertices.min(0), vertices.max(0)
    out = np.eye(4)
    extent = float((high - low).max())
    out[:3, :3] *= extent if extent > 0 else 1.0
    out[:3, 3] = (low + high) / 2
    return out


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a (4, 4) affine matrix to points (n, 3)."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def invert_similarity(matrix: np.ndarray) -> np.ndarray:
    """Invert a (4, 4) similarity (rotation, uniform scale, translation)."""
    scale_squared = float((matrix[:3, 0] ** 2).sum())
    out = np.eye(4)
    out[:3, :3] = matrix[:3, :3].T / scale_squared
    out[:3, 3] = -out[:3, :3] @ matrix[:3, 3]
    return out
