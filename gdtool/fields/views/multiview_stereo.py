"""Estimate depth for views without a depth image, by matching each pixel's ray against the other views.

A plane sweep along the rays with semi-global matching (Hirschmüller, "Stereo Processing by Semiglobal Matching and
Mutual Information", 2008). The compared features do not depend on the viewing direction: normals in world axes, albedo,
roughness, metallic. Normals help twice. They predict how depth changes from pixel to pixel, so that a slanted plane
costs no more than one that faces the camera. They tell which views can see a point. The first sweep trusts the better
half of those views; the second takes occlusion from the first sweep's depths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, project, rays
from gdtool.fields.views.prepared_view import PreparedView, hull_distance, pixel_footprint
from gdtool.images.sampling import bilinear

MATCHING_SIZE = 128  # pixels of the longer side at which views are matched, about
CANDIDATE_PX = 0.9  # pixels of that size between neighbouring candidate depths
MOST_CANDIDATES = 512  # candidate depths
# Usual difference of corresponding values; albedo in sRGB.
NOISE = {"normal": 0.12, "albedo": 0.06, "roughness": 0.1, "metallic": 0.1}
SATURATION = 3.0  # usual differences at which the cost saturates
LEAST_FACING = 0.12  # cosine between normal and ray below which a point is not compared
SILHOUETTE_SLACK_PX = 1.5  # pixels by which a silhouette may be wrong
HIDDEN_COST = 0.6  # cost of a point that no other view shows
HIDDEN_WEIGHT = 0.15  # weight of that cost, relative to a view that shows the point
CONSISTENT_MISFIT = 0.02  # misfit up to which the views count as consistent
DEPTH_COST = 0.05  # cost of a world unit behind the common volume of the silhouettes; decides between equal depths
STEP_COST = 0.1  # cost of leaving the neighbour's plane by one candidate
JUMP_COST = 0.6  # cost of leaving it by any number of candidates
ON_SURFACE_PX = 2.0  # pixels between a point and another view's surface up to which it is on it, while sweeping
CONFIRMED_PX = 2.5  # the same, in the final confirmation
EXCLUDED_COST = 9.0  # cost of an excluded depth
LEAST_COVER = 0.2  # coverage of a block of pixels for it to be matched


@dataclass(frozen=True)
class Matched:
    """Hold a view's matched depth along the viewing axis (h, w), 0 where unknown, and its trust (h, w) in 0..1."""

    depth: np.ndarray
    trust: np.ndarray


