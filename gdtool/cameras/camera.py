"""Define the camera of the whole project, its projections, and the rigs made of it.

Camera axes are OpenGL's: x right, y up, the camera looks along -z. Pixel (row 0, column 0) is the top left one and its
centre lies at (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

# Name and azimuth in degrees; 0 is in front (on +Z), positive toward +X.
SIX_VIEWS = (
    ("front", 0.0),
    ("front_right", 45.0),
    ("right", 90.0),
    ("back", 180.0),
    ("left", -90.0),
    ("front_left", -45.0),
)
HALF_WIDTH = 0.72  # a unit cube turned by 45 degrees is 1.414 wide: 0.707 and a margin of two pixels in 256
DISTANCE = 2.0


@dataclass(frozen=True)
class Camera:
    """Hold a pinhole or orthographic camera.

    world_from_camera (4, 4): rigid. Orthographic: the image covers [-half_width, half_width] across, with square
    pixels. Perspective: focal length fx, fy and principal point cx, cy in pixels. near, far: distances along the
    viewing axis, in world units, between which the object lies.
    """

    name: str
    world_from_camera: np.ndarray
    width: int
    height: int
    projection: Literal["orthographic", "perspective"] = "orthographic"
    half_width: float = HALF_WIDTH
    fx: float = 0.0
    fy: float = 0.0
    cx: float = 0.0
    cy: float = 0.0
    near: float = 1.0
    far: float = 3.0

    @property
    def position(self) -> np.ndarray:
        """Position (3,) in the world."""
        return self.world_from_camera[:3, 3]

    @property
    def backward(self) -> np.ndarray:
        """Unit vector (3,) from the scene toward the camera (the camera's +z)."""
        return self.world_from_camera[:3, 2]

    @property
    def pixel_size(self) -> float:
        """World units per pixel, of orthographic cameras only."""
        return 2.0 * self.half_width / self.width


def look_at(position, target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0)) -> np.ndarray:
    """Compute world_from_camera (4, 4) of a camera at position that looks at target, with the given up direction."""
    position, target, up = (np.asarray(x, np.float64) for x in (position, target, up))
    backward = position - target
    backward /= np.linalg.norm(backward)
    right = np.cross(up, backward)
    if np.linalg.norm(right) < 1e-9:  # looking straight up or down: any right will do
        right = np.cross((0.0, 0.0, -1.0), backward)
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :4] = np.stack([right, np.cross(backward, right), backward, position], 1)
    return out


def camera_at(
    azimuth: float,
    elevation: float = 0.0,
    *,
    name: str,
    size: int,
    distance: float = DISTANCE,
    half_width: float = HALF_WIDTH,
    fov_degrees: float | None = None,
) -> Camera:
    """Place a camera on a sphere around the origin, looking at it.

    azimuth, elevation: degrees; azimuth 0 is on +Z, positive toward +X. size: side of its square image in pixels.
    distance, half_width: world units. fov_degrees: horizontal field of view of a perspective camera; None for an
    orthographic one.
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    position = distance * np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    pose = look_at(position)
    near, far = max(distance - 1.0, 0.05 * distance), distance + 1.0
    if fov_degrees is None:
        return Camera(name, pose, size, size, half_width=half_width, near=near, far=far)
    focal = 0.5 * size / np.tan(np.radians(fov_degrees) / 2)
    return Camera(
        name, pose, size, size, "perspective", fx=focal, fy=focal, cx=size / 2, cy=size / 2, near=near, far=far
    )


def rig(name: str, size: int) -> list[Camera]:
    """Make the six-view rig: square orthographic cameras of size x size pixels.

    name: "six", or "wonder3d" with the same azimuths and images 1.35 world units across.
    """
    half_widths = {"six": HALF_WIDTH, "wonder3d": 1.35 / 2}
    if name not in half_widths:
        raise ValueError(f"unknown rig {name!r}; known: {', '.join(half_widths)}")
    return [camera_at(azimuth, name=view, size=size, half_width=half_widths[name]) for view, azimuth in SIX_VIEWS]


def rays(camera: Camera, pixels: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Compute the rays through pixels: origins and unit directions in the world, float64.

    pixels (..., 2): (x, y) in pixel units; None for all pixel centres, shape (h, w). The results have the shape (...,
    3). Orthographic origins lie on the camera plane, so that the distance along an orthographic ray is the depth. Each
    component is contiguous in memory.
    """
    if pixels is None:
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    else:
        x, y = pixels[..., 0], pixels[..., 1]
    rotation = camera.world_from_camera[:3, :3]
    if camera.projection == "orthographic":
        step = camera.pixel_size
        right, up = (x - camera.width / 2) * step, (camera.height / 2 - y) * step
        origins = np.empty((3, *right.shape))
        for out, (a, b, _), start in zip(origins, rotation, camera.position, strict=True):
            np.multiply(right, a, out=out)
            out += up * b
            out += start
        directions = np.empty_like(origins)
        directions.T[...] = -camera.backward
    else:
        right, up = (x - camera.cx) / camera.fx, (camera.cy - y) / camera.fy
        directions = np.stack([a * right + b * up - c for a, b, c in rotation])
        directions /= np.sqrt((directions * directions).sum(0))
        origins = np.empty_like(directions)
        origins.T[...] = camera.position
    return np.moveaxis(origins, 0, -1), np.moveaxis(directions, 0, -1)


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points (n, 3) to pixel coordinates (n, 2) as (x, y).

    Also returns the depth (n,) along the viewing axis.
    """
    local = (points - camera.position) @ camera.world_from_camera[:3, :3]
    depth = -local[:, 2]
    if camera.projection == "orthographic":
        x = local[:, 0] / camera.pixel_size + camera.width / 2
        y = camera.height / 2 - local[:, 1] / camera.pixel_size
    else:
        safe = np.where(np.abs(depth) < 1e-12, 1e-12, depth)
        x = camera.cx + camera.fx * local[:, 0] / safe
        y = camera.cy - camera.fy * local[:, 1] / safe
    return np.stack([x, y], -1), depth


def backproject(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """Compute the world points (h, w, 3) behind the pixels of a depth image (h, w).

    Depth is measured along the viewing axis, in world units.
    """
    origins, directions = rays(camera)
    cosine = -(directions @ camera.backward)
    return origins + directions * (depth / cosine)[..., None]
