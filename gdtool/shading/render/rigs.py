"""Place cameras around the normalised object: turntables, spheres, and the random ones of condition images."""

from __future__ import annotations

import numpy as np

from gdtool.cameras import Camera, camera_at
from gdtool.cameras.camera import DISTANCE, HALF_WIDTH, SIX_VIEWS, rig


def camera(
    azimuth: float, elevation: float, name: str, size: int, fov: float = 0.0, half_width: float = HALF_WIDTH
) -> Camera:
    """Make a camera that sees the whole normalised object.

    azimuth, elevation: in degrees. size: pixels a side. fov: field of view in degrees across the image; 0 is
    orthographic. A perspective camera stands where a sphere of radius half_width, in world units, fills its view.
    """
    if not fov:
        return camera_at(azimuth, elevation, name=name, size=size, half_width=half_width)
    return camera_at(
        azimuth, elevation, name=name, size=size, fov_degrees=fov, distance=half_width / np.sin(np.radians(fov) / 2)
    )


def turntable(
    views: int, size: int, elevation: float = 0.0, fov: float = 0.0, stops: tuple[tuple[str, float], ...] = ()
) -> list[Camera]:
    """Place `views` cameras evenly around the object, from the front toward +X, or one at each of the stops.

    size: pixels a side. elevation, fov: in degrees; fov 0 is orthographic. stops: names and azimuths in degrees.
    """
    stops = stops or tuple((f"{k:03d}", 360.0 * k / views) for k in range(views))
    return [camera(azimuth, elevation, name, size, fov) for name, azimuth in stops]


def sphere(views: int, size: int, fov: float = 0.0) -> list[Camera]:
    """Spread `views` cameras evenly over the sphere around the object.

    size: pixels a side. fov: in degrees; 0 is orthographic.
    """
    from gdtool.shading.sampling import fibonacci

    out = []
    for k, (x, y, z) in enumerate(fibonacci(views)):
        out.append(camera(float(np.degrees(np.arctan2(x, z))), float(np.degrees(np.arcsin(y))), f"{k:03d}", size, fov))
    return out


def cameras_by_rig(name: str, views: int, size: int, elevation: float = 0.0, fov: float = 0.0) -> list[Camera]:
    """Place the cameras of a rig: "turntable" or "sphere" of so many views, else the six views of "six" or "wonder3d".

    elevation is that of a turntable, and of six perspective views.
    """
    if name == "turntable":
        return turntable(views, size, elevation, fov)
    if name == "sphere":
        return sphere(views, size, fov)
    if fov:
        return turntable(0, size, elevation, fov, SIX_VIEWS)
    return rig(name, size)


def condition_camera(rng: np.random.Generator, name: str, size: int) -> Camera:
    """Choose a random camera in front of the object, where a photographer might stand.

    The elevation is −15° to 30°. The camera is orthographic, or perspective with a field of view of 20° to 60°. The
    object has 60 to 100 % of its size in the rig's views. size: pixels a side.
    """
    elevation, perspective = rng.uniform(-15, 30), rng.random() < 0.5
    fov, scale = rng.uniform(20, 60), rng.uniform(0.6, 1.0)
    return camera(0.0, float(elevation), name, size, float(fov) if perspective else 0.0, HALF_WIDTH / float(scale))


__all__ = ["DISTANCE", "camera", "cameras_by_rig", "condition_camera", "sphere", "turntable"]
