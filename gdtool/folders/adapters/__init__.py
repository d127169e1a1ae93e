"""Read other programs' pictures: each adapter turns a folder into cameras and images in gdtool's conventions.

An adapter is a module with `recognises(folder) -> bool` and `read(folder) -> Pictures`. ADAPTERS lists them in the
order in which they are asked. For another format, add a module and its name.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

from gdtool.cameras import Camera
from gdtool.core.errors import InputError

ADAPTERS = ("wonder3d", "nerf", "plain")
MIN_COVERAGE = 1 / 512  # of a pixel: half a step of 8-bit storage; what is below counts as background


@dataclass(frozen=True)
class Pictures:
    """Hold what an adapter read: images of one size, in any subset of the domains.

    images: domain to (k, h, w, 3) or (k, h, w) float32 as in folders.views.Views (linear colors, normals in world axes,
    depth along the axis). mask (k, h, w). up: the world axis that points up, "y" or "z".
    """

    cameras: list[Camera]
    images: dict[str, np.ndarray]
    mask: np.ndarray
    up: str = "y"


def adapter(folder: Path, name: str = "auto") -> ModuleType:
    """Return the adapter of a name, or the first one that recognises the folder. Raises InputError."""
    for module_name in ADAPTERS if name == "auto" else (name,):
        module = import_module(f"{__name__}.{module_name}")
        if module.recognises(folder):
            return module
    expected = (
        "a Wonder3D output, a transforms.json or a cameras.json with pictures"
        if name == "auto"
        else import_module(f"{__name__}.{name}").LOOKS_LIKE
    )
    raise InputError(folder, f"does not hold {expected}", "name the folder that holds it")


def linear_color(image: np.ndarray) -> np.ndarray:
    """Convert a picture as read_image returns it to linear color (h, w, 3), float32.

    Integers are sRGB, floats linear.
    """
    from gdtool.images.color import linear_from_srgb, unit_range

    image = np.repeat(image, 3, -1)[..., :3] if image.shape[-1] < 3 else image[..., :3]
    return (linear_from_srgb(unit_range(image)) if image.dtype.kind == "u" else np.clip(image, 0, 1)).astype(np.float32)


def stacked(parts: list[np.ndarray], paths: list[Path]) -> np.ndarray:
    """Stack images of one size. Raises InputError naming the first of another size."""
    for part, path in zip(parts, paths, strict=True):
        if part.shape != parts[0].shape:
            raise InputError(
                path,
                f"is {part.shape[1]}x{part.shape[0]}, {paths[0].name} {parts[0].shape[1]}x{parts[0].shape[0]}",
                "scale all views to one size",
            )
    return np.stack(parts)


def zero_faint_coverage(mask: np.ndarray) -> np.ndarray:
    """Set coverage (k, h, w) below half a step of 8-bit storage to 0."""
    return np.where(mask > MIN_COVERAGE, mask, 0).astype(np.float32)


def upright(up: str) -> np.ndarray:
    """Return the rotation (4, 4) that takes a world with the given axis up, "y" or "z", to one with y up."""
    out = np.eye(4)
    if up == "z":
        out[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    return out


def transform_images(images: dict[str, np.ndarray], matrix: np.ndarray) -> dict[str, np.ndarray]:
    """Apply a similarity (4, 4) of the world to the images by domain: it turns normals and scales depth."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    out = dict(images)
    if "normal" in out:
        out["normal"] = (out["normal"] @ (matrix[:3, :3] / scale).T).astype(np.float32)
    if "depth" in out:
        out["depth"] = (out["depth"] * scale).astype(np.float32)
    return out


def clear_background(images: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Set the images by domain (k, h, w[, 3]) to 0 where the mask (k, h, w) is 0."""
    inside = mask > 0
    return {
        name: np.where(inside[..., None] if stack.ndim == 4 else inside, stack, 0).astype(np.float32)
        for name, stack in images.items()
    }
