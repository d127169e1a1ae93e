"""Add parts that the picture shows, and that the sampled outlines leave no space for, to all views.

The object's outline from the front is that of the picture, and exact. The other outlines are sampled by the model, and
thin parts (ribbons, arms, spires) fade first in them. A lost part is placed along the rays of the front view: at the
depth where the product of the other views' coverage is largest, and near the front view's depth. It is as thick as it
is wide, up to a bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, backproject, project
from gdtool.images.sampling import bilinear

MIN_WIDTH_PX = 2  # least width of a lost part; narrower gaps are errors of the outlines
OVERLAP_PX = 2  # pixels of the object around a part that are drawn with it, to join the two
DEPTH_SIGMA = 0.08  # world units: standard deviation of the front view's depth
MIN_COVERAGE = 0.02  # least coverage in a logarithm
PLACE_BLUR_PX = 1.5  # Gaussian blur of a part's depth
MIN_HALF_PX, MAX_HALF_PX = 1.0, 3.0  # pixels: least and most half thickness of a part
SEARCH_RANGE = 0.75  # world units to either side of the origin that are searched for a part
DEPTHS_PER_PIXEL = 2  # candidate depths per pixel size
MIN_FACING_COSINE = 0.2  # least cosine between a part's normal and the direction to the camera


@dataclass(frozen=True)
class LostPart:
    """Hold the n pixels of a lost part in the view whose outline is known.

    row, column (n,): the pixels. middle (n,): depth of the part's middle, in world units. half (n,): half its
    thickness, in world units. outward (n, 3): unit vector toward the nearest outline. lost (n,): false for the pixels
    around the part that join it to the rest of the object.
    """

    row: np.ndarray
    column: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    outward: np.ndarray
    lost: np.ndarray


def find_lost_part(
    soft: np.ndarray, mask: np.ndarray, cameras: list[Camera], known_view: int, depth: np.ndarray | None
) -> LostPart | None:
    """Find the pixels of the known view behind which the other masks leave no space; None where there are none.

    Args:
        soft: (k, h, w), coverage as the model sampled it, 0 to 1.
        mask: (k, h, w), coverage after sharpening; that of the known view is exact.
        cameras: of the k views.
        known_view: index of the view whose outline is exact.
        depth: (h, w), the known view's depth in world units, or None.
    """
    from scipy.ndimage import binary_dilation, binary_opening, distance_transform_edt, gaussian_filter

    camera, covered = cameras[known_view], mask[known_view] > 0.5
    side_views = [k for k, other in enumerate(cameras) if abs(float(other.backward @ camera.backward)) < 0.99]
    if not side_views or not covered.any() or camera.projection != "orthographic":
        return None
    pixel = camera.pixel_size
    row, column = np.nonzero(covered)
    origin = float(np.linalg.norm(camera.position))
    places = origin + np.arange(-SEARCH_RANGE, SEARCH_RANGE, pixel / DEPTHS_PER_PIXEL)
    start = backproject(camera, np.zeros(covered.shape))[row, column]
    points = (start[:, None] - places[None, :, None] * camera.backward).reshape(-1, 3)
    least, score = np.ones(len(points)), np.zeros(len(points))
    for k in side_views:
        pixels = project(cameras[k], points)[0]
        least = np.minimum(least, bilinear(mask[k][..., None], pixels)[:, 0])
        score += np.log(np.maximum(bilinear(gaussian_filter(soft[k], 1.0)[..., None], pixels)[:, 0], MIN_COVERAGE))
    least, score = least.reshape(len(row), -1), score.reshape(len(row), -1)
    lost = np.zeros(covered.shape, bool)
    lost[row, column] = least.max(1) <= 0.5
    lost = binary_opening(lost, np.ones((MIN_WIDTH_PX, MIN_WIDTH_PX)))
    if not lost.any():
        return None
    edge_distance = distance_transform_edt(covered) - 0.5  # distance of the pixel's centre
    half = np.clip(edge_distance, MIN_HALF_PX, MAX_HALF_PX) * pixel
    if depth is not None:
        score -= 0.5 * ((places - (depth + half)[row, column][:, None]) / DEPTH_SIGMA) ** 2
    place, has_depth = np.zeros(covered.shape), np.zeros(covered.shape)
    place[row, column], has_depth[row, column] = places[score.argmax(1)], 1.0
    zone = binary_dilation(lost, iterations=OVERLAP_PX) & covered
    weight = gaussian_filter(np.where(zone, has_depth, 0.0), PLACE_BLUR_PX)
    middle = gaussian_filter(np.where(zone, place, 0.0), PLACE_BLUR_PX) / np.maximum(weight, 1e-9)
    at = np.nonzero(zone)
    down, right = np.gradient(gaussian_filter(edge_distance, 1.0))
    outward = down[at][:, None] * camera.world_from_camera[:3, 1] - right[at][:, None] * camera.world_from_camera[:3, 0]
    return LostPart(
        at[0],
        at[1],
        middle[at],
        half[at],
        outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9),
        lost[at],
    )


def add_part_to_masks(part: LostPart, mask: np.ndarray, cameras: list[Camera], known_view: int) -> np.ndarray:
    """Add the part to a copy of the masks (k, h, w), except to that of the view with index `known_view`."""
    out = mask.copy()
    for k in range(len(cameras)):
        if k != known_view:
            row, column, *_ = _project_part(part, mask.shape[1:], cameras, known_view, k)
            out[k][row, column] = 1.0
    return out


def draw_part(
    part: LostPart, images: dict[str, np.ndarray], mask: np.ndarray, cameras: list[Camera], known_view: int
) -> None:
    """Draw the part into the images (k, h, w[, c]) of all domains, in place.

    Its colors and materials are those of the known view. Its depth is computed for each view, and its normals are those
    of a rod along it. mask (k, h, w): the masks before the part was added.
    """
    known_values = {domain: image[known_view].copy() for domain, image in images.items()}
    for k in range(len(cameras)):
        row, column, depth, normal, source = _project_part(part, mask.shape[1:], cameras, known_view, k)
        put = part.lost[source] if k == known_view else mask[k][row, column] <= 0.5
        if k != known_view and "depth" in images:
            put |= images["depth"][k][row, column] > depth
        row, column, depth, normal, source = row[put], column[put], depth[put], normal[put], source[put]
        fresh = mask[k][row, column] <= 0.5
        for domain, image in images.items():
            if domain == "depth":
                image[k][row, column] = depth
            elif k != known_view:
                values = normal if domain == "normal" else known_values[domain][part.row[source], part.column[source]]
                image[k][row[fresh], column[fresh]] = values[fresh]


def _project_part(
    part: LostPart, shape: tuple[int, ...], cameras: list[Camera], known_view: int, k: int
) -> tuple[np.ndarray, ...]:
    """Project the part into view k, and keep the point nearest to the camera in each pixel.

    shape: (h, w) of the views. Returns, for m pixels: row (m,), column (m,), depth (m,), unit normal (m, 3), and the
    index (m,) of the part's pixel that is seen there.
    """
    camera = cameras[known_view]
    steps = np.linspace(-1.0, 1.0, 2 * int(np.ceil(part.half.max() / camera.pixel_size)) * DEPTHS_PER_PIXEL + 1)
    start = backproject(camera, np.zeros(shape))[part.row, part.column]
    places = part.middle[:, None] + part.half[:, None] * steps
    points = start[:, None] - places[..., None] * camera.backward
    pixels, depth = project(cameras[k], points.reshape(-1, 3))
    column, row = np.floor(pixels).astype(int).T
    in_image = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    depth = np.clip(depth, cameras[k].near, cameras[k].far)
    order = np.argsort(depth[in_image], kind="stable")
    flat, first = np.unique((row[in_image] * shape[1] + column[in_image])[order], return_index=True)
    chosen = np.flatnonzero(in_image)[order][first]
    source, across = chosen // len(steps), steps[chosen % len(steps)][:, None]
    normal = part.outward[source] * np.sqrt(1 - across**2) - across * camera.backward
    normal += cameras[k].backward * np.maximum(MIN_FACING_COSINE - normal @ cameras[k].backward, 0.0)[:, None]
    return (
        flat // shape[1],
        flat % shape[1],
        depth[chosen],
        normal / np.linalg.norm(normal, axis=1, keepdims=True),
        source,
    )
