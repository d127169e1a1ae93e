"""Read a plain folder: gdtool's own cameras.json, and pictures as <domain>/<view>.<suffix>.

The color pictures may also be <view>.<suffix>. Encodings are those of schemas/views.md, but any readable image format
is accepted. A view without a mask/<view> is masked by its color's alpha, else by its difference from a plain
background.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.kinds import DOMAINS
from gdtool.core.memory import require_memory
from gdtool.core.names import path_inside
from gdtool.core.references import is_readable
from gdtool.folders.adapters import Pictures, linear_color, stacked
from gdtool.folders.records import read_cameras

LOOKS_LIKE = "a cameras.json"
_SUFFIXES = (".png", ".exr", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")


def recognises(folder: Path) -> bool:
    """Tell whether a folder has a cameras.json."""
    return (folder / "cameras.json").is_file()


def read(folder: Path) -> Pictures:
    """Read every domain that all views have."""
    from gdtool.images.color import decode_normal, unit_range
    from gdtool.images.io import read_image
    from gdtool.images.mask import foreground

    cameras = read_cameras(folder / "cameras.json")
    images: dict[str, np.ndarray] = {}
    masks: list[np.ndarray] | None = None
    first = ""
    for domain in DOMAINS:
        paths = [path for camera in cameras if (path := _find(folder, domain, camera.name)) is not None]
        if len(paths) < len(cameras):
            continue
        stored = []
        for path, camera in zip(paths, cameras, strict=True):
            image = read_image(path)
            stored.append(image.reshape(*_size(path, camera, image), -1))
            passing = sum(x.nbytes for x in stored) * 4 // stored[0].itemsize * 2  # as float32, each alone and stacked
            held = sum(x.nbytes for x in images.values()) + passing
            require_memory(
                held, folder, f"pictures up to {domain}/{camera.name}", "scale the pictures down or list fewer cameras"
            )
        first = first or domain
        if domain == "color":
            masks = stored
            images[domain] = stacked([linear_color(image) for image in stored], paths)
        elif domain == "albedo":
            images[domain] = stacked([linear_color(image) for image in stored], paths)
        elif domain == "normal":
            images[domain] = decode_normal(
                stacked([unit_range(image[..., :3]).astype(np.float32) for image in stored], paths)
            )
        elif domain == "depth" and any(image.dtype.kind != "f" for image in stored):
            raise InputError(paths[0], "is not floating point: depth is in world units", "write it as .exr")
        else:
            images[domain] = stacked([unit_range(image[..., 0]).astype(np.float32) for image in stored], paths)
    if not images:
        raise InputError(
            folder,
            "has no domain with a picture of every view in cameras.json",
            f"add pictures, for example color/{cameras[0].name}.png",
        )
    mask = []
    for k, camera in enumerate(cameras):
        given = _find(folder, "mask", camera.name)
        if given is None and masks is None:
            raise InputError(
                folder / "mask",
                f"has no picture of {camera.name}, and there is no color to tell the subject by",
                f"add mask/{camera.name}.png",
            )
        if given is None:
            assert masks is not None
            mask.append(foreground(masks[k], subject=_find(folder, "color", camera.name)))
        else:
            image = read_image(given)
            _size(given, camera, image)
            mask.append(unit_range(image.reshape(camera.height, camera.width, -1)[..., 0]).astype(np.float32))
    return Pictures(cameras, images, np.stack(mask))


def _find(folder: Path, domain: str, view: str) -> Path | None:
    """Find the picture of a view in a domain; None where there is none."""
    prefixes = [f"{domain}/"] + ([""] if domain == "color" else [])
    for prefix in prefixes:
        for suffix in _SUFFIXES:
            path = path_inside(folder, f"{prefix}{view}{suffix}", folder / "cameras.json", "picture")
            if is_readable(path):
                return path
    return None


def _size(path: Path, camera, image: np.ndarray) -> tuple[int, int]:
    """Return the height and width of a picture in pixels. Raises InputError where its camera has another size."""
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            path,
            f"is {image.shape[1]}x{image.shape[0]}, its camera {camera.width}x{camera.height}",
            "scale the picture, or write its size into cameras.json",
        )
    return camera.height, camera.width
