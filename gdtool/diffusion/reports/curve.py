"""Draw a loss curve from CSV to an image without a plotting library."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np


def draw_curve(csv_path: Path, column: str = "loss", width: int = 640, height: int = 360) -> np.ndarray:
    """Draw a column of a CSV file on a logarithmic scale, one point a row, as an image (height, width, 3) uint8.

    Grey horizontal lines are powers of two. The light line shows the values, the dark line their running mean.
    """
    with csv_path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    picture = np.full((height, width, 3), 255, np.uint8)
    values = np.array([float(row[column]) for row in rows if row[column]])
    if len(values) < 2:
        return picture
    level = np.log2(np.maximum(values, 1e-8))
    low, high = np.floor(level.min()), np.ceil(level.max())
    high = max(high, low + 1)
    smooth = level.copy()
    for i in range(1, len(level)):
        smooth[i] = 0.95 * smooth[i - 1] + 0.05 * level[i]

    def row_of(y):
        """Map log2 values to rows of the picture."""
        return np.clip(((high - y) / (high - low) * (height - 20) + 10).astype(int), 0, height - 1)

    for y in np.arange(low, high + 1):
        picture[row_of(np.array(y)), :] = 220
    columns = np.arange(width)
    at = columns / (width - 1) * (len(level) - 1)
    for line, shade in ((level, (170, 190, 230)), (smooth, (20, 60, 140))):
        rows_at = row_of(np.interp(at, np.arange(len(line)), line))
        for x in columns:
            a, b = sorted((rows_at[x], rows_at[max(x - 1, 0)]))
            picture[a : b + 2, x] = shade
    return picture
