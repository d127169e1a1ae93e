"""Load an environment light from a bundled name or an image file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.memory import require_memory
from gdtool.images.io import read_image
from gdtool.shading.lights.bundled import BUNDLED, bundled
from gdtool.shading.lights.environment import Environment

# Bytes of memory per pixel while a light is metered, fitted and sampled: 48 measured by tracemalloc, and 32 for the
# tensors of direct.py.
HELD_PER_PIXEL = 80


def load_environment(source: str | Path) -> Environment:
    """Load a bundled light by its name (dark, mid, bright), or a lat-long .hdr or .exr image.

    Alpha is ignored. Negative radiance, which some tools write, counts as 0. Raises InputError for a file that is no
    such image, and ResourceError for one that does not fit into memory.
    """
    if str(source) in BUNDLED:
        return bundled(str(source))
    path = Path(source)
    if not path.exists():
        raise InputError(
            path,
            "is neither an environment image nor one of the bundled lights",
            f"use {', '.join(BUNDLED)} or an .hdr or .exr file",
        )
    image = read_image(path)
    if image.dtype.kind == "u":
        raise InputError(path, "is not a high dynamic range image", "use .hdr or .exr")
    image = image.reshape(image.shape[0], image.shape[1], -1)
    image = np.repeat(image[..., :1], 3, -1) if image.shape[2] < 3 else image[..., :3]
    if abs(image.shape[1] / image.shape[0] - 2) > 0.1:
        raise InputError(
            path,
            f"is {image.shape[1]}x{image.shape[0]}, but a lat-long environment is twice as wide as high",
            "save it as an equirectangular (lat-long) image",
        )
    require_memory(
        image.shape[0] * image.shape[1] * HELD_PER_PIXEL,
        path,
        f"light of {image.shape[1]}x{image.shape[0]} pixels",
        "scale it down",
    )
    image = np.maximum(image, 0).astype(np.float32, copy=False)
    if not image.any():
        raise InputError(path, "is black everywhere", f"use an image with light, or {', '.join(BUNDLED)}")
    return Environment(image, path.name)
