"""Restore parts that the picture shows and the fused views lost, such as wings, chimneys and twigs.

Among views that a model made of one picture, only that picture's outline is certain. Each of its pixels has an object
behind it. Where the fused views leave nothing there, a slab is put between the depths of the picture's view and of the
view that faces it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gdtool.cameras import project
from gdtool.fields.views.prepared_view import PreparedView, pixel_footprint
from gdtool.geometry.grids import Grid, dilate
from gdtool.images.sampling import bilinear

LEAST_REGION_PX = 8  # pixels of a connected region; a smaller one is the outline's error
LEAST_WIDTH_PX, LEAST_DISTANCE_PX = (
    2,
    2.5,
)  # pixels: a region narrower than this, and nearer to what exists, is an edge's error
OVERLAP_PX = 2  # pixels of the existing object around a part that are filled too, so that it is joined
LEAST_HALF_WIDTH = 0.6  # grid steps: least half width of a part across the picture
LEAST_HALF_THICKNESS = 1.0  # grid steps: least half thickness of a part along the view
LEAST_ROUNDNESS = 0.7  # least thickness of a part as a share of its width
MOST_HALF_WIDTH_PX = 3.0  # pixels: bound of the half width that this thickness follows
INSIDE_MARGIN = (
    0.25  # grid steps outside the surface up to which a sample counts as inside; half a cell is lost between samples
)
DEPTH_BLUR_PX = 1.0  # pixels: Gaussian blur of the depths
_CHUNK = 1 << 16  # samples at a time


def opposite(views: Sequence[PreparedView], known: PreparedView) -> PreparedView | None:
    """Find the view that faces `known`, both orthographic and of one size, so that their outlines mirror one another.

    None where there is none.
    """
    facing = known.camera.world_from_camera[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    for view in views:
        if (
            known.camera.projection == view.camera.projection == "orthographic"
            and known.mask.shape == view.mask.shape
            and known.camera.pixel_size == view.camera.pixel_size
            and np.allclose(view.camera.world_from_camera[:3, :3], facing, atol=1e-6)
        ):
            return view
    return None


def missing_pixels(values: np.ndarray, grid: Grid, view: PreparedView) -> np.ndarray:
    """Find the pixels (h, w) bool of a view's mask behind which the distance grid has no inside; specks and edges are
    left out.
    """
    from scipy.ndimage import binary_opening, distance_transform_edt, label

    h, w = view.mask.shape
    inside = np.argwhere(values < INSIDE_MARGIN * grid.step)
    pixels = np.floor(project(view.camera, grid.points(inside))[0]).astype(np.int64)
    pixels = pixels[((pixels >= 0) & (pixels < (w, h))).all(1)]
    lost = view.mask > 0.5
    lost[pixels[:, 1], pixels[:, 0]] = False
    regions, count = label(lost, np.ones((3, 3)))
    away = distance_transform_edt(lost | (view.mask <= 0.5)) > LEAST_DISTANCE_PX
    telling = lost & (away | binary_opening(lost, np.ones((LEAST_WIDTH_PX, LEAST_WIDTH_PX))))
    kept = np.bincount(regions.ravel(), telling.ravel(), count + 1) >= LEAST_REGION_PX
    kept[0] = False
    return kept[regions]


def restore_picture_silhouette(
    values: np.ndarray, grid: Grid, views: Sequence[PreparedView], known: PreparedView
) -> tuple[np.ndarray, float]:
    """Add an inside behind every pixel of the known view's mask.

    values: signed distances (a, b, c) float32, negative inside. Returns the new distances, and the share of the mask
    that had no inside. Without a view from the other side a part is as thick as it is wide, up to twice
    MOST_HALF_WIDTH_PX.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter

    lost = missing_pixels(values, grid, known) if known.points is not None else np.zeros(known.mask.shape, bool)
    if not lost.any():
        return values, 0.0
    camera, mask = known.camera, known.mask > 0.5
    zone = dilate(lost, OVERLAP_PX) & mask
    first = _depth(known, zone)
    other = opposite(views, known)
    foot = pixel_footprint(camera, np.where(first > 0, first, 1.0))
    wide = np.minimum(distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1], MOST_HALF_WIDTH_PX) * foot
    last = first + 2 * wide
    if other is not None and other.points is not None:
        between = float((other.camera.position - camera.position) @ -camera.backward)
        behind = _depth(other, zone[:, ::-1])[:, ::-1]
        last = np.where(behind > 0, between - behind, last)
    middle, half = (
        (first + last) / 2,
        np.maximum((last - first) / 2, np.maximum(LEAST_ROUNDNESS * wide, LEAST_HALF_THICKNESS * grid.step)),
    )
    edge = (
        np.maximum(
            np.where(zone, 0.5 - distance_transform_edt(zone), distance_transform_edt(~zone) - 0.5), known.silhouette
        )
        * foot
    )
    edge -= np.maximum(LEAST_HALF_WIDTH * grid.step - maximum_filter(-edge, 3), 0.0)
    # Beyond the zone the nearest values within it.
    nearest = tuple(distance_transform_edt(~(zone & (first > 0)), return_distances=False, return_indices=True))
    slab = np.stack([middle[nearest], half[nearest], edge], -1).astype(np.float32)
    out = values.copy()
    flat = out.reshape(-1)
    for start in range(0, flat.size, _CHUNK):
        index = np.stack(np.unravel_index(np.arange(start, min(start + _CHUNK, flat.size)), grid.shape), -1)
        pixels, depth = project(camera, grid.points(index))
        at = bilinear(slab, pixels)
        distance = np.maximum(np.abs(depth - at[:, 0]) - at[:, 1], at[:, 2])
        flat[start : start + _CHUNK] = np.minimum(flat[start : start + _CHUNK], distance)
    return out, float(lost.sum() / mask.sum())


def _depth(view: PreparedView, zone: np.ndarray) -> np.ndarray:
    """Smooth a view's aligned depth (h, w) within the zone; 0 where it has none."""
    from scipy.ndimage import gaussian_filter

    has = zone & (view.weight > 0)
    depth = (view.points - view.camera.position) @ -view.camera.backward
    total = gaussian_filter(has.astype(np.float64), DEPTH_BLUR_PX)
    return np.where(
        zone & (total > 1e-3), gaussian_filter(np.where(has, depth, 0.0), DEPTH_BLUR_PX) / np.maximum(total, 1e-3), 0.0
    )
