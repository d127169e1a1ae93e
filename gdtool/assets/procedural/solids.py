"""Build signed distance functions, negative inside, and their closed surfaces by marching cubes.

A distance is a function of points (n, 3) float32 that returns (n,) float32. Smooth blends after Inigo Quilez, "Smooth
minimum".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from gdtool.assets.procedural.parts import Part, box_projected, product, rotation, signed_volume, unit

Distance = Callable[[np.ndarray], np.ndarray]


def _length(vectors: np.ndarray) -> np.ndarray:
    """Compute the lengths (n,) of vectors (n, 3)."""
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def ellipsoid(center: ArrayLike, radii: ArrayLike) -> Distance:
    """Make an ellipsoid; the distance is exact for a sphere, else of first order near the surface."""
    middle, half = np.asarray(center, np.float32), np.broadcast_to(np.asarray(radii, np.float32), 3)

    def distance(points: np.ndarray) -> np.ndarray:
        offset = (points - middle) / half
        k0, k1 = _length(offset), _length(offset / half)
        return np.where(k1 > 1e-4, k0 * (k0 - 1) / np.maximum(k1, 1e-4), -half.min())

    return distance


def limb(start: ArrayLike, end: ArrayLike, radius: float, end_radius: float | None = None) -> Distance:
    """Make a capsule whose radius changes linearly from start to end."""
    a, b = np.asarray(start, np.float32), np.asarray(end, np.float32)
    grow = np.float32((radius if end_radius is None else end_radius) - radius)

    def distance(points: np.ndarray) -> np.ndarray:
        offset, axis = points - a, b - a
        t = np.clip(product(offset, axis) / max(float(axis @ axis), 1e-9), 0, 1)
        return _length(offset - t[:, None] * axis) - (radius + grow * t)

    return distance


def chain(
    points: Sequence[ArrayLike] | np.ndarray, radii: Sequence[float] | np.ndarray, blend: float = 0.03
) -> Distance:
    """Make a chain of blended limbs through points with radii."""
    return blended([limb(points[i], points[i + 1], radii[i], radii[i + 1]) for i in range(len(points) - 1)], blend)


def block(center: ArrayLike, half: ArrayLike, rounding: float = 0.02) -> Distance:
    """Make a box with rounded edges; half: its half sides, rounding included."""
    middle = np.asarray(center, np.float32)
    inner = np.maximum(np.asarray(half, np.float32) - rounding, 1e-3)

    def distance(points: np.ndarray) -> np.ndarray:
        q = np.abs(points - middle) - inner
        return _length(np.maximum(q, 0)) + np.minimum(q.max(axis=1), 0) - rounding

    return distance


def rod(center: ArrayLike, radius: float, half_length: float, axis: str = "y", rounding: float = 0.01) -> Distance:
    """Make a cylinder along a coordinate axis, its rims rounded."""
    middle, k = np.asarray(center, np.float32), "xyz".index(axis)
    others = [i for i in range(3) if i != k]

    def distance(points: np.ndarray) -> np.ndarray:
        offset = points - middle
        radial = np.hypot(offset[:, others[0]], offset[:, others[1]]) - (radius - rounding)
        along = np.abs(offset[:, k]) - (half_length - rounding)
        outside = np.hypot(np.maximum(radial, 0), np.maximum(along, 0))
        return outside + np.minimum(np.maximum(radial, along), 0) - rounding

    return distance


def ring(center: ArrayLike, radius: float, thickness: float, axis: str = "y") -> Distance:
    """Make a torus about a coordinate axis; thickness: the radius of its tube."""
    middle, k = np.asarray(center, np.float32), "xyz".index(axis)
    others = [i for i in range(3) if i != k]

    def distance(points: np.ndarray) -> np.ndarray:
        offset = points - middle
        return np.hypot(np.hypot(offset[:, others[0]], offset[:, others[1]]) - radius, offset[:, k]) - thickness

    return distance


def turned(shape: Distance, axis: str, degrees: float, about: ArrayLike = (0, 0, 0)) -> Distance:
    """Rotate a shape about a point."""
    matrix, pivot = rotation(axis, -degrees).astype(np.float32), np.asarray(about, np.float32)
    return lambda points: shape(product(points - pivot, matrix) + pivot)


def both_sides(shape: Distance) -> Distance:
    """Add a shape's mirror image in x; the shape is modelled at x >= 0."""
    return lambda points: shape(np.concatenate([np.abs(points[:, :1]), points[:, 1:]], axis=1))


