"""Evaluate, for one view, how far points lie in front of the surface that it sees.

`prepare` turns a view into small images once: the tangent plane behind each pixel, the distance to the next occluding
contour, and the signed distance to the silhouette. `free_distance` and `hull_distance` then answer for any number of
points. Positive means outside: a point that any view sees in free space is outside the object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gdtool.cameras import Camera, backproject, project, rays
from gdtool.images.sampling import bilinear

OCCLUDER_REACH_PX = 3  # pixels around an occluding contour in which free space is measured from the contour
WEAK = 0.01  # weight of a distance that is only a bound
_SINGLE_PIXEL_WEIGHT = 0.3  # what a single pixel's plane counts beside one of four pixels that agree
_FREE_SPACE_WEIGHT = 1e-4  # weight of a pixel whose depth fits no neighbour


@dataclass(frozen=True)
class PreparedView:
    """Hold one view's images (h, w[, c]), float32, in world units unless said otherwise.

    planes: unit normal and offset of the tangent plane behind each pixel (n·x = offset).
    weight: confidence in the plane, 0 where there is no depth.
    not_smooth: pixels whose neighbourhood is not one smooth surface.
    depth_edge: pixels beside a jump in depth.
    occluder_distance_px: distance in pixels to the nearest occluding contour, inf where there is none close by.
    silhouette: signed distance in pixels to the mask's edge, negative inside.
    points (h, w, 3): back-projected pixels.
    cropped: whether the object runs over the picture's border.
    """

    camera: Camera
    mask: np.ndarray
    silhouette: np.ndarray
    cropped: bool
    planes: np.ndarray | None = None
    weight: np.ndarray | None = None
    not_smooth: np.ndarray | None = None
    depth_edge: np.ndarray | None = None
    occluder_distance_px: np.ndarray | None = None
    points: np.ndarray | None = None


def silhouette_distance(mask: np.ndarray) -> np.ndarray:
    """Compute the signed distance (h, w) in pixels to the edge of an antialiased mask (h, w) in 0..1, negative inside.

    The edge is where coverage, relative to the fullest pixel next to it, passes one half, so that a line thinner than a
    pixel keeps an inside. Within four pixels of the edge the distance is exact to the sub-pixel contour. Farther away
    it is the distance transform's.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter
    from scipy.spatial import cKDTree
    from skimage.measure import find_contours

    h, w = mask.shape
    fullest = maximum_filter(mask, 3)
    cover = np.where(fullest > 0.1, mask / np.maximum(fullest, 0.1), 0.0).astype(np.float64)
    if not (cover >= 0.5).any():
        return np.full((h, w), float(np.hypot(h, w)), np.float32)
    inside = cover >= 0.5
    out = np.where(
        inside, 0.5 - distance_transform_edt(np.pad(inside, 1))[1:-1, 1:-1], distance_transform_edt(~inside) - 0.5
    )
    segments = []
    for line in find_contours(np.pad(cover, 1), 0.5):
        steps = np.linspace(0, 1, 8, endpoint=False)[None, :, None]
        segments.append((line[:-1, None] * (1 - steps) + line[1:, None] * steps).reshape(-1, 2) - 1)
    near = np.argwhere(np.abs(out) < 4)
    distance, _ = cKDTree(np.concatenate(segments)).query(near)
    out[near[:, 0], near[:, 1]] = np.where(inside[near[:, 0], near[:, 1]], -distance, distance)
    return out.astype(np.float32)


