"""Read Wonder3D's output of one object: normals_000_<view>.png and rgb_000_<view>.png of six views.

Its cameras are orthographic, 1.35 world units across. Normals of all views are in the front camera's OpenGL axes,
stored as 0.5 n + 0.5, with the mask in their alpha. Its world has Z up and the front camera at (0, -r, 0). The front
camera's axes are gdtool's world axes, so normals are not turned: its world (x, y, z) is (x, z, -y) here, never (x, z,
y), which mirrors. Source: instant-nsr-pl/datasets/ortho.py of Wonder3D (Long et al. 2023).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.cameras import rig
from gdtool.core.errors import InputError
from gdtool.folders.adapters import Pictures, linear_color, stacked

LOOKS_LIKE = "normals_000_front.png and the like"


def recognises(folder: Path) -> bool:
    """Tell whether a folder has the files of Wonder3D."""
    return (folder / "normals_000_front.png").is_file()


def read(folder: Path) -> Pictures:
    """Read the six views, with colors where every view has one."""
    from gdtool.images.color import decode_normal, unit_range
    from gdtool.images.io import read_image

    names = [camera.name for camera in rig("wonder3d", 8)]
    paths = [folder / f"normals_000_{name}.png" for name in names]
    stored = stacked([read_image(path) for path in paths], paths)
    if stored.shape[-1] != 4:
        raise InputError(paths[0], "has no alpha, where Wonder3D puts the mask", "run its background removal first")
    mask = unit_range(stored[..., 3]).astype(np.float32)
    images = {
        "normal": np.where(
            mask[..., None] > 0, decode_normal(unit_range(stored[..., :3]).astype(np.float32)), 0
        ).astype(np.float32)
    }
    places = [(folder / "masked_colors" / f"rgb_000_{n}.png", folder / f"rgb_000_{n}.png") for n in names]
    colors = [next(path for path in two if path.is_file()) for two in places if any(path.is_file() for path in two)]
    if len(colors) == len(names):
        images["color"] = stacked([linear_color(read_image(path)) for path in colors], colors)
        if images["color"].shape[:3] != mask.shape:
            raise InputError(colors[0], "has another size than its normals", "scale colors and normals to one size")
    if mask.shape[1] != mask.shape[2]:
        raise InputError(paths[0], "is not square, as Wonder3D's views are", "crop the views to squares")
    return Pictures(rig("wonder3d", mask.shape[1]), images, mask)
