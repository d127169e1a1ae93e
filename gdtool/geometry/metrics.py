"""How far one surface is from another: the "surface" and the "syncdreamer" protocols (docs/metrics.md).

Every function takes the result first and the truth second, both as triangles in one frame, and returns plain floats.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gdtool.cameras import Camera, camera_at, project
from gdtool.cameras import rays as camera_rays
from gdtool.geometry.distance import closest_points, sample_surface, winding_number
from gdtool.geometry.normals import face_normals
from gdtool.geometry.rays import RayCaster
from gdtool.geometry.rows import first_equal

# What lies within this of the first hit counts as seen: half a pixel of 256 across 1.44, in units of the truth's size.
SEEN_TOLERANCE = 2e-3
SEEN_COSINE = 0.05  # flatter than that, a pixel spreads over twenty times its size
IOU_CELLS, IOU_PAD, BLOCK = 128, 1.1, 4
# syncdreamer: 16 cameras around at elevation 30, distance 1.5, a 35 mm lens on a 32 mm sensor.
SYNC_VIEWS, SYNC_SIZE, SYNC_ELEVATION, SYNC_DISTANCE, SYNC_VOXEL, SYNC_CELLS = 16, 256, 30.0, 1.5, 0.01, 64
SYNC_FOV = float(np.degrees(2 * np.arctan(32 / 35 / 2)))


def weld(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """faces (f, 3) with vertices of equal position named by one index: glTF splits them at seams."""
    return first_equal(vertices)[faces]


def is_closed(vertices: np.ndarray, faces: np.ndarray) -> bool:
    """Whether the surface has no boundary: each edge is walked as often one way as the other, after welding.

    This, and not two faces an edge, is what makes the winding number a whole number everywhere: bodies that touch in
    an edge are closed, a body of which one part is inside out is not.
    """
    if not len(faces):
        return False
    welded = weld(vertices, faces).astype(np.int64)
    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    count = int(welded.max()) + 1
    edge = np.minimum(start, end) * count + np.maximum(start, end)
    _, index = np.unique(edge, return_inverse=True)
    return not np.bincount(index.reshape(-1), np.sign(end - start)).any()


def seen(
    points: np.ndarray, normals: np.ndarray, caster: RayCaster, cameras: Sequence[Camera], tolerance: float
) -> np.ndarray:
    """(n,) bool: whether points (n, 3) on the caster's mesh are in the picture of any camera and nothing hides them.

    Faces are seen from both sides, but not edge-on: normals (n, 3).
    """
    out = np.zeros(len(points), bool)
    for camera in cameras:
        left = np.flatnonzero(~out)
        pixels, depth = project(camera, points[left])
        within = (pixels >= 0).all(1) & (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height) & (depth > 0)
        left = left[within]
        origins, directions = camera_rays(camera, pixels[within])
        facing = np.abs(np.einsum("ij,ij->i", normals[left], directions)) >= SEEN_COSINE
        left, origins, directions = left[facing], origins[facing], directions[facing]
        distance = np.einsum("ij,ij->i", points[left] - origins, directions)
        # The first hit, not a query for anything between: the point's own face must not hide it.
        out[left] = caster.first_hit(origins, directions).distance >= distance - tolerance
    return out


def surface_protocol(
    vertices: np.ndarray,
    faces: np.ndarray,
    true_vertices: np.ndarray,
    true_faces: np.ndarray,
    *,
    cameras: Sequence[Camera] | None = None,
    samples: int = 100_000,
    seed: int = 0,
    threshold: float = 0.01,
    cells: int = IOU_CELLS,
) -> dict[str, float]:
    """Return the "surface" protocol: distances from area-weighted samples of each surface to the other *surface*.

    Unit: the truth's largest extent. distance is the mean of accuracy (result to truth) and completeness (truth to
    result); precision and recall are the shares within the threshold, f_score their harmonic mean. normal_degrees is
    the mean angle between a sample's normal and that of the closest point, orientation left aside (0 to 90);
    flipped_share is how many of these face the other way. iou is at cells^3 over the truth's box padded by a tenth, and
    only there when the truth is closed. With cameras the same over what they see, as seen_*: from the part of the truth
    that they see to the result, and from the part of the result that they would see to the truth.
    """
    extent = float(np.ptp(true_vertices[np.unique(true_faces)], axis=0).max())
    vertices, true_vertices = vertices / extent, true_vertices / extent
    rng = np.random.default_rng(seed)
    points, face_idx, _ = sample_surface(vertices, faces, samples, rng)
    true_points, true_idx, _ = sample_surface(true_vertices, true_faces, samples, rng)
    accuracy, near_true_idx, near_true = closest_points(points, true_vertices, true_faces)
    completeness, near_idx, _ = closest_points(true_points, vertices, faces)
    normals, true_normals = face_normals(vertices, faces)[0], face_normals(true_vertices, true_faces)[0]
    cosine = (normals[face_idx] * true_normals[near_true_idx]).sum(1)
    true_cosine = (true_normals[true_idx] * normals[near_idx]).sum(1)

    out = _two_ways(accuracy, completeness, cosine, true_cosine, threshold)
    out["hausdorff"] = float(max(accuracy.max(), completeness.max()))
    if is_closed(true_vertices, true_faces):
        out["iou"] = volume_iou(vertices, faces, true_vertices, true_faces, cells)
    if cameras:
        part = _seen(points, normals[face_idx], vertices, faces, cameras, extent)
        true_part = _seen(true_points, true_normals[true_idx], true_vertices, true_faces, cameras, extent)
        out["seen_share"] = float(true_part.mean())
        if part.any() and true_part.any():
            found = _two_ways(accuracy[part], completeness[true_part], cosine[part], true_cosine[true_part], threshold)
            out |= {f"seen_{name}": value for name, value in found.items()}
    return out


def _seen(points, normals, vertices, faces, cameras, extent: float) -> np.ndarray:
    """seen() of points in units of the extent, for cameras in the caller's."""
    return seen(points * extent, normals, RayCaster(vertices * extent, faces), cameras, SEEN_TOLERANCE * extent)