def normals_from_depth(points: np.ndarray, valid: np.ndarray, backward: np.ndarray) -> np.ndarray:
    """Compute unit normals (h, w, 3) of back-projected points (h, w, 3), facing the camera; zero where undefined.

    On each axis the shorter of the two one-sided differences is used, so that normals do not mix two surfaces.
    """
    tangents = []
    for axis in (1, 0):
        ahead = np.roll(points, -1, axis) - points
        behind = np.roll(ahead, 1, axis)
        good_ahead = valid & np.roll(valid, -1, axis)
        good_behind = np.roll(good_ahead, 1, axis)
        length_ahead = np.where(good_ahead, (ahead**2).sum(-1), np.inf)
        length_behind = np.where(good_behind, (behind**2).sum(-1), np.inf)
        both = (
            good_ahead
            & good_behind
            & (np.maximum(length_ahead, length_behind) < 4 * np.minimum(length_ahead, length_behind))
        )
        side = np.where((length_ahead <= length_behind)[..., None], ahead, behind)
        tangent = np.where(both[..., None], ahead + behind, side)
        tangents.append(np.where((good_ahead | good_behind)[..., None], tangent, 0.0))
    normal = np.cross(tangents[0], tangents[1])
    normal *= np.where((normal @ backward) < 0, -1.0, 1.0)[..., None]
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length > 1e-20, normal / np.maximum(length, 1e-20), 0.0)


def pixel_footprint(camera: Camera, depth) -> np.ndarray:
    """Return the world units that a pixel covers at the given depth."""
    if camera.projection == "orthographic":
        return np.full(np.shape(depth), camera.pixel_size)
    return np.asarray(depth) / camera.fx


def prepare(
    camera: Camera, mask: np.ndarray, depth: np.ndarray | None = None, normal: np.ndarray | None = None
) -> PreparedView:
    """Prepare one view from its mask (h, w), depth (h, w) along the axis and world normals (h, w, 3), the last two
    optional.

    A pixel whose depth fits no neighbour (an average over an edge) only tells that the view in front of it is free.
    Without normals they are computed from the depth.
    """
    silhouette = silhouette_distance(mask)
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    cropped = bool((border > 0.5).mean() > 0.01)
    if depth is None:
        return PreparedView(camera, mask, silhouette, cropped)
    valid = (mask > 0.05) & np.isfinite(depth) & (depth > 0)
    points = backproject(camera, np.where(valid, depth, 0.0))
    foot = pixel_footprint(camera, np.where(valid, depth, 1.0))
    if normal is None:
        normal = normals_from_depth(points, valid, camera.backward)
    length = np.linalg.norm(normal, axis=-1)
    valid &= length > 0.1
    normal = np.where(valid[..., None], normal / np.maximum(length, 0.1)[..., None], 0.0)
    toward = (
        np.where(camera.projection == "orthographic", camera.backward, -rays(camera)[1])
        if camera.projection != "orthographic"
        else camera.backward
    )
    cosine = (normal * toward).sum(-1)

    shown = _Shown(points, normal, valid, foot)
    reliable, smooth, depth_edge = shown.judged()
    # What the others show is no plane, but before it the view is free.
    normal = np.where(shown.image(~reliable, False)[..., None], camera.backward, normal)
    planes = np.concatenate([normal, (normal * points).sum(-1, keepdims=True)], -1).astype(np.float32)
    occluder_distance_px = shown.image(shown.occluder_distance_px(normal[valid], reliable), np.inf).astype(np.float32)
    reliable = shown.image(reliable, False)
    weight = np.where(reliable, np.clip(cosine, 0.05, 1.0) ** 2 * mask**2, _FREE_SPACE_WEIGHT * valid).astype(
        np.float32
    )
    return PreparedView(
        camera,
        mask,
        silhouette,
        cropped,
        planes,
        weight,
        ~(reliable & shown.image(smooth, False)),
        shown.image(depth_edge, False),
        occluder_distance_px,
        points.astype(np.float32),
    )


