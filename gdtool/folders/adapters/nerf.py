"""NeRF's transforms.json: perspective cameras with OpenGL axes in a world with Z up, and one color picture each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gdtool.cameras import Camera
from gdtool.core.errors import InputError
from gdtool.core.reading import read_json
from gdtool.folders.adapters import Pictures, linear_color, stacked

LOOKS_LIKE = "a transforms.json"
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".exr")  # Blender's exporter leaves the suffix out
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_FILES = ("transforms.json", "transforms_train.json")


def recognises(folder: Path) -> bool:
    return any((folder / name).is_file() for name in _FILES)


def read(folder: Path) -> Pictures:
    """All frames of the file. The mask is the picture's alpha, or its difference from a plain background."""
    from gdtool.images.io import read_image
    from gdtool.images.mask import foreground

    path = next(folder / name for name in _FILES if (folder / name).is_file())
    record = read_json(path)
    frames = record.get("frames") if isinstance(record, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) and isinstance(f.get("file_path"), str) for f in frames):
        raise InputError(path, "holds no list of frames with a file_path each")
    cameras, colors, masks, paths = [], [], [], []
    for frame in frames:
        picture = _picture(path, frame["file_path"])
        image = read_image(picture)
        cameras.append(_camera(path, record | frame, f"{len(cameras):03d}", image.shape[1], image.shape[0]))
        colors.append(linear_color(image))
        masks.append(foreground(image, subject=picture))
        paths.append(picture)
    return Pictures(cameras, {"color": stacked(colors, paths)}, np.stack(masks), up="z")


def _picture(path: Path, name: str) -> Path:
    for suffix in _SUFFIXES:
        if (path.parent / (name + suffix)).is_file():
            return path.parent / (name + suffix)
    raise InputError(path.parent / name, "does not exist", f"{path.name} names it")


def _camera(path: Path, record: dict[str, Any], name: str, width: int, height: int) -> Camera:
    """One frame's camera; intrinsics for another size than the picture's are scaled to it."""
    def value(key: str, default: float | None = None) -> float:
        found = record.get(key, default)
        if not isinstance(found, (int, float)) or not np.isfinite(found):
            raise InputError(path, f"frame {name}: {key} is missing or no number")
        return float(found)

    for key in _DISTORTION:
        if abs(value(key, 0.0)) > 1e-6:
            raise InputError(path, f"frame {name}: the lens is distorted ({key})", "undistort the pictures first")
    across, down = value("w", width), value("h", height)
    angle = value("camera_angle_x", 0.0)
    fx = value("fl_x", across / 2 / np.tan(angle / 2) if 0 < angle < np.pi else None)
    fy = value("fl_y", fx)
    try:
        pose = np.array(record.get("transform_matrix"), np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape not in ((3, 4), (4, 4)) or not np.isfinite(pose).all():
        raise InputError(path, f"frame {name}: transform_matrix is not 4x4 numbers")
    rigid = np.eye(4)
    u, size, vt = np.linalg.svd(pose[:3, :3])
    if size[-1] < 0.99 * size[0] or size[0] == 0 or np.linalg.det(u @ vt) < 0:
        raise InputError(path, f"frame {name}: transform_matrix is not a rotation and translation")
    rigid[:3, :3], rigid[:3, 3] = u @ vt, pose[:3, 3]
    sx, sy = width / across, height / down
    return Camera(name, rigid, width, height, "perspective", 0.0, fx * sx, fy * sy, value("cx", across / 2) * sx, value("cy", down / 2) * sy)
