"""Reading materials for points of a surface out of the views that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, project, rays
from gdtool.geometry.tangents import dot, unit

# Below this cosine between normal and viewing direction a view has stretched its pixels too far to be read.
MIN_FACING_COSINE = 0.12
_RAYS_PER_PIXEL_SIDE = 2
# Views that differ by less, in stored units, agree.
AGREEMENT_TOLERANCE = 0.15
# How much better a picture sees color than the views that were made of it, at the same angle; never more than one that
# faces the surface.
REFERENCE_GAIN = 4.0


@dataclass(frozen=True)
class ViewVisibility:
    """What one camera sees of the surface, per pixel of its image.

    low, high (h, w): nearest and farthest depth among the pixel's samples, inf and -inf where all miss;
    clear (h, w): distance in pixels to the nearest silhouette or depth step, at least 0.5.
    """

    camera: Camera
    low: np.ndarray
    high: np.ndarray
    clear: np.ndarray


def view_visibility(camera: Camera, caster, mask: np.ndarray) -> ViewVisibility:
    """What a camera sees of a surface, by rays; mask (h, w) is the view's own coverage, whose border counts as
    silhouette."""
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
    low, high = samples.min(-1), np.where(missed, -np.inf, samples).max(-1)
    # A step: neighbouring pixels whose depths differ by more than a surface at 80 degrees would make them.
    span = maximum_filter(np.where(np.isinf(high), camera.far, high), 3) - minimum_filter(
        np.where(np.isinf(low), camera.far, low), 3
    )
    step = span > 2 * pixel_footprint(camera, np.where(np.isinf(low), camera.far, low)) * np.tan(np.radians(80))
    edge = step | missed.any(-1) | (mask < 0.999)
    edge = np.pad(edge, 1, constant_values=True)
    return ViewVisibility(camera, low, high, np.maximum(distance_transform_edt(~edge)[1:-1, 1:-1], 0.5))


def pixel_footprint(camera: Camera, depth: np.ndarray | float) -> np.ndarray | float:
    """World size of a pixel at a depth along the viewing axis."""
    return camera.pixel_size + 0 * depth if camera.projection == "orthographic" else depth / camera.fx


def _toward(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(n, 3) unit directions from points to the camera."""
    if camera.projection == "orthographic":
        return np.broadcast_to(camera.backward, points.shape)
    return unit(camera.position - points)


def _read(
    visibility: ViewVisibility,
    stack: np.ndarray,
    mask: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One view at the points that face it: their indices (m,), values (m, c), quality (m,) in [0, 1].

    stack (h, w, c) straight values, mask (h, w). Bilinear over those of the four pixels that show this part of the
    surface: inside the mask and at its depth. Never a background or a part in front.
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
    weight_sum, clear = np.zeros(len(facing)), np.zeros(len(facing))
    value = np.zeros((len(facing), stack.shape[-1]))
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = np.clip(corner[:, 0] + dx, 0, w - 1), np.clip(corner[:, 1] + dy, 0, h - 1)
        share = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1])
        here = (visibility.low[row, column] >= depth - tolerance) & (visibility.high[row, column] <= depth + tolerance)
        weight = np.where(here, share * mask[row, column], 0)
        weight_sum += weight
        clear += weight * visibility.clear[row, column]
        value += weight[:, None] * stack[row, column]
    read = weight_sum > 1e-3
    facing, value, clear, weight_sum = facing[read], value[read], clear[read], weight_sum[read]
    cosine = cosine[read]
    value /= weight_sum[:, None]
    # Three pixels from a silhouette a view is as good as it gets; at it, still better than none.
    away = np.clip(0.3 + 0.7 * (clear / weight_sum - 0.5) / 2.5, 0.3, 1.0)
    return facing, value, cosine * away * weight_sum


def silhouette_margin(visibility: ViewVisibility, points: np.ndarray) -> np.ndarray:
    """(n,) in [0, 1]: 0 where points (n, 3) lie within a pixel of a silhouette or a step in depth, 1 from two on."""
    pixel = np.floor(project(visibility.camera, points)[0]).astype(np.int64)
    h, w = visibility.clear.shape
    return np.clip(visibility.clear[np.clip(pixel[:, 1], 0, h - 1), np.clip(pixel[:, 0], 0, w - 1)] - 1, 0, 1)


def observe(
    points: np.ndarray,
    normals: np.ndarray,
    visibilities: list[ViewVisibility],
    stack: np.ndarray,
    mask: np.ndarray,
    prior: np.ndarray | None = None,
    sharpness: float = 6.0,
    known: int | None = None,
    colors: int = 0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the views say about points (n, 3) of the surface with unit normals (n, 3).

    stack (k, h, w, c) and mask (k, h, w) of the k visibilities. Views are weighted by facing, distance to silhouettes and
    coverage; the best one counts far more than the next (its power is sharpness), so detail is not averaged away, and
    the change from one view to another is smooth. A view that differs from all others and from prior (n, c) fades out,
    but not the known one, which the others were made of: of the first channels, its colors, it counts as if of REFERENCE_GAIN
    times the quality, 1 at most. Returns values (n, c) float32, confidence (n,) float32 in [0, 1], 0 where no view sees
    the point, and each view's share (k, n) of the values, of the colors where one is known."""
    count, channels = len(points), stack.shape[-1]
    value = np.zeros((len(visibilities), count, channels), np.float32)
    quality = np.zeros((len(visibilities), count), np.float32)
    low, high = np.full((count, channels), np.inf, np.float32), np.full((count, channels), -np.inf, np.float32)
    if prior is not None:
        low, high = prior.astype(np.float32), prior.astype(np.float32)
    for k, visibility in enumerate(visibilities):
        seen, read, good = _read(visibility, stack[k], mask[k], points, normals)
        value[k, seen], quality[k, seen] = read, good
        low[seen], high[seen] = np.minimum(low[seen], read), np.maximum(high[seen], read)
    best = quality.max(0)
    confidence = np.clip((best - 0.04) / 0.11, 0, 1)
    share = quality / np.maximum(best, 1e-6)
    disputed = np.flatnonzero((high - low > AGREEMENT_TOLERANCE).any(1))
    if len(disputed):
        faded = _fade_outliers(value[:, disputed], share[:, disputed], None if prior is None else prior[disputed])
        if known is not None:
            faded[known] = share[known, disputed]
        share[:, disputed] = faded
    weight = share**sharpness
    total = weight.sum(0)
    mean = np.einsum("kn,knc->nc", weight / np.maximum(total, 1e-12), value)
    if known is not None:
        weight[known] *= np.minimum(REFERENCE_GAIN, 1 / np.maximum(quality[known], 1e-6)) ** sharpness
        mean[:, :colors] = np.einsum("kn,knc->nc", weight / np.maximum(weight.sum(0), 1e-12), value[..., :colors])
    weight /= np.maximum(weight.sum(0), 1e-12)
    return mean.astype(np.float32), np.where(total > 0, confidence, 0).astype(np.float32), weight


def _fade_outliers(value: np.ndarray, share: np.ndarray, prior: np.ndarray | None) -> np.ndarray:
    """share (k, n), less where a view's value (k, n, c) is far from the median of all that see the point and prior (n,
    c).

    Only where at least three opinions are there. The loss is gradual, from half the tolerance to twice it, so that a
    view on which the others gain does not end in an edge on the surface; a trace stays, so that one view always counts.
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
