"""Fuse materials on a surface's vertices from the views that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, project
from gdtool.geometry.meshes import TriMesh
from gdtool.images.sampling import bilinear

_SHARPEN = 4  # exponent of the cosine in a view's weight, so that the view that faces a point decides


@dataclass(frozen=True)
class Observations:
    """Hold how k views see v vertices: weight (k, v), 0 where hidden, and pixels (k, v, 2) as (x, y)."""

    weight: np.ndarray
    pixels: np.ndarray


def toward_camera(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Compute unit directions (n, 3) from points to the camera."""
    if camera.projection == "orthographic":
        return np.broadcast_to(camera.backward, points.shape)
    direction = camera.position - points
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def observe(cameras: list[Camera], mask: np.ndarray, mesh: TriMesh, normals: np.ndarray, offset: float) -> Observations:
    """Find which views (mask (k, h, w)) see which vertices, by rays against the surface.

    offset: world units by which a ray starts off the surface, along the normal and toward the camera. The weight is the
    cosine to a power, less beside the silhouette, where pixels average over the edge.
    """
    vertices = mesh.vertices
    from scipy.ndimage import minimum_filter

    from gdtool.geometry.rays import RayCaster

    caster = RayCaster(mesh)
    weights, places = [], []
    for camera, cover in zip(cameras, mask, strict=True):
        direction = toward_camera(camera, vertices)
        cosine = (direction * normals).sum(1)
        pixels, depth = project(camera, vertices)
        weight = np.zeros(len(vertices), np.float32)
        facing = np.flatnonzero((cosine > 0.05) & (depth > 0))
        origins = vertices[facing] + offset * (normals[facing] + direction[facing])
        free = ~caster.occluded(origins, np.ascontiguousarray(direction[facing]))
        seen = facing[free]
        full = bilinear(minimum_filter(cover, 3)[..., None], pixels[seen])[:, 0]
        partial = bilinear(cover[..., None], pixels[seen])[:, 0]
        weight[seen] = np.clip(cosine[seen], 0, 1) ** _SHARPEN * (0.05 * partial + 0.95 * full)
        weights.append(weight)
        places.append(pixels)
    return Observations(np.stack(weights), np.stack(places))


def fuse(
    images: np.ndarray, mask: np.ndarray, seen: Observations, sigma: float = 0.05
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fuse images (k, h, w, c) to one value a vertex: value (v, c), total weight (v,), residual (v,).

    A weighted mean, reweighted twice by each view's distance from it (Geman-McClure of scale sigma), so that a view
    that disagrees with the others loses. Unseen vertices get 0. The residual is the weighted mean distance.
    """
    samples = []
    for image, cover, pixels in zip(images, mask, seen.pixels, strict=True):
        both = bilinear(np.concatenate([image * cover[..., None], cover[..., None]], -1).astype(np.float32), pixels)
        samples.append(both[:, :-1] / np.maximum(both[:, -1:], 1e-6))
    sample = np.stack(samples)
    # The median is a start that a single wrong view cannot move; weights decide where only two views see a point.
    weight = seen.weight.copy()
    total = weight.sum(0)
    value = (weight[..., None] * sample).sum(0) / np.maximum(total, 1e-12)[:, None]
    for _ in range(2):
        gap = np.linalg.norm(sample - value, axis=-1) / np.sqrt(sample.shape[-1])
        weight = seen.weight / (1 + (gap / sigma) ** 2) ** 2
        value = (weight[..., None] * sample).sum(0) / np.maximum(weight.sum(0), 1e-12)[:, None]
    gap = np.linalg.norm(sample - value, axis=-1) / np.sqrt(sample.shape[-1])
    residual = (seen.weight * gap).sum(0) / np.maximum(total, 1e-12)
    return value, total, residual


def neighbour_matrix(faces: np.ndarray, count: int):
    """Build the symmetric sparse adjacency (count, count) of a mesh's vertices, with ones."""
    from scipy.sparse import coo_matrix

    rows = faces[:, [0, 1, 2]].ravel()
    columns = faces[:, [1, 2, 0]].ravel()
    graph = coo_matrix(
        (np.ones(2 * len(rows), np.float32), (np.r_[rows, columns], np.r_[columns, rows])), shape=(count, count)
    ).tocsr()
    graph.data[:] = 1.0
    return graph


def spread(values: np.ndarray, weight: np.ndarray, faces: np.ndarray, strength: float = 1e-2) -> np.ndarray:
    """Diffuse values (v, c) over the mesh into vertices of little weight (v,), nearly keeping the others.

    Solves (W + s L) x = W v + tiny pull to the weighted mean, L the graph Laplacian, by conjugate gradients, starting
    from a coarse-to-fine fill so that few iterations do.
    """
    from scipy.sparse import diags
    from scipy.sparse.linalg import cg

    graph = neighbour_matrix(faces, len(values))
    degree = np.asarray(graph.sum(1)).ravel()
    trust = np.minimum(weight, 1.0).astype(np.float64)
    mean = (trust[:, None] * values).sum(0) / max(trust.sum(), 1e-12)
    start = _flood(values, trust > 1e-3, graph, degree, mean)
    pull = 1e-6
    system = diags(trust + pull) + strength * (diags(degree) - graph)
    jacobi = diags(1.0 / (trust + pull + strength * degree))
    out = np.empty(values.shape, np.float32)
    for channel in range(values.shape[1]):
        right = trust * values[:, channel] + pull * mean[channel]
        out[:, channel] = cg(system, right, x0=start[:, channel], rtol=1e-5, maxiter=60, M=jacobi)[0]
    return out


def _flood(values, known, graph, degree, mean) -> np.ndarray:
    """Fill unknown values with the mean of their known neighbours, ring by ring."""
    out = np.where(known[:, None], values, 0.0).astype(np.float64)
    known = known.copy()
    while not known.all():
        count = graph @ known.astype(np.float64)
        ring = ~known & (count > 0)
        if not ring.any():
            out[~known] = mean
            break
        total = graph[ring] @ (out * known[:, None])
        out[ring] = total / count[ring, None]
        known |= ring
    return out


def confidence(weight: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Compute confidence (v,) in [0, 1]: it grows with the weight of the views and falls with their disagreement."""
    return ((1 - np.exp(-4 * weight)) * np.exp(-residual / 0.1)).astype(np.float32)
