"""Hold, sample and meter environment lights: lat-long images of distant radiance.

A lat-long image (h, w, 3) holds linear radiance. Row 0 is straight up (+Y). A direction (x, y, z) is at column (0.5 +
atan2(z, x) / 2π) w, as in three.js: the middle of the image is +X, three quarters across is +Z. Radiance is constant
over a pixel, so that importance sampling and lookup agree exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

# Weights of linear sRGB channels in luminance (Rec. 709).
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])

# Radiance of a white card (albedo 0.8) under a metered light. So exposure 1 means the same for every environment.
METERED_WHITE = 0.8


@dataclass(frozen=True)
class Environment:
    """Hold a lat-long image (h, w, 3) of linear radiance >= 0.

    name: a bundled light's, or the file's. scale: factor between the file's radiance and the image's.
    """

    image: np.ndarray
    name: str = ""
    scale: float = 1.0

    @cached_property
    def solid_angles(self) -> np.ndarray:
        """Compute the exact solid angle (h,), in steradians, of a pixel of each row."""
        height, width = self.image.shape[:2]
        edges = np.cos(np.linspace(0, np.pi, height + 1))
        return (edges[:-1] - edges[1:]) * (2 * np.pi / width)

    @cached_property
    def directions(self) -> np.ndarray:
        """Compute the unit directions (h, w, 3) of the pixels' centres, each halving its pixel's solid angle."""
        height, width = self.image.shape[:2]
        edges = np.cos(np.linspace(0, np.pi, height + 1))
        y = 0.5 * (edges[:-1] + edges[1:])[:, None]
        phi = ((np.arange(width) + 0.5) / width - 0.5)[None] * 2 * np.pi
        ring = np.sqrt(np.maximum(1 - y * y, 0))
        return np.stack([ring * np.cos(phi), np.broadcast_to(y, (height, width)), ring * np.sin(phi)], -1)

    @cached_property
    def pdf(self) -> np.ndarray:
        """Compute the density (h, w), per steradian, with which sample() draws a pixel's directions.

        It is proportional to the brightest channel, with a small floor, and uniform for an environment without light.
        """
        value = self.image.max(-1) + 1e-4 * float(self.image.max(initial=0))
        mass = value * self.solid_angles[:, None]
        total = float(mass.sum())
        return value / total if total > 0 else np.full(value.shape, 1 / (4 * np.pi))

    def pixel_of(self, directions: np.ndarray) -> np.ndarray:
        """Find the flat index (n,) of the pixels that unit directions (n, 3) fall into."""
        height, width = self.image.shape[:2]
        row = np.arccos(np.clip(directions[:, 1], -1, 1)) * (height / np.pi)
        column = (np.arctan2(directions[:, 2], directions[:, 0]) * (0.5 / np.pi) + 0.5) * width
        return np.minimum(row.astype(np.int64), height - 1) * width + np.minimum(column.astype(np.int64), width - 1)

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """Look up the radiance (n, 3) from unit directions (n, 3)."""
        return self.image.reshape(-1, 3)[self.pixel_of(directions)]

    def sample(self, uniform: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Draw directions in proportion to the pdf, from uniform numbers (n, 2) in [0, 1).

        Returns unit directions (n, 3), their radiance (n, 3) and density (n,) per steradian.
        """
        height, width = self.image.shape[:2]
        mass = self.pdf * self.solid_angles[:, None]
        rows = np.cumsum(mass.sum(1))
        at = uniform[:, 0] * rows[-1]
        row = np.minimum(np.searchsorted(rows, at, side="right"), height - 1)
        sums = mass.sum(1)
        within_row = (at - (rows[row] - sums[row])) / np.maximum(sums[row], 1e-300)
        # All rows' cumulative sums, row r shifted by r, increase throughout: one search finds every column.
        columns = np.cumsum(mass / np.maximum(mass.sum(1, keepdims=True), 1e-300), 1)
        columns[:, -1] = 1.0
        increasing = (columns + np.arange(height)[:, None]).ravel()
        index = np.minimum(
            np.searchsorted(increasing, row + np.clip(uniform[:, 1], 0, 1 - 1e-12), side="right"), height * width - 1
        )
        column = np.clip(index - row * width, 0, width - 1)
        before = np.where(column > 0, columns[row, column - 1], 0.0)
        within_column = (uniform[:, 1] - before) / np.maximum(columns[row, column] - before, 1e-300)
        edges = np.cos(np.linspace(0, np.pi, height + 1))
        y = edges[row] + np.clip(within_row, 0, 1) * (edges[row + 1] - edges[row])
        phi = ((column + np.clip(within_column, 0, 1)) / width - 0.5) * 2 * np.pi
        ring = np.sqrt(np.maximum(1 - y * y, 0))
        directions = np.stack([ring * np.cos(phi), y, ring * np.sin(phi)], 1)
        return directions, self.image[row, column], self.pdf[row, column]

    def downsampled(self, height: int) -> Environment:
        """Halve the resolution while there are at least 2 * height rows, and both sides are even.

        Averages are weighted by solid angle, so the energy stays the same.
        """
        current = self
        while current.image.shape[0] >= 2 * height and not any(side % 2 for side in current.image.shape[:2]):
            weight = current.solid_angles
            weight = (weight / np.repeat(2 * (weight[0::2] + weight[1::2]), 2))[:, None, None]
            rows = current.image[0::2] * weight[0::2]
            rows += current.image[1::2] * weight[1::2]
            current = replace(self, image=rows[:, 0::2] + rows[:, 1::2])
        return current

    def subdivided(self, height: int) -> Environment:
        """Divide pixels into equal ones until there are at least `height` rows and 2 * height columns.

        A sum that evaluates the cosine at pixel centres errs by 1.6 % with 8 rows, by 0.02 % with 64.
        """
        times = max(-(-height // self.image.shape[0]), 1)
        across = max(-(-2 * height // self.image.shape[1]), 1)
        return self if times == across == 1 else replace(self, image=self.image.repeat(times, 0).repeat(across, 1))

    def irradiance(self, normals: np.ndarray) -> np.ndarray:
        """Integrate L max(0, n·l) dl for unit normals (n, 3): (n, 3). The sum runs over a copy with about 32 rows."""
        small = self.downsampled(32).subdivided(32)
        weighted = (small.image * small.solid_angles[:, None, None]).reshape(-1, 3)
        return np.maximum(normals @ small.directions.reshape(-1, 3).T, 0) @ weighted

    def metered(self) -> Environment:
        """Scale the light so that a white surface of albedo 0.8 reflects at most the luminance METERED_WHITE.

        The surface is turned toward the brightest of 288 directions. The light is metered and not the picture, so that
        a black object stays black.
        """
        around = Environment(np.zeros((12, 24, 3))).directions.reshape(-1, 3)
        brightest = float((self.irradiance(around) @ LUMINANCE).max()) * 0.8 / np.pi
        if brightest <= 0:
            return self
        factor = METERED_WHITE / brightest
        return replace(self, image=(self.image * factor).astype(np.float32), scale=self.scale * factor)