class _Shown:
    """Compare the n pixels that show a surface with their neighbours.

    points and normals (h, w, 3), valid and foot (h, w).
    """

    def __init__(self, points: np.ndarray, normal: np.ndarray, valid: np.ndarray, foot: np.ndarray):
        rim = [(OCCLUDER_REACH_PX,) * 2] * 2
        self.valid, self.foot, self.inner, self.columns = (
            valid,
            foot[valid],
            np.pad(valid, rim),
            valid.shape[1] + 2 * OCCLUDER_REACH_PX,
        )
        self.points, self.normals = (np.pad(x, [*rim, (0, 0)]).reshape(-1, 3) for x in (points, normal))
        self.at = np.flatnonzero(self.inner)
        self.point, self.normal = self.points[self.at], self.normals[self.at]

    def image(self, values: np.ndarray, fill) -> np.ndarray:
        """Scatter values (n,) into an image (h, w) that holds `fill` elsewhere."""
        out = np.full(self.valid.shape, fill, np.result_type(values, fill))
        out[self.valid] = values
        return out

    def gaps(self, shift: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compare each pixel with the neighbour at `shift` (rows, columns); three arrays (n,).

        Returns whether the neighbour shows a surface, its height over this pixel's plane, and this pixel's height over
        the neighbour's plane.
        """
        beside = self.at + shift[0] * self.columns + shift[1]
        delta = self.points[beside] - self.point
        return (
            self.inner.ravel()[beside],
            np.einsum("ij,ij->i", self.normal, delta),
            -np.einsum("ij,ij->i", self.normals[beside], delta),
        )

    def judged(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Classify the pixels: three bool arrays (n,), reliable, smooth and depth_edge.

        A reliable pixel fits the depth of two neighbours and does not float between a nearer surface on one side and a
        farther one on the other, as averages over an edge do. A smooth pixel lies within one surface. A depth edge lies
        beside a jump.
        """
        count = len(self.at)
        agree, smooth, depth_edge, flying = (
            np.zeros(count, int),
            np.ones(count, bool),
            np.zeros(count, bool),
            np.zeros(count, bool),
        )
        for shift in ((0, 1), (1, 0), (1, 1), (1, -1)):
            heights = []
            for i, j in (shift, (-shift[0], -shift[1])):
                both, ahead, back = self.gaps((i, j))
                nearer, farther = np.minimum(np.abs(ahead), np.abs(back)), np.maximum(np.abs(ahead), np.abs(back))
                near = both & (farther < self.foot)
                agree += near
                smooth &= near | ~both
                depth_edge |= both & (nearer > 1.5 * self.foot)
                heights.append(np.where(both & (nearer > self.foot), ahead, 0.0))
            flying |= heights[0] * heights[1] < 0
        return (agree >= 2) & ~flying, smooth, depth_edge

    def occluder_distance_px(self, normal: np.ndarray, reliable: np.ndarray) -> np.ndarray:
        """Compute the distance in pixels (n,) to the nearest pixel whose surface stands in front of this pixel's plane.

        normal (n, 3): of the planes. An unreliable pixel (n,) occludes only other unreliable pixels.
        """
        may_occlude = self.inner.copy()
        may_occlude.ravel()[self.at] = reliable
        out = np.full(len(self.at), np.inf)
        for i in range(-OCCLUDER_REACH_PX, OCCLUDER_REACH_PX + 1):
            for j in range(-OCCLUDER_REACH_PX, OCCLUDER_REACH_PX + 1):
                distance = np.hypot(i, j)
                if 0 < distance <= OCCLUDER_REACH_PX:
                    beside = self.at + i * self.columns + j
                    there = may_occlude.ravel()[beside] | (self.inner.ravel()[beside] & ~reliable)
                    height = np.einsum("ij,ij->i", normal, self.points[beside] - self.point)
                    out = np.where(
                        there & (height > (1.0 + distance) * self.foot), np.minimum(out, distance - 0.5), out
                    )
        return out


def grow_silhouette(view: PreparedView, edge: float) -> PreparedView:
    """Return the view with its silhouette moved outward by `edge` (world units at the origin's distance; negative
    shrinks it).

    A gained pixel shows no surface. It tells that the view is free as far as the depth of the nearest pixel.
    """
    from scipy.ndimage import distance_transform_edt

    foot = float(pixel_footprint(view.camera, float(np.linalg.norm(view.camera.position))))
    grown = replace(view, silhouette=(view.silhouette - edge / foot).astype(np.float32))
    if view.planes is None or edge <= 0 or not (view.weight > 0).any():
        return grown
    # And the pixels around them, between which points are looked up.
    gained = (grown.silhouette < 1) & (view.weight == 0)
    row, column = distance_transform_edt(view.weight == 0, return_distances=False, return_indices=True)[:, gained]
    depth = np.zeros(view.mask.shape)
    depth[gained] = (view.points[row, column] - view.camera.position) @ -view.camera.backward
    points, planes, weight = backproject(view.camera, depth)[gained], view.planes.copy(), view.weight.copy()
    planes[gained] = np.concatenate(
        [np.broadcast_to(view.camera.backward, points.shape), points @ view.camera.backward[:, None]], -1
    )
    weight[gained] = _FREE_SPACE_WEIGHT
    places = view.points.copy()
    places[gained] = points
    return replace(grown, planes=planes, weight=weight, points=places, not_smooth=view.not_smooth | gained)


def hull_distance(view: PreparedView, points: np.ndarray) -> np.ndarray:
    """Compute the signed distance (n,) of points (n, 3) to the view's silhouette cone, positive outside.

    It is a lower bound of the distance to the object.
    """
    pixels, depth = project(view.camera, points)
    value = bilinear(view.silhouette[..., None], pixels)[:, 0]
    h, w = view.mask.shape
    overflow = np.maximum(np.maximum(-pixels[:, 0], pixels[:, 0] - w), np.maximum(-pixels[:, 1], pixels[:, 1] - h))
    beyond = overflow > 0
    # Outside the picture nothing is known when the object runs over its border.
    value = np.where(beyond, -np.inf if view.cropped else np.maximum(value, 0.5) + overflow, value)
    value = value * pixel_footprint(view.camera, depth)
    return np.where(depth > 0, value, -np.inf)


def free_distance(view: PreparedView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute how far points (n, 3) lie in front of the surface that the view sees.

    Returns the distance (n,), -inf where unknown, and its weight (n,). The distance is to the tangent planes behind the
    four pixels around the point, or to the nearest pixel's where these belong to different surfaces.
    """
    value, weight, _, _ = tangent_distance(view, points)
    return value, weight


def tangent_distance(view: PreparedView, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Measure points (n, 3) against the view's tangent planes.

    Returns the distance and weight of `free_distance` (n,) each, the unit normal (n, 3) of the plane that was used, and
    whether the surface there is smooth (n,).
    """
    pixels, depth = project(view.camera, points)
    h, w = view.mask.shape
    column = np.clip(pixels[:, 0].astype(np.int64), 0, w - 1)
    row = np.clip(pixels[:, 1].astype(np.int64), 0, h - 1)
    nearest = row * w + column
    weighted = np.concatenate([view.planes * view.weight[..., None], view.weight[..., None]], -1)
    mixed = bilinear(weighted, pixels)
    single = view.not_smooth.reshape(-1)[nearest] | (mixed[:, 4] <= 0)
    mixed[single] = weighted.reshape(-1, 5)[nearest[single]]
    weight = np.where(single, _SINGLE_PIXEL_WEIGHT * mixed[:, 4], mixed[:, 4])
    scale = 1.0 / np.maximum(mixed[:, 4], 1e-12)
    value = (np.einsum("ij,ij->i", mixed[:, :3], points.astype(np.float32)) - mixed[:, 3]) * scale
    occluder_distance_px = view.occluder_distance_px.reshape(-1)[nearest] * pixel_footprint(view.camera, depth)
    bounded = (value > occluder_distance_px) | ((value > 0) & view.depth_edge.reshape(-1)[nearest])
    value = np.minimum(value, occluder_distance_px)
    weight = np.where(bounded, np.minimum(weight, WEAK), weight)
    inside = (pixels[:, 0] >= 0) & (pixels[:, 0] < w) & (pixels[:, 1] >= 0) & (pixels[:, 1] < h)
    known = (weight > 0) & inside & (depth > 0)
    return (
        np.where(known, value, -np.inf),
        np.where(known, weight, 0.0),
        mixed[:, :3] * scale[:, None],
        known & ~single & ~bounded,
    )
