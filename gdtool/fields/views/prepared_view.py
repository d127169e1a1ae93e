"""What each view says about a point in space: how far it lies in front of the surface that the view sees.

A view is prepared once (`prepare`) into small images: the tangent plane behind each pixel, how far a pixel is from a
contour that hides something, and the signed distance to the silhouette. Then `free_distance` and `hull_distance`
answer for any number of points. Positive means outside: a point that any view sees in free space is outside the object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gdtool.cameras import Camera, project, rays

CURTAIN_REACH = 3  # pixels around an occluding contour in which free space is measured from the contour
WEAK = 0.01  # weight of a distance that is only a bound
_ROUGH = 0.3  # what a single pixel's plane counts beside one of four pixels that agree
_FAINT = 1e-4  # weight of a pixel whose depth fits no neighbour


@dataclass(frozen=True)
class Sight:
    """One prepared view. Images are (h, w[, c]) float32; world units where not said otherwise.

    planes: unit normal and offset of the tangent plane behind each pixel (n·x = offset); weight: trust in it, 0 where
    there is no depth; rough: pixels whose neighbourhood is no single smooth surface; broken: pixels beside a jump in
    depth; curtain: distance to an occluding contour in pixels; silhouette: signed distance to the mask's edge in
    pixels, negative inside; points (h, w, 3)."""

    camera: Camera
    mask: np.ndarray
    silhouette: np.ndarray
    cropped: bool
    planes: np.ndarray | None = None
    weight: np.ndarray | None = None
    rough: np.ndarray | None = None
    broken: np.ndarray | None = None
    curtain: np.ndarray | None = None
    points: np.ndarray | None = None


def silhouette_distance(mask: np.ndarray) -> np.ndarray:
    """Signed distance (h, w) in pixels to the edge of an antialiased mask (h, w) in 0..1, negative inside.

    The edge is where coverage, relative to the fullest pixel next to it, passes a half: so a line thinner than a
    pixel keeps an inside. Near the edge the distance is exact to the sub-pixel contour; farther away it is the
    distance transform's.
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
    """Unit normals (h, w, 3) of back-projected points (h, w, 3), facing the camera; zero where nothing can be said.

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


def backproject(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World points (h, w, 3) of a depth image (h, w), depth along the viewing axis."""
    origins, directions = rays(camera)
    cosine = -(directions @ camera.backward)
    return origins + directions * (depth / cosine)[..., None]


def pixel_footprint(camera: Camera, depth) -> np.ndarray:
    """World units a pixel covers at the given depth."""
    if camera.projection == "orthographic":
        return np.full(np.shape(depth), camera.pixel_size)
    return np.asarray(depth) / camera.fx


def prepare(
    camera: Camera, mask: np.ndarray, depth: np.ndarray | None = None, normal: np.ndarray | None = None
) -> Sight:
    """Prepare one view: mask (h, w) coverage, depth (h, w) along the axis and normal (h, w, 3) world, either optional.

    Pixels whose depth fits no neighbour (an average over an edge) tell only that the view before them is free. Without
    normals they are taken from the depth.
    """
    silhouette = silhouette_distance(mask)
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    cropped = bool((border > 0.5).mean() > 0.01)
    if depth is None:
        return Sight(camera, mask, silhouette, cropped)
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
    firm, smooth, broken = shown.judged()
    # What the others show is no plane, but before it the view is free.
    normal = np.where(shown.image(~firm, False)[..., None], camera.backward, normal)
    planes = np.concatenate([normal, (normal * points).sum(-1, keepdims=True)], -1).astype(np.float32)
    curtain = shown.image(shown.curtain(normal[valid], firm), np.inf).astype(np.float32)
    firm = shown.image(firm, False)
    weight = np.where(firm, np.clip(cosine, 0.05, 1.0) ** 2 * mask**2, _FAINT * valid).astype(np.float32)
    return Sight(
        camera,
        mask,
        silhouette,
        cropped,
        planes,
        weight,
        ~(firm & shown.image(smooth, False)),
        shown.image(broken, False),
        curtain,
        points.astype(np.float32),
    )


