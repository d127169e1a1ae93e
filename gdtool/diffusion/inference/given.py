"""Take images that are given besides the picture: pictures of other sides, and views whose domains are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from gdtool.cameras import rig, same_view
from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.data.condition import PictureOptions, frame_subject, read_subject
from gdtool.diffusion.data.framing import Square, framed_square, framed_together, square_onto
from gdtool.diffusion.network.encoding import encode, planes_from_images
from gdtool.diffusion.network.known import KnownImages
from gdtool.folders.views import Views, read_views
from gdtool.images.metrics import resized_views


@dataclass
class GivenImages:
    """Hold given images at the model's size, h pixels.

    images: by domain and view, (h, h[, 3]), as Views holds them. masks: by view, (h, h), coverage from 0 to 1.
    source_from_world: (4, 4), of a given views folder; None without one.
    """

    images: dict[tuple[str, str], np.ndarray] = field(default_factory=dict)
    masks: dict[str, np.ndarray] = field(default_factory=dict)
    source_from_world: np.ndarray | None = None

    def add_picture(self, view: str, rgba: np.ndarray) -> None:
        """Add a framed picture (h, h, 4), linear color and straight alpha, as the color of a view."""
        self.masks.setdefault(view, rgba[..., 3])
        self.images["color", view] = np.where(rgba[..., 3:] > 0, rgba[..., :3], 0).astype(np.float32)

    def known(self, config: ModelConfig) -> KnownImages | None:
        """Encode the images for a model; None where nothing is given."""
        if not self.images:
            return None
        size, count = config.image_size, len(config.views)
        mask = np.stack([self.masks.get(view, np.zeros((size, size))) for view in config.views]).astype(np.float32)
        given = torch.zeros(1, len(config.domains), count)
        stacks = {}
        for row, domain in enumerate(config.domains):
            shape = (count, size, size, 3) if domain in ("color", "albedo", "normal") else (count, size, size)
            stacks[domain] = np.zeros(shape, np.float32)
            for k, view in enumerate(config.views):
                if (domain, view) in self.images:
                    stacks[domain][k], given[0, row, k] = self.images[domain, view], 1
        planes = torch.from_numpy(planes_from_images(stacks, mask))[None]
        images = encode(planes, tuple(DOMAINS.index(d) for d in config.domains), torch.zeros(1))
        return KnownImages(images, given, torch.from_numpy(mask)[None])

    def put_into(self, views: Views) -> None:
        """Replace the images of sampled views by the given ones, and their masks by those of the given views."""
        for k, view in enumerate(views.names):
            if view in self.masks:
                views.mask[k] = self.masks[view]
            for domain, stack in views.images.items():
                if (domain, view) in self.images:
                    stack[k] = self.images[domain, view]


def read_given_views(folder: Folder, config: ModelConfig) -> GivenImages:
    """Read the images of a views folder that a model can be given: those of its own views, in its own domains.

    Raises InputError for a folder without such a view, or whose cameras are not the rig's.
    """
    views = read_views(folder, config.domains)
    cameras = {camera.name: camera for camera in rig("six", config.image_size)}
    shared = [k for k, name in enumerate(views.names) if name in config.views]
    if not shared or not views.images:
        raise InputError(
            folder.path,
            f"has none of the model's views {', '.join(config.views)}, or no image of them",
            "render it with the default rig",
        )
    for k in shared:
        if not same_view(views.cameras[k], cameras[views.names[k]]):
            raise InputError(
                folder.path,
                f"view {views.names[k]} has another camera than the rig's",
                "render it with gdtool render-dataset, with the default rig",
            )
    images, mask = resized_views(views.images, views.mask, config.image_size, config.image_size)
    given = GivenImages(source_from_world=np.array(folder.content.source_from_world).reshape(4, 4))
    for k in shared:
        given.masks[views.names[k]] = mask[k]
        for domain, stack in images.items():
            given.images[domain, views.names[k]] = stack[k]
    return given


def frame_pictures(
    paths: dict[str, Path],
    given: GivenImages,
    options: PictureOptions,
    warn: Callable[[str], None],
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read pictures by view, frame them so that they agree, and add those of all views but the front to `given`.

    A view with a given silhouette is framed onto it. Otherwise all subjects get the same height, which orthographic
    views of an object from around it share, and none is wider than a unit box. options.mask belongs to the first
    picture.

    Returns the condition (h, h, 4) and the finer picture (f h, f h, 4), of the front view; where no picture shows the
    front, transparency and None.
    """
    subjects, size = {}, options.size
    for number, (view, path) in enumerate(paths.items()):
        own = options if number == 0 else options.without_mask()
        subjects[view] = read_subject(path, path.name, own, warn)
    placed = {view: square_onto(subjects[view], given.masks[view]) for view in subjects if view in given.masks}
    squares: dict[str, Square] = placed or framed_together(subjects)
    condition, finer = np.zeros((size, size, 4), np.float32), None
    for view, rgba in subjects.items():
        framed, own_size = frame_subject(rgba, squares.get(view) or framed_square(rgba), size)
        if view == "front":
            condition, finer = framed, own_size
        else:
            given.add_picture(view, framed)
    return condition, finer
