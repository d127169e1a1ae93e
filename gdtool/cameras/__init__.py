"""Define cameras: orthographic and perspective projection, the six-view rig, and changes of the world around them."""

from gdtool.cameras.camera import Camera, backproject, camera_at, look_at, project, rays, rig
from gdtool.cameras.transform import fit_depth_range, same_view, transform_camera

__all__ = [
    "Camera",
    "backproject",
    "camera_at",
    "fit_depth_range",
    "look_at",
    "project",
    "rays",
    "rig",
    "same_view",
    "transform_camera",
]
