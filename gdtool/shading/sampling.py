"""Make evenly spread points and directions, and orthonormal bases around normals."""

from __future__ import annotations

from typing import Any

import numpy as np


def sobol(count: int, dimensions: int, seed: int) -> np.ndarray:
    """Draw (count, dimensions) scrambled Sobol points in [0, 1).

    Where count is a power of two, every run of 2^k points that starts at a multiple of 2^k is stratified as well.
    """
    import torch

    return torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed).draw(count, dtype=torch.float64).numpy()


def fibonacci(count: int) -> np.ndarray:
    """Spread (count, 3) unit directions evenly over the sphere, on a Fibonacci spiral."""
    i = np.arange(count) + 0.5
    y = 1 - 2 * i / count
    phi = i * np.pi * (3 - np.sqrt(5))
    ring = np.sqrt(1 - y * y)
    return np.stack([ring * np.cos(phi), y, ring * np.sin(phi)], 1)


def orthonormal_basis(x, y, z):
    """Complete unit normals to right-handed orthonormal bases.

    x, y, z are the normals' components, arrays or tensors of one shape. Returns the tangent's three components and the
    bitangent's: tangent × bitangent = normal. The basis is continuous except at the plane z = 0 (Duff et al. 2017,
    "Building an Orthonormal Basis, Revisited").
    """
    if isinstance(z, np.ndarray):
        sign: Any = np.where(z < 0, -1, 1).astype(z.dtype)
    else:
        import torch

        sign = torch.where(z < 0, -1.0, 1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
