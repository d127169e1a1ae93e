"""Read the materials of surface points from the views that see them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gdtool.cameras import Camera, project, rays
from gdtool.geometry.tangents import dot, unit

# The least cosine between normal and viewing direction at which a view is read: below, its pixels are too stretched.
MIN_FACING_COSINE = 0.12
# Rays per pixel and direction when a camera's visibility is traced.
_RAYS_PER_PIXEL_SIDE = 2
# The largest difference, in stored units of [0, 1], between views that agree.
AGREEMENT_TOLERANCE = 0.15
# Factor on the quality of the reference view for colors, up to that of a view that faces the surface: it is the picture
# that the other views were generated from.
REFERENCE_GAIN = 4.0


@dataclass(frozen=True)
class ViewVisibility:
    """The depths and silhouettes of a surface in one camera's image, for each pixel.

    nearest, farthest (h, w): depths of the pixel's nearest and farthest sample; inf and -inf where all miss.
    edge_distance (h, w): pixels to the nearest silhouette or depth step, at least 0.5.
    """

    camera: Camera
    nearest: np.ndarray
    farthest: np.ndarray
    edge_distance: np.ndarray


@dataclass(frozen=True)
class ViewStack:
    """Images of k views, to be read together.

    values (k, h, w, c): as stored, in [0, 1], not premultiplied; mask (k, h, w): coverage. reference: index of the view
    that the others were generated from, None where there is none. color_channels: the number of leading channels that
    are colors; the reference has priority in these.
    """

    visibilities: list[ViewVisibility]
    values: np.ndarray
    mask: np.ndarray
    reference: int | None = None
    color_channels: int = 0


class Observation(NamedTuple):
    """The blend of views at n points: values (n, c), confidence (n,) in [0, 1], and each view's share (k, n)."""

    values: np.ndarray
    confidence: np.ndarray
    shares: np.ndarray


def view_visibility(camera: Camera, caster, mask: np.ndarray) -> ViewVisibility:
    """Trace the depths and silhouettes of a surface in a camera's image.

    mask (h, w): the view's coverage in [0, 1]; its border counts as a silhouette.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

    h, w, n = camera.height, camera.width, _RAYS_PER_PIXEL_SIDE
    x, y = np.meshgrid((np.arange(w * n) + 0.5) / n, (np.arange(h * n) + 0.5) / n)
    origins, directions = rays(camera, np.stack([x, y], -1))
    hits = caster.first_hit(origins.reshape(-1, 3), directions.reshape(-1, 3))
    along = -(directions.reshape(-1, 3) @ camera.backward)
    miss = hits.face_idx < 0
    depth = np.where(miss, np.inf, hits.distance * along)
    samples = depth.reshape(h, n, w, n).swapaxes(1, 2).reshape(h, w, n * n)
    missed = np.isinf(samples)
    nearest, farthest = samples.min(-1), np.where(missed, -np.inf, samples).max(-1)
    # A depth step: neighbouring pixels differ by more than on a surface that is tilted by 80 degrees.
    span = maximum_filter(np.where(np.isinf(farthest), camera.far, farthest), 3) - minimum_filter(
        np.where(np.isinf(nearest), camera.far, nearest), 3
    )
    step = span > 2 * pixel_footprint(camera, np.where(np.isinf(nearest), camera.far, nearest)) * np.tan(np.radians(80))
    edge = step | missed.any(-1) | (mask < 0.999)
    edge = np.pad(edge, 1, constant_values=True)
    return ViewVisibility(camera, nearest, farthest, np.maximum(distance_transform_edt(~edge)[1:-1, 1:-1], 0.5))


def pixel_footprint(camera: Camera, depth: np.ndarray | float) -> np.ndarray | float:
    """Compute the width in world units of a pixel at a depth along the viewing axis."""
    return camera.pixel_size + 0 * depth if camera.projection == "orthographic" else depth / camera.fx


def _toward(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Compute unit directions (n, 3) from points to the camera."""
    if camera.projection == "orthographic":
        return np.broadcast_to(camera.backward, points.shape)
    return unit(camera.position - points)