def slopes(
    camera: Camera, normal: np.ndarray, least: float, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute how the depth of planes with world normals (…, 3) grows over one pixel to the right and one down.

    Returns the two slopes and the cosine between plane and ray. Depth is `stretched` depth, whose growth depends on the
    normal alone. directions (…, 3): of the rays. Cosines below `least` are raised to it.
    """
    axes = camera.world_from_camera[:3, :3]
    right, down = pixel_steps(camera)
    facing = (
        normal @ camera.backward
        if camera.projection == "orthographic"
        else (normal * directions).sum(-1) / (directions @ camera.backward)
    )
    held = np.maximum(facing, least)
    return normal @ axes[:, 0] / held * right, -(normal @ axes[:, 1]) / held * down, facing


def pixel_steps(camera: Camera) -> tuple[float, float]:
    """Return a pixel's width and height in units of stretched depth."""
    return (
        (camera.pixel_size, camera.pixel_size)
        if camera.projection == "orthographic"
        else (1 / camera.fx, 1 / camera.fy)
    )


def stretched(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Map depth to a scale on which a plane's slope over the picture is the same at any distance.

    Orthographic depth stays as it is; perspective depth becomes its logarithm.
    """
    return depth if camera.projection == "orthographic" else np.log(np.maximum(depth, 1e-9))


def unstretched(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Invert `stretched`."""
    return depth if camera.projection == "orthographic" else np.exp(depth)


class _View:
    """Hold a view at matching resolution: its n foreground pixels, their rays and features, and the depths to try."""

    def __init__(
        self, camera: Camera, mask: np.ndarray, feature_image: np.ndarray, normal: np.ndarray, box: np.ndarray
    ):
        self.camera, self.factor = camera, max(1, round(max(mask.shape) / MATCHING_SIZE))
        self.mask = _block_means(mask[..., None], self.factor)[..., 0]
        cover = np.maximum(self.mask, 1e-3)[..., None]
        self.feature_image = _block_means(feature_image * mask[..., None], self.factor) / cover
        self.foreground = self.mask > LEAST_COVER
        h, w = self.foreground.shape
        column, row = np.meshgrid((np.arange(w) + 0.5) * self.factor, (np.arange(h) + 0.5) * self.factor)
        origins, directions = rays(camera, np.stack([column, row], -1)[self.foreground])
        self.origins, self.directions = origins, directions / -(directions @ camera.backward)[:, None]  # of unit depth
        averaged = _block_means(normal * mask[..., None], self.factor)[self.foreground]
        self.normal = averaged / np.maximum(np.linalg.norm(averaged, axis=-1, keepdims=True), 1e-9)
        self.features = self.feature_image[self.foreground]
        depth = project(camera, box)[1]
        self.pixel_size = self.factor * float(
            pixel_footprint(camera, max(float(np.median(depth)), 1e-6))
        )  # world units
        low, high = stretched(camera, np.maximum([depth.min(), depth.max()], camera.near / 2))
        self.step = max(CANDIDATE_PX * self.factor * min(pixel_steps(camera)), (high - low) / MOST_CANDIDATES)
        self.candidates = low + self.step * np.arange(max(int(np.ceil((high - low) / self.step)) + 1, 3))

    def points(self, depth: np.ndarray) -> np.ndarray:
        """Compute world points (n, 3) at a stretched depth, one number or (n,)."""
        return self.origins + self.directions * np.reshape(unstretched(self.camera, np.asarray(depth)), (-1, 1))

    def image(self, values: np.ndarray, fill: float = 0.0) -> np.ndarray:
        """Scatter values (n,) into an image (h, w) that holds `fill` elsewhere."""
        out = np.full(self.foreground.shape, fill)
        out[self.foreground] = values
        return out

    def project_points(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project points (m, 3): positions (m, 2) in this view's pixels, and depth (m,) along its axis."""
        pixels, depth = project(self.camera, points)
        return pixels / self.factor, depth


def _block_means(image: np.ndarray, factor: int) -> np.ndarray:
    """Average image (h, w, c) over blocks of factor x factor pixels, padding it with zeros."""
    h, w, c = image.shape
    padded = np.pad(image, ((0, -h % factor), (0, -w % factor), (0, 0)))
    return padded.reshape(-(-h // factor), factor, -(-w // factor), factor, c).mean((1, 3)).astype(np.float32)


def match_views(
    cameras: list[Camera],
    mask: np.ndarray,
    normal: np.ndarray,
    alike: dict[str, np.ndarray],
    silhouettes: list[PreparedView],
    box: tuple[np.ndarray, np.ndarray],
) -> list[Matched]:
    """Estimate the depth of every view from the other views. mask (k, h, w), normal (k, h, w, 3).

    alike: further images (k, h, w[, 3]) that NOISE names, linear. silhouettes: the prepared views that show anything.
    box: low and high corner of their common volume. A view that shows nothing gets depth 0.
    """
    corners = np.stack(np.meshgrid(*zip(*box, strict=True), indexing="ij"), -1).reshape(-1, 3)
    looks = _compared_features({"normal": normal, **alike})
    views = [_View(*view_input, corners) for view_input in zip(cameras, mask, looks, normal, strict=True)]
    depths = _sweep(views, silhouettes, None, DEPTH_COST)
    # Views that do not fit one another say less of where a point is, and the silhouettes more.
    doubt = max(1.0, _misfit(views, depths) / CONSISTENT_MISFIT)
    if doubt > 1:
        for view in views:
            view.feature_image, view.features = view.feature_image / doubt**0.5, view.features / doubt**0.5
        depths = _sweep(views, silhouettes, None, DEPTH_COST * doubt)
    depths = _sweep(views, silhouettes, _known_depths(views, depths), DEPTH_COST * doubt)
    return [
        _full_size(view, depth, trust, view_mask)
        for view, depth, trust, view_mask in zip(views, depths, _trust(views, depths), mask, strict=True)
    ]


def _sweep(
    views: list[_View],
    silhouettes: list[PreparedView],
    known: dict[int, tuple[np.ndarray, np.ndarray]] | None,
    nearer: float,
) -> list[np.ndarray]:
    """Find the stretched depth (n,) of every view's pixels; see _sweep_costs and _best_depth."""
    return [
        _best_depth(
            _sweep_costs(view, [other for other in views if other is not view], silhouettes, known, nearer), view
        )
        for view in views
    ]


def _misfit(views: list[_View], depths: list[np.ndarray]) -> float:
    """Measure the median feature difference, in 0..1, to the best fitting view, over the pixels that another view can
    see.

    Consistent views give .003 and less, views disturbed by
    benchmarks/reconstruct/perturbation.py .1, a model's views .7.
    """
    every = []
    for view, depth in zip(views, depths, strict=True):
        chosen = np.flatnonzero(np.isfinite(depth))
        points, best = view.points(np.nan_to_num(depth, nan=view.candidates[0])), np.full(len(chosen), np.inf)
        for other in views:
            if other is not view:
                difference = _compare(view, other, points, chosen)[0]
                best = np.where(_facing_cosine(other, view)[chosen] > LEAST_FACING, np.minimum(best, difference), best)
        every.append(best[np.isfinite(best)])
    joined = np.concatenate(every)
    return float(np.median(joined)) if len(joined) else 0.0


def _compared_features(images: dict[str, np.ndarray]) -> np.ndarray:
    """Stack the compared channels (k, h, w, c), each divided by its usual difference."""
    from gdtool.images.color import srgb_from_linear

    parts = []
    for domain, image in images.items():
        value = srgb_from_linear(np.clip(image, 0, 1)) if domain == "albedo" else image
        parts.append((value if value.ndim == 4 else value[..., None]) / NOISE[domain])
    return np.concatenate(parts, -1).astype(np.float32)


def _sweep_costs(
    view: _View,
    others: list[_View],
    silhouettes: list[PreparedView],
    known: dict[int, tuple[np.ndarray, np.ndarray]] | None,
    nearer: float,
) -> np.ndarray:
    """Compute the cost (n, candidates) of every candidate depth, EXCLUDED_COST where a silhouette rules it out.

    known: depth and trust (h, w) of the other views by id, from an earlier sweep.
    """
    cost = np.full((len(view.features), len(view.candidates)), EXCLUDED_COST, np.float32)
    facing = (
        np.stack([_facing_cosine(other, view) for other in others], 1) if others else np.zeros((len(view.features), 0))
    )
    entered = np.full(len(view.features), np.nan)
    for k, depth in enumerate(view.candidates):
        points = view.points(depth)
        allowed = np.flatnonzero(
            np.max([hull_distance(silhouette, points) for silhouette in silhouettes], 0)
            < SILHOUETTE_SLACK_PX * view.pixel_size
        )
        if len(allowed) == 0:
            continue
        world = float(unstretched(view.camera, depth))
        entered[allowed] = np.fmin(entered[allowed], world)
        behind = world - entered[allowed]
        hidden = np.full(len(allowed), HIDDEN_COST)
        compared = [
            (*_compare(view, other, points, allowed), cosine[allowed], other)
            for other, cosine in zip(others, facing.T, strict=True)
        ]
        cost[allowed, k] = (
            _cost_without_occlusion(compared, hidden)
            if known is None
            else _cost_with_occlusion(compared, hidden, known)
        ) + nearer * behind
    return cost


def _facing_cosine(other: _View, view: _View) -> np.ndarray:
    """Compute the cosine (n,) between the normals of `view`'s pixels and the direction to the other camera."""
    if other.camera.projection == "orthographic":
        return view.normal @ other.camera.backward
    middle = view.points(np.full(len(view.features), view.candidates.mean()))
    toward = other.camera.position - middle
    return (view.normal * toward).sum(1) / np.maximum(np.linalg.norm(toward, axis=1), 1e-9)


def _compare(
    view: _View, other: _View, points: np.ndarray, chosen: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare the features of view with those of `other` at points[chosen].

    Returns the difference (m,) in 0..1 and the points' pixels (m, 2) and depth (m,) in the other view.
    """
    pixels, depth = other.project_points(points[chosen])
    gap = bilinear(other.feature_image, pixels) - view.features[chosen]
    difference = np.minimum(np.einsum("ij,ij->i", gap, gap) / SATURATION**2, 1.0)
    return np.where(bilinear(other.mask[..., None], pixels)[:, 0] < 0.5, 1.0, difference), pixels, depth


def _cost_without_occlusion(compared: list, hidden: np.ndarray) -> np.ndarray:
    """Compute the cost (m,) while occlusion is unknown: the best view's, or the best two's where three can see."""
    if not compared:
        return hidden
    each = np.stack([np.where(cosine > LEAST_FACING, difference, np.inf) for difference, _, _, cosine, _ in compared])
    count = np.isfinite(each).sum(0)
    each = np.sort(each, 0)
    best = each[0] if len(each) < 2 else np.where(count >= 3, (each[0] + each[min(1, len(each) - 1)]) / 2, each[0])
    return np.where(count > 0, best, hidden)


def _cost_with_occlusion(
    compared: list, hidden: np.ndarray, known: dict[int, tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Compute the cost (m,) from the views whose known surface is met at the point.

    A point that would occlude a trusted surface of another view costs most.
    """
    total, share, blocks = HIDDEN_WEIGHT * hidden, np.full(len(hidden), HIDDEN_WEIGHT), np.zeros(len(hidden))
    for difference, pixels, depth, cosine, other in compared:
        surface, trust = (bilinear(image[..., None], pixels)[:, 0] for image in known[id(other)])
        reach = ON_SURFACE_PX * other.pixel_size / np.maximum(cosine, 0.3)
        covered = bilinear(other.mask[..., None], pixels)[:, 0] > 0.5
        weight = np.where(
            (cosine > LEAST_FACING) & covered & (np.abs(depth - surface) < reach), cosine * np.maximum(trust, 0.2), 0.0
        )
        total, share = total + weight * difference, share + weight
        blocks = np.maximum(blocks, np.where(covered & (depth < surface - reach), trust, 0.0))
    return np.maximum(total / share, blocks)


def _best_depth(cost: np.ndarray, view: _View) -> np.ndarray:
    """Find the stretched depth (n,) of least cost after aggregation along rows and columns; NaN where all are ruled
    out.
    """
    right, down, facing = slopes(view.camera, view.normal, LEAST_FACING, view.directions)
    scale = view.factor / view.step
    image = np.full((*view.foreground.shape, cost.shape[1]), EXCLUDED_COST, np.float32)
    image[view.foreground] = np.minimum(cost, 1.5)  # ruled out by one pixel, yet a neighbour's may go on there
    # A plane seen at a grazing angle may well end: leaving it costs less.
    jump = view.image(JUMP_COST * np.clip(facing / 0.5, 0.15, 1.0)).astype(np.float32)
    total = np.zeros_like(image)
    for slope, turn in ((right, (0, 1, 2)), (down, (1, 0, 2))):
        along = [
            image.transpose(turn),
            view.foreground.transpose(turn[:2]),
            view.image(slope * scale).transpose(turn[:2]),
            jump.transpose(turn[:2]),
        ]
        for direction in (1, -1):
            total += _aggregate_rows(*(x[:, ::direction] for x in along), direction)[:, ::direction].transpose(turn)
    total = total[view.foreground]
    best = np.clip(total.argmin(1), 1, total.shape[1] - 2)
    before, here, after = (total[np.arange(len(best)), best + i] for i in (-1, 0, 1))
    part = np.clip((before - after) / np.maximum(2 * (before - 2 * here + after), 1e-6), -0.5, 0.5)
    return np.where((cost < EXCLUDED_COST).any(1), view.candidates[0] + view.step * (best + part), np.nan)


def _aggregate_rows(
    cost: np.ndarray, shown: np.ndarray, slope: np.ndarray, jump: np.ndarray, direction: int
) -> np.ndarray:
    """Add to the cost (h, w, candidates) of every depth the least cost of the pixels before it in its row.

    slope (h, w): candidates by which depth grows over a pixel in the given direction, 1 or -1.
    """
    out, last = cost.copy(), cost.shape[2] - 1
    every = np.arange(cost.shape[2])
    for column in range(1, cost.shape[1]):
        previous = out[:, column - 1]
        lowest = previous.min(1, keepdims=True)
        from_there = every - direction * (slope[:, column] + slope[:, column - 1])[:, None] / 2
        whole = np.floor(from_there).astype(np.int64)
        part = (from_there - whole).astype(np.float32)
        plane = (
            np.take_along_axis(previous, whole.clip(0, last), 1) * (1 - part)
            + np.take_along_axis(previous, (whole + 1).clip(0, last), 1) * part
        )
        plane[(from_there < 0) | (from_there > last)] = EXCLUDED_COST
        beside = np.full_like(plane, EXCLUDED_COST)
        beside[:, 1:] = plane[:, :-1]
        np.minimum(beside[:, :-1], plane[:, 1:], out=beside[:, :-1])
        added = (
            np.minimum(
                np.minimum(plane, beside + STEP_COST),
                lowest + np.minimum(jump[:, column], jump[:, column - 1])[:, None],
            )
            - lowest
        )
        out[:, column] += np.where((shown[:, column] & shown[:, column - 1])[:, None], added, 0)
    return out


def _known_depths(views: list[_View], depths: list[np.ndarray]) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return, by id, each view's depth (h, w), extrapolated beyond its outline, and the trust in it (h, w)."""
    return {
        id(view): (_extrapolate(view, unstretched(view.camera, depth))[0], view.image(trust))
        for view, depth, trust in zip(views, depths, _trust(views, depths), strict=True)
    }


def _extrapolate(view: _View, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extend values (n,) to an image (h, w) by the nearest known value; also returns where they were known (h, w)."""
    from scipy.ndimage import distance_transform_edt

    image = view.image(values, np.nan)
    held = np.isfinite(image)
    if not held.any():
        return np.zeros(held.shape), held
    return image[tuple(distance_transform_edt(~held, return_distances=False, return_indices=True))], held


def _trust(views: list[_View], depths: list[np.ndarray]) -> list[np.ndarray]:
    """Compute the trust (n,) in each view's depths.

    1 where another view confirms the point, 0 where none does, .1 where it would occlude more views than confirm it.
    """
    surfaces = [
        _extrapolate(view, unstretched(view.camera, depth))[0] for view, depth in zip(views, depths, strict=True)
    ]
    out = []
    for view, depth in zip(views, depths, strict=True):
        points = view.points(np.nan_to_num(depth, nan=view.candidates[0]))
        meeting, hiding = np.zeros(len(points)), np.zeros(len(points))
        for other, surface in zip(views, surfaces, strict=True):
            if other is view:
                continue
            cosine = _facing_cosine(other, view)
            pixels, there = other.project_points(points)
            beyond = bilinear(surface[..., None], pixels)[:, 0] - there
            seen = (cosine > LEAST_FACING) & (bilinear(other.mask[..., None], pixels)[:, 0] > 0.5)
            meeting += seen & (np.abs(beyond) < CONFIRMED_PX * other.pixel_size / np.maximum(cosine, 0.3))
            hiding += seen & (beyond > 2 * CONFIRMED_PX * other.pixel_size)
        out.append(np.where(np.isfinite(depth) & (meeting > 0), np.where(hiding > meeting, 0.1, 1.0), 0.0))
    return out


def _full_size(view: _View, depth: np.ndarray, trust: np.ndarray, mask: np.ndarray) -> Matched:
    """Repeat depths (n,) and trust (n,) of each block over all of its pixels in the full mask (h, w)."""
    h, w = mask.shape
    carried, held = _extrapolate(view, unstretched(view.camera, depth))
    blocks = np.ones((view.factor, view.factor))
    grown = np.kron(np.where(held.any(), carried, 0.0), blocks)[:h, :w]
    return Matched(np.where(mask > 0.5, grown, 0.0), np.kron(np.where(held, view.image(trust), 0.0), blocks)[:h, :w])