def blended(shapes: Sequence[Distance], width: float) -> Distance:
    """Unite shapes, their joints rounded over `width` (quadratic smooth minimum)."""

    def distance(points: np.ndarray) -> np.ndarray:
        total = shapes[0](points)
        for shape in shapes[1:]:
            other = shape(points)
            overlap = np.maximum(width - np.abs(total - other), 0)
            total = np.minimum(total, other) - overlap * overlap / (4 * max(width, 1e-6))
        return total

    return distance


def _complement(shape: Distance) -> Distance:
    """Exchange inside and outside."""
    return lambda points: -shape(points)


def carved(shape: Distance, hole: Distance, width: float = 0.02) -> Distance:
    """Cut a hole out of a shape, the rim rounded over `width`."""
    negative = blended([_complement(shape), hole], width)
    return _complement(negative)


def common(shapes: Sequence[Distance], width: float = 0.02) -> Distance:
    """Intersect shapes, edges rounded over `width`."""
    negative = blended([_complement(shape) for shape in shapes], width)
    return _complement(negative)


def _axes(low: np.ndarray, high: np.ndarray, step: float) -> list[np.ndarray]:
    """Choose the sample positions along the three axes of a box, centred in it."""
    # Shifted off round numbers: a distance of exactly zero at a sample makes degenerate triangles.
    counts = np.ceil((high - low) / step).astype(int) + 1
    middle = (low + high) / 2 + step * np.array([0.0137, 0.0291, 0.0173])
    return [(middle[i] + step * (np.arange(counts[i]) - (counts[i] - 1) / 2)).astype(np.float32) for i in range(3)]


def _sampled(shape: Distance, axes: list[np.ndarray]) -> np.ndarray:
    """Evaluate a distance on the grid of three axes."""
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return shape(points).reshape([len(a) for a in axes])


def polygonised(shape: Distance, resolution: int = 52, reach: float = 1.6) -> Part:
    """Make the closed surface of a shape, which must lie inside the cube [-reach, reach].

    resolution: grid cells along the longest side of its bounding box. Raises ValueError where the shape is empty.
    """
    from skimage.measure import marching_cubes

    coarse = 2 * reach / 24
    low, high = np.full(3, -reach), np.full(3, reach)
    axes = _axes(low, high, coarse)
    inside = np.argwhere(_sampled(shape, axes) < 0.9 * coarse)
    if len(inside) == 0:
        raise ValueError("the shape has no inside")
    low = np.array([axes[i][inside[:, i].min()] for i in range(3)]) - coarse
    high = np.array([axes[i][inside[:, i].max()] for i in range(3)]) + coarse
    step = float((high - low).max() - 2 * coarse) / resolution
    axes = _axes(low, high, step)
    # The padding closes the surface where the box cuts the shape.
    values = np.pad(_sampled(shape, axes), 1, constant_values=step)
    # Values near zero would place several vertices in one point and make slivers.
    values = np.where(np.abs(values) < 0.01 * step, np.float32(0.01 * step), values)
    cells, faces, _, _ = marching_cubes(values, 0.0, allow_degenerate=True)
    vertices = (cells - 1) * step + np.array([a[0] for a in axes])
    offsets = 0.35 * step * np.eye(3, dtype=np.float32)
    queries = vertices.astype(np.float32)
    normals = unit(np.stack([shape(queries + o) - shape(queries - o) for o in offsets], -1).astype(float))
    if signed_volume(vertices, faces) < 0:
        faces = faces[:, ::-1]
    return box_projected(
        Part(vertices.astype(float), normals, np.ascontiguousarray(faces, dtype=np.int32), np.zeros((len(vertices), 2)))
    )
