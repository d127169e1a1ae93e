"""Restore thin parts that the grid lost: sheets without thickness, blades and wires finer than its step.

Every pixel's point must lie on the result. Where it does not, the part gets the least thickness that the grid can hold.
"""

from __future__ import annotations

import numpy as np

from gdtool.fields.views.prepared_view import WEAK, PreparedView, pixel_footprint
from gdtool.geometry.grids import Grid, sample_trilinear

HALF_THICKNESS = 0.6  # grid steps: over half, so that a sheet between two layers of samples has one inside
_LOST = 0.5  # grid steps outside the surface at which a point counts as lost
_DEPTH = 0.8  # grid steps below a seen surface at which there has to be an inside
_CHUNK = 4096  # points whose cubes of samples are held at once, some 35 KB each
_REGION = 8  # pixels of a connected region; a smaller one is noise at an edge


def missing_points(
    values: np.ndarray, before: np.ndarray, grid: Grid, views: list[PreparedView]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find points (n, 3) that views see outside the grid's surface, their normals (n, 3) and pixel sizes (n,).

    before: the distances before smoothing. A seen surface with no inside behind it there is a sheet.
    """
    from scipy.ndimage import label

    points, normals, sizes = [], [], []
    for view in views:
        if view.planes is None:
            continue
        # The centre of a pixel that the silhouette cuts may lie beside the object.
        sure = (view.weight > WEAK) & (view.mask > 0.95) & ~view.depth_edge
        lost = np.zeros(sure.shape, bool)
        inward = view.points[sure] - _DEPTH * grid.step * view.planes[sure][:, :3]
        hollow = (sample_trilinear(before, grid.locate(inward)) > 0) & ~view.not_smooth[sure]
        lost[sure] = hollow | (sample_trilinear(values, grid.locate(view.points[sure])) > _LOST * grid.step)
        regions, count = label(lost, np.ones((3, 3)))
        if count == 0:
            continue
        lost &= (np.bincount(regions.ravel()) >= _REGION)[regions]
        normal = view.planes[lost][:, :3]
        points.append(view.points[lost])
        normals.append(normal)
        distance = np.linalg.norm(view.points[lost] - view.camera.position, axis=1)
        sizes.append(pixel_footprint(view.camera, distance) / np.clip(normal @ view.camera.backward, 0.35, 1.0))
    if not points:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    return np.concatenate(points), np.concatenate(normals), np.concatenate(sizes)


def restore_thin_parts(
    values: np.ndarray, before: np.ndarray, grid: Grid, views: list[PreparedView]
) -> tuple[np.ndarray, np.ndarray]:
    """Add an inside where a seen region is lost; returns the signed distances and the thickened points (n, 3).

    before: the distances before smoothing, which may still hold a part that smoothing removed.
    """
    points, _, _ = missing_points(values, before, grid, views)
    if len(points) == 0:
        return values, points
    out = values.copy()
    for start in range(0, len(points), _CHUNK):
        around = _around(points[start : start + _CHUNK], grid, 2)[0].ravel()
        out.ravel()[around] = np.minimum(out.ravel()[around], before.ravel()[around])
    points, normals, sizes = missing_points(out, before, grid, views)
    for start in range(0, len(points), _CHUNK):
        part = slice(start, start + _CHUNK)
        index, place = _around(points[part], grid, 3)
        offset = place - points[part, None]
        height = np.einsum("nkj,nj->nk", offset, normals[part])
        lateral = np.linalg.norm(offset - height[..., None] * normals[part, None], axis=2)
        slab = np.maximum(np.abs(height) - HALF_THICKNESS * grid.step, lateral - 0.9 * sizes[part, None])
        np.minimum.at(out.ravel(), index.ravel(), slab.ravel().astype(np.float32))
    return out, points


def _around(points: np.ndarray, grid: Grid, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Return flat indices (n, k) of the samples in a cube around each point, and their positions (n, k, 3)."""
    steps = np.arange(-reach, reach + 1)
    cube = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    index = np.rint(grid.locate(points)).astype(np.int64)[:, None] + cube
    index = np.clip(index, 0, np.array(grid.shape) - 1)
    flat = (index[..., 0] * grid.shape[1] + index[..., 1]) * grid.shape[2] + index[..., 2]
    return flat, grid.origin + grid.step * index


def vertices_near(vertices: np.ndarray, points: np.ndarray, distance: float) -> np.ndarray:
    """Tell which vertices (v,) lie within distance of any of the points."""
    from scipy.spatial import cKDTree

    if len(points) == 0:
        return np.zeros(len(vertices), bool)
    return np.isfinite(cKDTree(points).query(vertices, distance_upper_bound=distance)[0])