def _two_ways(accuracy, completeness, cosine, true_cosine, threshold: float) -> dict[str, float]:
    precision, recall = float((accuracy <= threshold).mean()), float((completeness <= threshold).mean())

    def angle(c: np.ndarray) -> float:
        return float(np.degrees(np.arccos(np.clip(np.abs(c), 0, 1))).mean())

    return {
        "distance": float(accuracy.mean() + completeness.mean()) / 2,
        "accuracy": float(accuracy.mean()),
        "completeness": float(completeness.mean()),
        "f_score": 2 * precision * recall / (precision + recall) if precision + recall else 0.0,
        "precision": precision,
        "recall": recall,
        "normal_degrees": (angle(cosine) + angle(true_cosine)) / 2,
        "flipped_share": float((cosine < 0).mean() + (true_cosine < 0).mean()) / 2,
    }


def inside(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n,) bool by winding number; either orientation of the whole surface is taken."""
    return np.abs(winding_number(points, vertices, faces)) > 0.5


def volume_iou(
    vertices: np.ndarray,
    faces: np.ndarray,
    true_vertices: np.ndarray,
    true_faces: np.ndarray,
    cells: int = IOU_CELLS,
    pad: float = IOU_PAD,
) -> float:
    """Intersection over union of the two volumes on cells^3 cell centres of the cube around the truth.

    The cube has the truth's largest extent times pad as its side and the truth's centre. 0 when both are empty there.
    """
    used = true_vertices[np.unique(true_faces)]
    low, high = used.min(0), used.max(0)
    return _grid_iou(
        vertices, faces, true_vertices, true_faces, (low + high) / 2, float((high - low).max()) * pad, cells
    )


def _grid_iou(vertices, faces, true_vertices, true_faces, center, side: float, cells: int) -> float:
    a, b = (occupancy(v, f, center, side, cells) for v, f in ((vertices, faces), (true_vertices, true_faces)))
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 0.0


def occupancy(vertices: np.ndarray, faces: np.ndarray, center: np.ndarray, side: float, cells: int) -> np.ndarray:
    """(cells, cells, cells) bool: which cell centres of a cube lie inside.

    Blocks of cells that a closed surface does not pass through are asked about once: the winding number is constant
    there. Around an open surface it is not, so there every cell is asked.
    """
    block = BLOCK if cells % BLOCK == 0 and is_closed(vertices, faces) else 1
    centers = _cell_centers(cells // block, side) + center
    out = inside(centers, vertices, faces).reshape((cells // block,) * 3)
    if block == 1:
        return out
    half_diagonal = np.sqrt(3) / 2 * side * block / cells
    near = np.flatnonzero(closest_points(centers, vertices, faces)[0] <= half_diagonal)
    out = out.repeat(block, 0).repeat(block, 1).repeat(block, 2)
    within = _cell_centers(block, side * block / cells)
    fine = inside((centers[near, None] + within).reshape(-1, 3), vertices, faces).reshape(-1, block, block, block)
    blocks = out.reshape(cells // block, block, cells // block, block, cells // block, block)
    x, y, z = np.unravel_index(near, (cells // block,) * 3)
    blocks[x, :, y, :, z, :] = fine
    return out


def _cell_centers(cells: int, side: float) -> np.ndarray:
    """(cells^3, 3) centres of the cells of a cube around the origin, x slowest."""
    steps = ((np.arange(cells) + 0.5) / cells - 0.5) * side
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)


def syncdreamer_protocol(
    vertices: np.ndarray, faces: np.ndarray, true_vertices: np.ndarray, true_faces: np.ndarray
) -> dict[str, float]:
    """Return the "syncdreamer" protocol, which published tables of single-image methods use (Liu et al. 2023).

    Both are moved alike so that the truth is centred with largest extent 1. Sixteen fixed 256^2 depth views of each are
    back-projected and voxel-downsampled at 0.01; chamfer is the mean unsquared distance to the nearest point each way,
    averaged; iou is on 64^3 cells over [-1, 1]. The result is not aligned; icp_* say the same after it was aligned to
    the truth by a similarity, icp_scale by how much that scaled it. A result that no view sees gives no figures.
    """
    used = true_vertices[np.unique(true_faces)]
    low, high = used.min(0), used.max(0)
    center, extent = (low + high) / 2, float((high - low).max())
    vertices, true_vertices = (vertices - center) / extent, (true_vertices - center) / extent
    cloud, true_cloud = depth_cloud(vertices, faces), depth_cloud(true_vertices, true_faces)
    if not len(cloud) or not len(true_cloud):
        return {}

    def measure(vertices: np.ndarray, cloud: np.ndarray) -> dict[str, float]:
        there, back = nearest(cloud, true_cloud)[0], nearest(true_cloud, cloud)[0]
        iou = _grid_iou(vertices, faces, true_vertices, true_faces, np.zeros(3), 2.0, SYNC_CELLS)
        return {"chamfer": float(there.mean() + back.mean()) / 2, "iou": iou}

    out = measure(vertices, cloud)
    matrix = align(cloud, true_cloud)
    moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    aligned = measure(moved, depth_cloud(moved, faces))
    out |= {f"icp_{name}": value for name, value in aligned.items()}
    out["icp_scale"] = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return out


def sync_cameras() -> list[Camera]:
    """Return the sixteen fixed cameras of the protocol."""
    return [
        camera_at(
            360 * i / SYNC_VIEWS,
            SYNC_ELEVATION,
            name=f"{i:02d}",
            size=SYNC_SIZE,
            distance=SYNC_DISTANCE,
            fov_degrees=SYNC_FOV,
        )
        for i in range(SYNC_VIEWS)
    ]


def depth_cloud(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(n, 3) points of the sixteen depth views, one mean point per voxel of 0.01; empty when nothing is seen."""
    caster, parts = RayCaster(vertices, faces), []
    for camera in sync_cameras():
        origins, directions = (array.reshape(-1, 3) for array in camera_rays(camera))
        hits = caster.first_hit(origins, directions)
        parts.append(origins[hits.found] + hits.distance[hits.found, None] * directions[hits.found])
    return voxel_downsample(np.concatenate(parts), SYNC_VOXEL)


