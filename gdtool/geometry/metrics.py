"""Measure how far one surface is from another: the "surface" and the "syncdreamer" protocols (docs/metrics.md).

Functions take the result first and the truth second, as triangles in one frame, and return plain floats.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gdtool.cameras import Camera, camera_at, project
from gdtool.cameras import rays as camera_rays
from gdtool.geometry.distance import closest_points, sample_surface, winding_number
from gdtool.geometry.meshes import TriMesh
from gdtool.geometry.normals import face_normals
from gdtool.geometry.rays import RayCaster
from gdtool.geometry.unique_rows import index_of_first_equal

# Share of the truth's size by which a point may lie behind the first hit and be visible: half a pixel of 256 across
# 1.44.
VISIBLE_TOLERANCE = 2e-3
VISIBLE_COSINE = 0.05  # of the angle to the ray; below it a pixel spreads over twenty times its size
# Cells along each side of the cube for the volume, its side in units of the truth's size, and cells along each side of
# a block that is tested at once.
IOU_CELLS, IOU_PAD, BLOCK = 128, 1.1, 4
# The syncdreamer protocol: 16 cameras around at elevation 30, distance 1.5, a 35 mm lens on a 32 mm sensor.
SYNC_VIEWS, SYNC_SIZE, SYNC_ELEVATION, SYNC_DISTANCE, SYNC_VOXEL, SYNC_CELLS = 16, 256, 30.0, 1.5, 0.01, 64
SYNC_FOV = float(np.degrees(2 * np.arctan(32 / 35 / 2)))


@dataclass(frozen=True)
class SurfaceOptions:
    """Choose how surface_protocol() measures.

    cameras: the part of a surface that these see is measured as well. samples: number of points on each surface. seed:
    of their random positions. threshold: distance for precision and recall, as a share of the truth's largest extent.
    cells: number of cells along each side of the cube for the intersection over union.
    """

    cameras: Sequence[Camera] = ()
    samples: int = 100_000
    seed: int = 0
    threshold: float = 0.01
    cells: int = IOU_CELLS


def weld_faces(mesh: TriMesh) -> np.ndarray:
    """Return faces (f, 3) with one index for vertices at equal positions; glTF doubles vertices at seams."""
    return index_of_first_equal(mesh.vertices)[mesh.faces]


def is_closed(mesh: TriMesh) -> bool:
    """Tell whether a surface has no boundary: after welding, its faces traverse each edge equally often in both
    directions.

    This rule, and not two faces for each edge, makes the winding number an integer everywhere. Bodies that touch along
    an edge are closed. A body of which one part is inside out is not.
    """
    if not len(mesh.faces):
        return False
    welded = weld_faces(mesh).astype(np.int64)
    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    count = int(welded.max()) + 1
    edge = np.minimum(start, end) * count + np.maximum(start, end)
    _, index = np.unique(edge, return_inverse=True)
    return not np.bincount(index.reshape(-1), np.sign(end - start)).any()


def visible(
    points: np.ndarray, normals: np.ndarray, caster: RayCaster, cameras: Sequence[Camera], tolerance: float
) -> np.ndarray:
    """Return (n,) bool: whether points (n, 3) on the caster's mesh are visible in any camera's picture.

    normals (n, 3): faces are visible from both sides, but not edge-on. tolerance: how far a point may lie behind the
    first hit of its ray, in the unit of the points.
    """
    out = np.zeros(len(points), bool)
    for camera in cameras:
        left = np.flatnonzero(~out)
        pixels, depth = project(camera, points[left])
        within = (pixels >= 0).all(1) & (pixels[:, 0] <= camera.width) & (pixels[:, 1] <= camera.height) & (depth > 0)
        left = left[within]
        origins, directions = camera_rays(camera, pixels[within])
        facing = np.abs(np.einsum("ij,ij->i", normals[left], directions)) >= VISIBLE_COSINE
        left, origins, directions = left[facing], origins[facing], directions[facing]
        distance = np.einsum("ij,ij->i", points[left] - origins, directions)
        # The first hit, not a query for anything in between: the point's face must not hide the point.
        out[left] = caster.first_hit(origins, directions).distance >= distance - tolerance
    return out


def surface_protocol(mesh: TriMesh, truth: TriMesh, options: SurfaceOptions | None = None) -> dict[str, float]:
    """Run the "surface" protocol: distances from area-weighted samples of each surface to the other *surface*.

    Distances are in units of the truth's largest extent. distance is the mean of accuracy (result to truth) and
    completeness (truth to result). precision and recall are the shares of samples within the threshold, f_score their
    harmonic mean. normal_degrees is the mean angle between a sample's normal and that of the closest point, orientation
    ignored (0 to 90); flipped_share is the share of these pairs that face opposite ways. iou is computed on cells^3
    cells of the truth's box padded by a tenth, and only where the truth is closed.

    With cameras the same figures follow as seen_* for the visible parts. Completeness is then measured from the part of
    the truth that the cameras see, accuracy from the part of the result that they would see.
    """
    options = options or SurfaceOptions()
    extent = float(np.ptp(truth.vertices[np.unique(truth.faces)], axis=0).max())
    mesh, truth = TriMesh(mesh.vertices / extent, mesh.faces), TriMesh(truth.vertices / extent, truth.faces)
    rng = np.random.default_rng(options.seed)
    points, face_idx, _ = sample_surface(mesh, options.samples, rng)
    true_points, true_idx, _ = sample_surface(truth, options.samples, rng)
    accuracy, near_true_idx, _ = closest_points(points, truth)
    completeness, near_idx, _ = closest_points(true_points, mesh)
    normals, true_normals = face_normals(mesh)[0], face_normals(truth)[0]
    cosine = (normals[face_idx] * true_normals[near_true_idx]).sum(1)
    true_cosine = (true_normals[true_idx] * normals[near_idx]).sum(1)

    out = _two_way_figures(accuracy, completeness, cosine, true_cosine, options.threshold)
    out["hausdorff"] = float(max(accuracy.max(), completeness.max()))
    if is_closed(truth):
        out["iou"] = volume_iou(mesh, truth, options.cells)
    if options.cameras:
        part = _visible_in_unit(points, normals[face_idx], mesh, options.cameras, extent)
        true_part = _visible_in_unit(true_points, true_normals[true_idx], truth, options.cameras, extent)
        out["seen_share"] = float(true_part.mean())
        if part.any() and true_part.any():
            of_visible = _two_way_figures(
                accuracy[part], completeness[true_part], cosine[part], true_cosine[true_part], options.threshold
            )
            out |= {f"seen_{name}": value for name, value in of_visible.items()}
    return out


def _visible_in_unit(
    points: np.ndarray, normals: np.ndarray, mesh: TriMesh, cameras: Sequence[Camera], extent: float
) -> np.ndarray:
    """Return (n,) bool: whether points (n, 3) of a mesh are visible in any camera's picture.

    points, mesh: in units of `extent`, which is in the cameras' unit. normals (n, 3): of the points, unit.
    """
    caster = RayCaster(TriMesh(mesh.vertices * extent, mesh.faces))
    return visible(points * extent, normals, caster, cameras, VISIBLE_TOLERANCE * extent)


def _two_way_figures(
    accuracy: np.ndarray, completeness: np.ndarray, cosine: np.ndarray, true_cosine: np.ndarray, threshold: float
) -> dict[str, float]:
    """Return the figures of distances and normals' cosines, from result to truth and from truth to result."""
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