class _Shown:
    """The n pixels of a view that show a surface, beside their neighbours: points and normals (h, w, 3), valid and foot
    (h, w)."""

    def __init__(self, points: np.ndarray, normal: np.ndarray, valid: np.ndarray, foot: np.ndarray):
        rim = [(CURTAIN_REACH,) * 2] * 2
        self.valid, self.foot, self.inner, self.columns = (
            valid,
            foot[valid],
            np.pad(valid, rim),
            valid.shape[1] + 2 * CURTAIN_REACH,
        )
        self.points, self.normals = (np.pad(x, [*rim, (0, 0)]).reshape(-1, 3) for x in (points, normal))
        self.at = np.flatnonzero(self.inner)
        self.point, self.normal = self.points[self.at], self.normals[self.at]

    def image(self, values: np.ndarray, fill) -> np.ndarray:
        """values (n,) where they belong in (h, w)."""
        out = np.full(self.valid.shape, fill, np.result_type(values, fill))
        out[self.valid] = values
        return out

    def gaps(self, shift: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whether the neighbour shows something too (n,), its height over this pixel's plane, and this one's over the
        neighbour's."""
        beside = self.at + shift[0] * self.columns + shift[1]
        delta = self.points[beside] - self.point
        return (
            self.inner.ravel()[beside],
            np.einsum("ij,ij->i", self.normal, delta),
            -np.einsum("ij,ij->i", self.normals[beside], delta),
        )

    def judged(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(n,) each: which pixels' depth fits two neighbours and does not float between a nearer surface on one side
        and a farther one on the other (an average over an edge), which lie amid one smooth surface, and which beside a
        jump."""
        count = len(self.at)
        agree, smooth, broken, flying = (
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
                broken |= both & (nearer > 1.5 * self.foot)
                heights.append(np.where(both & (nearer > self.foot), ahead, 0.0))
            flying |= heights[0] * heights[1] < 0
        return (agree >= 2) & ~flying, smooth, broken

    def curtain(self, normal: np.ndarray, firm: np.ndarray) -> np.ndarray:
        """Pixels (n,) from each pixel to the nearest one whose surface stands in front of its plane (an occluding
        contour).

        normal (n, 3): of the planes. What is not firm (n,) hides nothing but what is not firm either.
        """
        hiding = self.inner.copy()
        hiding.ravel()[self.at] = firm
        out = np.full(len(self.at), np.inf)
        for i in range(-CURTAIN_REACH, CURTAIN_REACH + 1):
            for j in range(-CURTAIN_REACH, CURTAIN_REACH + 1):
                distance = np.hypot(i, j)
                if 0 < distance <= CURTAIN_REACH:
                    beside = self.at + i * self.columns + j
                    there = hiding.ravel()[beside] | (self.inner.ravel()[beside] & ~firm)
                    height = np.einsum("ij,ij->i", normal, self.points[beside] - self.point)
                    out = np.where(
                        there & (height > (1.0 + distance) * self.foot), np.minimum(out, distance - 0.5), out
                    )
        return out


def with_edge(sight: Sight, edge: float) -> Sight:
    """The view with its silhouette grown all around by edge (world units at the origin's distance; negative shrinks
    it).

    Pixels that it gains show nothing: that the view before them is free, as far as the nearest pixel's depth, is what
    they tell."""
    from scipy.ndimage import distance_transform_edt

    foot = float(pixel_footprint(sight.camera, float(np.linalg.norm(sight.camera.position))))
    grown = replace(sight, silhouette=(sight.silhouette - edge / foot).astype(np.float32))
    if sight.planes is None or edge <= 0 or not (sight.weight > 0).any():
        return grown
    # And the pixels around them, between which points are looked up.
    gained = (grown.silhouette < 1) & (sight.weight == 0)
    row, column = distance_transform_edt(sight.weight == 0, return_distances=False, return_indices=True)[:, gained]
    depth = np.zeros(sight.mask.shape)
    depth[gained] = (sight.points[row, column] - sight.camera.position) @ -sight.camera.backward
    points, planes, weight = backproject(sight.camera, depth)[gained], sight.planes.copy(), sight.weight.copy()
    planes[gained] = np.concatenate(
        [np.broadcast_to(sight.camera.backward, points.shape), points @ sight.camera.backward[:, None]], -1
    )
    weight[gained] = _FAINT
    places = sight.points.copy()
    places[gained] = points
    return replace(grown, planes=planes, weight=weight, points=places, rough=sight.rough | gained)


def hull_distance(sight: Sight, points: np.ndarray) -> np.ndarray:
    """Signed distance (n,) of points (n, 3) to the view's silhouette cone, positive outside. A lower bound of the
    object's."""
    pixels, depth = project(sight.camera, points)
    value = bilinear(sight.silhouette[..., None], pixels)[:, 0]
    h, w = sight.mask.shape
    overflow = np.maximum(np.maximum(-pixels[:, 0], pixels[:, 0] - w), np.maximum(-pixels[:, 1], pixels[:, 1] - h))
    beyond = overflow > 0
    # Outside the picture nothing is known when the object runs over its border.
    value = np.where(beyond, -np.inf if sight.cropped else np.maximum(value, 0.5) + overflow, value)
    value = value * pixel_footprint(sight.camera, depth)
    return np.where(depth > 0, value, -np.inf)


def free_distance(sight: Sight, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far points (n, 3) lie in front of the surface the view sees: distance (n,), -inf where unknown; weight (n,).

    The distance is to the tangent planes behind the four pixels around the point, or to the nearest pixel's where
    they belong to different surfaces.
    """
    value, weight, _, _ = tangent_distance(sight, points)
    return value, weight


def tangent_distance(sight: Sight, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """free_distance, the unit normal (n, 3) of the plane it was measured to, and where the surface there is smooth
    (n,)."""
    pixels, depth = project(sight.camera, points)
    h, w = sight.mask.shape
    column = np.clip(pixels[:, 0].astype(np.int64), 0, w - 1)
    row = np.clip(pixels[:, 1].astype(np.int64), 0, h - 1)
    nearest = row * w + column
    weighted = np.concatenate([sight.planes * sight.weight[..., None], sight.weight[..., None]], -1)
    mixed = bilinear(weighted, pixels)
    single = sight.rough.reshape(-1)[nearest] | (mixed[:, 4] <= 0)
    mixed[single] = weighted.reshape(-1, 5)[nearest[single]]
    weight = np.where(single, _ROUGH * mixed[:, 4], mixed[:, 4])
    scale = 1.0 / np.maximum(mixed[:, 4], 1e-12)
    value = (np.einsum("ij,ij->i", mixed[:, :3], points.astype(np.float32)) - mixed[:, 3]) * scale
    curtain = sight.curtain.reshape(-1)[nearest] * pixel_footprint(sight.camera, depth)
    bounded = (value > curtain) | ((value > 0) & sight.broken.reshape(-1)[nearest])
    value = np.minimum(value, curtain)
    weight = np.where(bounded, np.minimum(weight, WEAK), weight)
    inside = (pixels[:, 0] >= 0) & (pixels[:, 0] < w) & (pixels[:, 1] >= 0) & (pixels[:, 1] < h)
    known = (weight > 0) & inside & (depth > 0)
    return (
        np.where(known, value, -np.inf),
        np.where(known, weight, 0.0),
        mixed[:, :3] * scale[:, None],
        known & ~single & ~bounded,
    )


def bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """image (h, w, c) at pixel positions (n, 2), centres at + 0.5, clamped at the border -> (n, c) float32."""
    h, w, c = image.shape
    flat = image.reshape(h * w, c)
    x = np.clip(pixels[:, 0] - 0.5, 0, w - 1.000001)
    y = np.clip(pixels[:, 1] - 0.5, 0, h - 1.000001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    fx, fy = (x - column).astype(np.float32)[:, None], (y - row).astype(np.float32)[:, None]
    corner = row * w + column
    return (flat[corner] * (1 - fx) + flat[corner + 1] * fx) * (1 - fy) + (
        flat[corner + w] * (1 - fx) + flat[corner + w + 1] * fx
    ) * fy
