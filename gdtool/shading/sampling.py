"""Points and directions that are spread evenly: Sobol points in a square, Fibonacci directions on a sphere."""

from __future__ import annotations

import numpy as np


def sobol(count: int, dimensions: int, seed: int) -> np.ndarray:
    """(count, dimensions) scrambled Sobol points in [0, 1); count a power of two keeps every aligned run stratified."""
    import torch

    return torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed).draw(count, dtype=torch.float64).numpy()


def fibonacci(count: int) -> np.ndarray:
    """(count, 3) unit directions spread evenly over the sphere."""
    i = np.arange(count) + 0.5
    y = 1 - 2 * i / count
    phi = i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - y * y)
    return np.stack([ring * np.cos(phi), y, ring * np.sin(phi)], 1)
