"""Move cameras with their world, choose their depth range, and tell whether two see the same picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gdtool.cameras.camera import Camera

# Largest difference of two equal cameras: of an entry of world_from_camera (world units for the position), and of the
# width of the view (a share).
SAME_VIEW_TOLERANCE = 1e-4
# The object fits into the sphere of this radius (world units) around the origin.
OBJECT_RADIUS = 1.0
# Least near distance of a camera inside or close to that sphere: a share of its distance, and world units.
MIN_NEAR_SHARE, MIN_NEAR = 0.05, 1e-3


def transform_camera(camera: Camera, matrix: np.ndarray) -> Camera:
    """Apply a similarity (4, 4) to the world of a camera; the camera sees the same picture as before."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    pose = np.eye(4)
    pose[:3, :3] = matrix[:3, :3] / scale @ camera.world_from_camera[:3, :3]
    pose[:3, 3] = matrix[:3, :3] @ camera.position + matrix[:3, 3]
    return replace(
        camera,
        world_from_camera=pose,
        half_width=camera.half_width * scale,
        near=camera.near * scale,
        far=camera.far * scale,
    )


def fit_depth_range(camera: Camera) -> Camera:
    """Set near and far so that they enclose the sphere around the object."""
    distance = float(camera.position @ camera.backward)
    near = max(distance - OBJECT_RADIUS, MIN_NEAR_SHARE * abs(distance), MIN_NEAR)
    return replace(camera, near=near, far=max(distance + OBJECT_RADIUS, float(np.nextafter(near, np.inf)) + MIN_NEAR))


def same_view(camera: Camera, other: Camera) -> bool:
    """Tell whether two cameras see the same picture; its size in pixels may differ, its aspect ratio may not."""
    if camera.projection != other.projection or camera.width * other.height != camera.height * other.width:
        return False
    if not np.allclose(camera.world_from_camera, other.world_from_camera, atol=SAME_VIEW_TOLERANCE):
        return False
    if camera.projection == "orthographic":
        return bool(np.isclose(camera.half_width, other.half_width, rtol=SAME_VIEW_TOLERANCE))
    return bool(np.isclose(camera.fx / camera.width, other.fx / other.width, rtol=SAME_VIEW_TOLERANCE))