def inside(points: np.ndarray, mesh: TriMesh) -> np.ndarray:
    """Return (n,) bool: whether points (n, 3) lie inside a mesh, by winding number.

    The whole mesh may be inside out.
    """
    return np.abs(winding_number(points, mesh)) > 0.5


def volume_iou(mesh: TriMesh, truth: TriMesh, cells: int = IOU_CELLS, pad: float = IOU_PAD) -> float:
    """Compute the intersection over union of two volumes at the centres of cells^3 cells of a cube around the truth.

    The cube's side is the truth's largest extent times pad. 0 where both are empty there.
    """
    used = truth.vertices[np.unique(truth.faces)]
    low, high = used.min(0), used.max(0)
    return _grid_iou(mesh, truth, (low + high) / 2, float((high - low).max()) * pad, cells)


def _grid_iou(mesh: TriMesh, truth: TriMesh, center: np.ndarray, side: float, cells: int) -> float:
    """Compute the intersection over union of two volumes at the centres of cells^3 cells of a cube.

    center (3,) and side of the cube, in the unit of the meshes.
    """
    a, b = (occupancy(body, center, side, cells) for body in (mesh, truth))
    either = int((a | b).sum())
    return int((a & b).sum()) / either if either else 0.0


def occupancy(mesh: TriMesh, center: np.ndarray, side: float, cells: int) -> np.ndarray:
    """Return (cells, cells, cells) bool: which cell centres of a cube lie inside the mesh.

    center (3,) and side of the cube, in the unit of the mesh. A block of cells that a closed surface does not pass
    through is tested once, because the winding number is constant there. Around an open surface it is not, so every
    cell is tested.
    """
    block = BLOCK if cells % BLOCK == 0 and is_closed(mesh) else 1
    centers = _cell_centers(cells // block, side) + center
    out = inside(centers, mesh).reshape((cells // block,) * 3)
    if block == 1:
        return out
    half_diagonal = np.sqrt(3) / 2 * side * block / cells
    near = np.flatnonzero(closest_points(centers, mesh)[0] <= half_diagonal)
    out = out.repeat(block, 0).repeat(block, 1).repeat(block, 2)
    within = _cell_centers(block, side * block / cells)
    fine = inside((centers[near, None] + within).reshape(-1, 3), mesh).reshape(-1, block, block, block)
    blocks = out.reshape(cells // block, block, cells // block, block, cells // block, block)
    x, y, z = np.unravel_index(near, (cells // block,) * 3)
    blocks[x, :, y, :, z, :] = fine
    return out


def _cell_centers(cells: int, side: float) -> np.ndarray:
    """Return the centres (cells^3, 3) of the cells of a cube around the origin, x slowest."""
    steps = ((np.arange(cells) + 0.5) / cells - 0.5) * side
    return np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)


def syncdreamer_protocol(mesh: TriMesh, truth: TriMesh) -> dict[str, float]:
    """Run the "syncdreamer" protocol, which published tables of single-image methods use (Liu et al. 2023).

    Both meshes are moved alike so that the truth is centred and its largest extent is 1. Sixteen fixed 256^2 depth
    views of each are back-projected and voxel-downsampled at 0.01. chamfer is the mean unsquared distance to the
    nearest point, averaged over both directions; iou is computed on 64^3 cells over [-1, 1]. The result is not aligned;
    icp_* are the same figures after it was aligned to the truth by a similarity, icp_scale by how much that scaled it.
    A result that no view sees gives no figures.
    """
    used = truth.vertices[np.unique(truth.faces)]
    low, high = used.min(0), used.max(0)
    center, extent = (low + high) / 2, float((high - low).max())
    mesh, truth = (TriMesh((body.vertices - center) / extent, body.faces) for body in (mesh, truth))
    cloud, true_cloud = depth_cloud(mesh), depth_cloud(truth)
    if not len(cloud) or not len(true_cloud):
        return {}

    def measure(body: TriMesh, cloud: np.ndarray) -> dict[str, float]:
        there, back = nearest(cloud, true_cloud)[0], nearest(true_cloud, cloud)[0]
        iou = _grid_iou(body, truth, np.zeros(3), 2.0, SYNC_CELLS)
        return {"chamfer": float(there.mean() + back.mean()) / 2, "iou": iou}

    out = measure(mesh, cloud)
    matrix = align(cloud, true_cloud)
    moved = TriMesh(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3], mesh.faces)
    aligned = measure(moved, depth_cloud(moved))
    out |= {f"icp_{name}": value for name, value in aligned.items()}
    out["icp_scale"] = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    return out


def sync_cameras() -> list[Camera]:
    """Return the sixteen fixed cameras of the syncdreamer protocol."""
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


def depth_cloud(mesh: TriMesh) -> np.ndarray:
    """Return the points (n, 3) of the sixteen depth views, their mean in each voxel of 0.01; empty where none hits."""
    caster, parts = RayCaster(mesh), []
    for camera in sync_cameras():
        origins, directions = (array.reshape(-1, 3) for array in camera_rays(camera))
        hits = caster.first_hit(origins, directions)
        parts.append(origins[hits.is_hit] + hits.distance[hits.is_hit, None] * directions[hits.is_hit])
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
    """Return the distance (n,) from each of points (n, 3) to the nearest of the others (m, 3), and its index (n,)."""
    from scipy.spatial import cKDTree

    return cKDTree(others).query(points)


def align(points: np.ndarray, others: np.ndarray, steps: int = 60, count: int = 8000) -> np.ndarray:
    """Align points (n, 3) to others (m, 3) by iterative closest points; return the (4, 4) similarity.

    steps: iterations at most; count: points of each cloud that are used. Each point is paired with its nearest in both
    directions: with one direction alone, the best scale of a part is to shrink it to a point.
    """
    # Both generators start equal, so that equal clouds keep equal points, which then do not move.
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
    """Return the (4, 4) rotation, uniform scale and translation that best map points (n, 3) to others (n, 3).

    It minimises the squared distances, weighted by weights (n,), after Umeyama 1991.
    """
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
