"""Cameras: the six-view rig, orthographic and perspective projection."""

from gdtool.cameras.camera import Camera, backproject, camera_at, look_at, project, rays, rig

__all__ = ["Camera", "backproject", "camera_at", "look_at", "project", "rays", "rig"]
