"""Turn what a user gives, one picture or several and views, into what a model samples from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gdtool.core.errors import UsageError
from gdtool.core.folder import Folder
from gdtool.diffusion.data.condition import PictureOptions, frame_subject, make_condition, read_subject
from gdtool.diffusion.data.framing import FRONT_EXTENT, framed_square
from gdtool.diffusion.data.objects import condition_plane
from gdtool.diffusion.data.volumes import unit_picture
from gdtool.diffusion.inference.given import GivenImages, frame_pictures, read_given_views
from gdtool.diffusion.inference.shape import predict_volume
from gdtool.diffusion.network.model import Model

# Sizes of the subject that are tried, as shares of the usual one, until the predicted object is no deeper than the
# rig's unit box.
FRAMINGS = (1.0, 0.85, 0.72, 0.6, 0.5, 0.42)
# Voxels at the front and at the back of the volume that lie outside of the unit box, and the share of the silhouette's
# area that may be occupied there.
OUTER_VOXELS, MAX_OUTER_SHARE = 2, 0.05


@dataclass(frozen=True)
class Conditions:
    """Hold what a model samples from.

    condition (h, h, 4): framed picture of the front, linear color and straight alpha; transparent where there is none.
    picture (f h, f h, 4): the same square at about the picture's own resolution, or None. given: other images.
    """

    condition: np.ndarray
    picture: np.ndarray | None
    given: GivenImages

    def front_silhouette(self) -> np.ndarray | None:
        """Return the coverage (h, h) of the picture of the front; None where there is none, or another one is given."""
        return None if self.picture is None or "front" in self.given.masks else self.condition[..., 3]


def make_conditions(
    model: Model,
    paths: dict[str, Path],
    given_views: Folder | None,
    options: PictureOptions,
    warn: Callable[[str], None],
) -> Conditions:
    """Read and frame pictures, given by the view that they show, and read given views.

    Raises UsageError where the model takes one picture of the front alone and there is more or something else.
    """
    config = model.config
    if set(paths) == {"front"} and given_views is None:
        if model.shape is not None and options.crop:
            return _framed_by_depth(model, paths["front"], options, warn)
        return Conditions(*make_condition(paths["front"], paths["front"].name, options, warn), GivenImages())
    if config.domain_layout != "channels":
        raise UsageError(
            "given images", "this model takes one picture of the front alone", "leave --model out, or the images"
        )
    unknown = [view for view in paths if view not in config.views]
    if unknown:
        raise UsageError(f"--{unknown[0]}", "is not a view of this model", f"give one of {', '.join(config.views)}")
    given = GivenImages() if given_views is None else read_given_views(given_views, config)
    return Conditions(*frame_pictures(paths, given, options, warn), given)


def _framed_by_depth(model: Model, path: Path, options: PictureOptions, warn: Callable[[str], None]) -> Conditions:
    """Frame a picture so that the object which the model sees in it is no deeper than a unit box.

    A picture does not tell how deep its subject is. Filling the frame leaves a long object, such as a car from the
    front, no room behind.
    """
    rgba = read_subject(path, path.name, options, warn)
    for share in FRAMINGS:
        condition, picture = frame_subject(rgba, framed_square(rgba, share * FRONT_EXTENT), options.size)
        unit = torch.from_numpy(unit_picture(condition_plane(condition)))
        if not _too_deep(predict_volume(model, unit)):
            break
    return Conditions(condition, picture, GivenImages())


def _too_deep(volume: torch.Tensor) -> bool:
    """Tell whether a volume (1, z, y, x) reaches out of the unit box at the front or at the back."""
    occupied = volume[0] > 0.5
    area = occupied.any(0).sum()
    outer = torch.cat([occupied[:OUTER_VOXELS], occupied[-OUTER_VOXELS:]]).any(0).sum()
    return bool(outer > MAX_OUTER_SHARE * area)
