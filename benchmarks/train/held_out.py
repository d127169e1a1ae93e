"""Read the views folders that a model is measured on, and sample a model on their pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

import gdtool.models
from gdtool.cameras import rig
from gdtool.core.folder import Folder, open_folder
from gdtool.diffusion.inference.result import views_from_images
from gdtool.diffusion.inference.sampling import SamplingOptions, sample_images
from gdtool.diffusion.network.encoding import BACKGROUND
from gdtool.folders.views import Views, read_views
from gdtool.images.metrics import resized_views

DEFAULT_MODEL = Path(gdtool.models.__file__).parent / "default"


def views_folders(paths: list[Path]) -> list[Folder]:
    """Open the views folders among paths and in the datasets among them."""
    found = []
    for path in paths:
        folder = open_folder(path, ("dataset", "views"), "benchmark", check=False)
        if folder.kind == "dataset":
            found += [open_folder(folder.file(one.path), ("views",), check=False) for one in folder.content.objects]
        else:
            found.append(folder)
    return found


def object_name(folder: Folder) -> str:
    """Return the object's name of NAME.asset/views, else that of the folder."""
    parent = folder.path.parent.name
    return parent.removesuffix(".asset") if parent.endswith(".asset") else folder.path.name


def true_views(folder: Folder, size: int) -> Views:
    """Read the views of a folder at another size, with the cameras of that size."""
    truth, cameras = read_views(folder), {camera.name: camera for camera in rig("six", size)}
    return Views([cameras[name] for name in truth.names], *resized_views(truth.images, truth.mask, size, size))


def sampled_views(model, rgba: torch.Tensor, seed: int, **setting) -> Views:
    """Sample the views that a model makes of one condition (1, 4, h, w). setting: of SamplingOptions."""
    config = model.config
    cameras = {camera.name: camera for camera in rig("six", config.image_size)}
    images = sample_images(model, rgba, SamplingOptions(seed=seed, **setting))
    return views_from_images(
        {d: x[0].float() for d, x in images.items()},
        [cameras[n] for n in config.views],
        BACKGROUND[config.backgrounds[0]],
        setting.get("domains", config.domains),
        (0.5 + 0.5 * rgba[0, 3]).numpy(),
    )[0]


def nearest_to(condition: torch.Tensor, pictures: list[np.ndarray]) -> int:
    """Find which of the pictures (4, h, w) has the least squared error to a condition of the same shape."""
    return int(np.argmin([float(np.square(p.astype(np.float32) - condition.numpy()).mean()) for p in pictures]))