def _read(
    visibility: ViewVisibility,
    image: np.ndarray,
    mask: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Read one view at the points that it shows: their indices (m,), values (m, c), quality (m,) in [0, 1].

    image (h, w, c) and mask (h, w) are the view's. Values are interpolated between those of the four nearest pixels
    that lie inside the mask and at the point's depth. So neither the background nor an occluder is mixed in.
    """
    camera = visibility.camera
    cosine = dot(normals, _toward(camera, points))
    facing = np.flatnonzero(cosine > MIN_FACING_COSINE)
    pixel, depth = project(camera, points[facing])
    h, w = mask.shape
    seen = (pixel[:, 0] > 0) & (pixel[:, 1] > 0) & (pixel[:, 0] < w) & (pixel[:, 1] < h) & (depth > 0)
    facing, pixel, depth = facing[seen], pixel[seen] - 0.5, depth[seen]
    cosine = cosine[facing]
    slope = np.sqrt(np.maximum(1 - cosine**2, 0)) / cosine
    tolerance = pixel_footprint(camera, depth) * (1.0 + 1.5 * slope)
    corner = np.floor(pixel).astype(np.int64)
    fraction = pixel - corner
    weight_sum, edge_distance = np.zeros(len(facing)), np.zeros(len(facing))
    value = np.zeros((len(facing), image.shape[-1]))
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = np.clip(corner[:, 0] + dx, 0, w - 1), np.clip(corner[:, 1] + dy, 0, h - 1)
        share = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1])
        here = (visibility.nearest[row, column] >= depth - tolerance) & (
            visibility.farthest[row, column] <= depth + tolerance
        )
        weight = np.where(here, share * mask[row, column], 0)
        weight_sum += weight
        edge_distance += weight * visibility.edge_distance[row, column]
        value += weight[:, None] * image[row, column]
    read = weight_sum > 1e-3
    facing, value, edge_distance, weight_sum = facing[read], value[read], edge_distance[read], weight_sum[read]
    cosine = cosine[read]
    value /= weight_sum[:, None]
    # Quality rises from 0.3 at a silhouette, still better than nothing, to 1 three pixels from it.
    away = np.clip(0.3 + 0.7 * (edge_distance / weight_sum - 0.5) / 2.5, 0.3, 1.0)
    return facing, value, cosine * away * weight_sum


def silhouette_margin(visibility: ViewVisibility, points: np.ndarray) -> np.ndarray:
    """Rate how far points (n, 3) are from silhouettes and depth steps: 0 within one pixel, 1 from two pixels on."""
    pixel = np.floor(project(visibility.camera, points)[0]).astype(np.int64)
    h, w = visibility.edge_distance.shape
    return np.clip(visibility.edge_distance[np.clip(pixel[:, 1], 0, h - 1), np.clip(pixel[:, 0], 0, w - 1)] - 1, 0, 1)


def observe(
    points: np.ndarray,
    normals: np.ndarray,
    views: ViewStack,
    prior: np.ndarray | None = None,
    sharpness: float = 6.0,
) -> Observation:
    """Blend the values of all views at points (n, 3) of the surface with unit normals (n, 3).

    A view's quality grows with facing, distance to silhouettes and coverage. Its weight is its quality to the power
    `sharpness`: the best view dominates, so that detail is not averaged away, yet the change from one view to another
    is smooth. A view that differs from the others and from prior (n, c) fades out; the reference view never does. In
    the color channels the reference's quality is multiplied by REFERENCE_GAIN, up to 1.

    The confidence is 0 where no view sees a point. With a reference, the shares returned are those of the color
    channels.
    """
    count, channels = len(points), views.values.shape[-1]
    value = np.zeros((len(views.visibilities), count, channels), np.float32)
    quality = np.zeros((len(views.visibilities), count), np.float32)
    low, high = np.full((count, channels), np.inf, np.float32), np.full((count, channels), -np.inf, np.float32)
    if prior is not None:
        low, high = prior.astype(np.float32), prior.astype(np.float32)
    for k, visibility in enumerate(views.visibilities):
        seen, read, good = _read(visibility, views.values[k], views.mask[k], points, normals)
        value[k, seen], quality[k, seen] = read, good
        low[seen], high[seen] = np.minimum(low[seen], read), np.maximum(high[seen], read)
    reference, colors = views.reference, views.color_channels
    best = quality.max(0)
    confidence = np.clip((best - 0.04) / 0.11, 0, 1)
    share = quality / np.maximum(best, 1e-6)
    disputed = np.flatnonzero((high - low > AGREEMENT_TOLERANCE).any(1))
    if len(disputed):
        faded = _fade_outliers(value[:, disputed], share[:, disputed], None if prior is None else prior[disputed])
        if reference is not None:
            faded[reference] = share[reference, disputed]
        share[:, disputed] = faded
    weight = share**sharpness
    total = weight.sum(0)
    mean = np.einsum("kn,knc->nc", weight / np.maximum(total, 1e-12), value)
    if reference is not None:
        weight[reference] *= np.minimum(REFERENCE_GAIN, 1 / np.maximum(quality[reference], 1e-6)) ** sharpness
        mean[:, :colors] = np.einsum("kn,knc->nc", weight / np.maximum(weight.sum(0), 1e-12), value[..., :colors])
    weight /= np.maximum(weight.sum(0), 1e-12)
    return Observation(mean.astype(np.float32), np.where(total > 0, confidence, 0).astype(np.float32), weight)


def _fade_outliers(value: np.ndarray, share: np.ndarray, prior: np.ndarray | None) -> np.ndarray:
    """Lower the shares (k, n) of views whose value (k, n, c) is far from the median of all views and prior (n, c).

    This needs at least three values at a point, prior included. The loss grows gradually, from half of
    AGREEMENT_TOLERANCE to twice it, so that no edge appears on the surface where a view stops counting. A share keeps
    at least 5 % of itself, so that one view always counts.
    """
    opinions = np.where((share > 0)[..., None], value, np.nan)
    if prior is not None:
        opinions = np.concatenate([opinions, prior[None].astype(np.float32)])
    number = (~np.isnan(opinions[..., 0])).sum(0)
    # nanmedian is slow: NaN sorts last, so the median's place follows from the number of opinions.
    ordered = np.sort(opinions, axis=0)
    middle, column = (np.maximum(number, 1) - 1) / 2, np.arange(len(number))
    median = (ordered[np.floor(middle).astype(int), column] + ordered[np.ceil(middle).astype(int), column]) / 2
    away = np.abs(value - median[None]).max(-1) / AGREEMENT_TOLERANCE
    return np.where(number >= 3, share * np.clip((2 - away) / 1.5, 0.05, 1), share)
