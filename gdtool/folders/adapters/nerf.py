"""Read NeRF's transforms.json: perspective cameras with OpenGL axes in a world with Z up, each with a color picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gdtool.cameras import Camera
from gdtool.core.errors import InputError
from gdtool.core.memory import require_memory
from gdtool.core.names import quoted, uri_path
from gdtool.core.reading import read_json
from gdtool.core.references import is_readable
from gdtool.folders.adapters import Pictures, linear_color, stacked

LOOKS_LIKE = "a transforms.json"
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".exr")  # Blender's exporter leaves the suffix out
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# Bounds of sizes and focal lengths in pixels, far beyond any camera. The upper bound also holds for matrix entries.
_LEAST_PIXELS, _MOST_PIXELS = 1e-3, 1e9
_FILES = ("transforms.json", "transforms_train.json")


def recognises(folder: Path) -> bool:
    """Tell whether a folder has a transforms.json."""
    return any((folder / name).is_file() for name in _FILES)


def read(folder: Path) -> Pictures:
    """Read all frames. The mask is the picture's alpha, or its difference from a plain background."""
    from gdtool.images.io import read_image
    from gdtool.images.mask import foreground

    path = next(folder / name for name in _FILES if (folder / name).is_file())
    record = read_json(path)
    frames = record.get("frames") if isinstance(record, dict) else None
    if (
        not isinstance(frames, list)
        or not frames
        or not all(isinstance(f, dict) and isinstance(f.get("file_path"), str) for f in frames)
    ):
        raise InputError(
            path,
            "holds no list of frames with a file_path each",
            'write "frames": [{"file_path": …, "transform_matrix": …}, …]',
        )
    cameras: list[Camera] = []
    colors, masks, paths, held = [], [], [], 0
    for frame in frames:
        picture = _picture(path, frame["file_path"])
        image = read_image(picture)
        cameras.append(_camera(path, record | frame, f"{len(cameras):03d}", image.shape[1], image.shape[0]))
        colors.append(linear_color(image))
        masks.append(foreground(image, subject=picture))
        paths.append(picture)
        held += colors[-1].nbytes + masks[-1].nbytes
        require_memory(
            2 * held,
            path,
            f"{len(paths)} pictures up to {picture.name}",
            "scale the pictures down or list fewer frames",
        )
    return Pictures(cameras, {"color": stacked(colors, paths)}, np.stack(masks), up="z")


def _picture(path: Path, name: str) -> Path:
    """Return the path of the picture that a file_path names, within the folder. Raises InputError."""
    for suffix in _SUFFIXES:
        candidate = uri_path(path.parent, name + suffix, path, "file_path")
        if is_readable(candidate):
            return candidate
    raise InputError(path, f"file_path {quoted(name)} does not exist", "put the picture there or correct the file_path")


def _camera(path: Path, record: dict[str, Any], name: str, width: int, height: int) -> Camera:
    """Make the camera of a frame; intrinsics for another size than the picture's are scaled."""

    def value(key: str, default: float | None = None, least: float = -_MOST_PIXELS) -> float:
        found = record.get(key, default)
        if not isinstance(found, (int, float)) or isinstance(found, bool):
            raise InputError(path, f"frame {name}: {key} is missing or no number", f"write {key} as a number")
        if not least <= found <= _MOST_PIXELS:
            raise InputError(
                path,
                f"frame {name}: {key} is {found:g}, not within {least:g} to {_MOST_PIXELS:g}",
                f"write {key} within these bounds",
            )
        return float(found)

    for key in _DISTORTION:
        if abs(value(key, 0.0)) > 1e-6:
            raise InputError(path, f"frame {name}: the lens is distorted ({key})", "undistort the pictures first")
    across, down = value("w", width, _LEAST_PIXELS), value("h", height, _LEAST_PIXELS)
    angle = value("camera_angle_x", 0.0)
    fx = value("fl_x", float(across / 2 / np.tan(angle / 2)) if 0 < angle < np.pi else None, _LEAST_PIXELS)
    fy = value("fl_y", fx, _LEAST_PIXELS)
    pose = _matrix(record.get("transform_matrix"))
    if pose is None:
        raise InputError(
            path,
            f"frame {name}: transform_matrix is not 4x4 numbers up to {_MOST_PIXELS:g}",
            "write four rows of four numbers",
        )
    rigid = np.eye(4)
    u, size, vt = np.linalg.svd(pose[:3, :3])
    if size[-1] < 0.99 * size[0] or size[0] == 0 or np.linalg.det(u @ vt) < 0:
        raise InputError(
            path,
            f"frame {name}: transform_matrix is not a rotation and translation",
            "remove scale, shear and mirroring from it",
        )
    rigid[:3, :3], rigid[:3, 3] = u @ vt, pose[:3, 3]
    sx, sy = width / across, height / down
    return Camera(
        name,
        rigid,
        width,
        height,
        "perspective",
        0.0,
        fx * sx,
        fy * sy,
        value("cx", across / 2) * sx,
        value("cy", down / 2) * sy,
    )


def _matrix(rows: Any) -> np.ndarray | None:
    """Convert nested lists to a matrix (3 or 4, 4) float64.

    Returns None for another shape, and for values that are not finite or too large to be meant (above _MOST_PIXELS).
    """
    if (
        not isinstance(rows, list)
        or len(rows) not in (3, 4)
        or not all(isinstance(row, list) and len(row) == 4 for row in rows)
    ):
        return None
    numbers = [x for row in rows for x in row]
    if not all(isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= _MOST_PIXELS for x in numbers):
        return None
    return np.array(rows, np.float64)