def voxel_downsample(points: np.ndarray, size: float) -> np.ndarray:
    """Return the mean of the points in each occupied voxel of a grid that starts at their minimum."""
    if not len(points):
        return points
    cell = np.floor((points - points.min(0)) / size).astype(np.int64)
    span = cell.max(0) + 1
    _, index = np.unique((cell[:, 0] * span[1] + cell[:, 1]) * span[2] + cell[:, 2], return_inverse=True)
    index = index.reshape(-1)
    count = np.bincount(index)
    return np.stack([np.bincount(index, points[:, axis]) / count for axis in range(3)], -1)


def nearest(points: np.ndarray, others: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance (n,) from each point to the nearest of the others, and its index (n,)."""
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)


def align(points: np.ndarray, others: np.ndarray, steps: int = 60, count: int = 8000) -> np.ndarray:
    """(4, 4) similarity that takes points onto others by iterative closest points, from where they are.

    Pairs are taken both ways: with one way only, the best scale of a part is to shrink onto a point.
    """
    # Each with a generator of its own: of equal clouds equal points are drawn, which then stay where they are.
    a, b = (part[np.random.default_rng(0).permutation(len(part))[:count]] for part in (points, others))
    total, last = np.eye(4), np.inf
    for _ in range(steps):
        moved = a @ total[:3, :3].T + total[:3, 3]
        (there, b_idx), (back, a_idx) = nearest(moved, b), nearest(b, moved)
        error = float((there**2).mean() + (back**2).mean())
        if error >= last * (1 - 1e-5):
            break
        last = error
        step = similarity(
            np.concatenate([moved, moved[a_idx]]),
            np.concatenate([b[b_idx], b]),
            np.concatenate([np.full(len(a), 1 / len(a)), np.full(len(b), 1 / len(b))]),
        )
        total = step @ total
    return total


def similarity(points: np.ndarray, others: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(4, 4) rotation, uniform scale and translation that take points (n, 3) to others in least squares (Umeyama
    1991)."""
    weights = weights / weights.sum()
    center, other_center = weights @ points, weights @ others
    a, b = points - center, others - other_center
    u, singular, vt = np.linalg.svd((b * weights[:, None]).T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    spread = float(weights @ (a * a).sum(1))
    out = np.eye(4)
    out[:3, :3] = (u * sign) @ vt * (float(singular @ sign) / spread if spread > 0 else 1.0)
    out[:3, 3] = other_center - out[:3, :3] @ center
    return out
