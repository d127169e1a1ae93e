"""Draw what the painting network is given in training: guides from true or predicted shapes, and known images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.data.objects import Batch
from gdtool.diffusion.data.volumes import silhouette_space, unit_picture
from gdtool.diffusion.inference.shape import predict_volume
from gdtool.diffusion.network.encoding import PLANES, decode, encode
from gdtool.diffusion.network.known import KnownImages
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.shape.guides import Guides, project_picture
from gdtool.diffusion.shape.render import render_volume

# Shares of objects by where their guides come from. The rest has exact geometry, with normals and depth known, as when
# a mesh is given to be textured.
PREDICTED_SHARE = 0.5  # the shape network's volume: what sampling from a picture sees
VOXEL_SHARE = 0.2  # the true volume, whose renderings have the voxels' errors alone
# Shares of objects by which color views are known: all six, or a random few; in the others no color is known.
ALL_COLORS_SHARE, FEW_COLORS_SHARE = 0.1, 0.3
MATERIAL_SHARE = 0.15  # of objects of which single images of albedo, roughness or metallic are known, each by a half


class Given(NamedTuple):
    """Hold what the painting network is given for b objects, and where its result counts.

    trust (b, k, h, h): 1 where guides and truth agree on whether a pixel shows the object, 0 where they do not.
    """

    guides: Guides
    known: KnownImages
    trust: torch.Tensor


def draw_given(model: Model, batch: Batch, generators: list[torch.Generator]) -> Given:
    """Draw guides and known images for a batch; its k views are all of the configuration's.

    generators: one for each object.
    """
    config = model.config
    assert batch.occupancy is not None
    mask = 0.5 + 0.5 * batch.planes[:, :, PLANES["mask"].start]
    indices = tuple(DOMAINS.index(d) for d in config.domains)
    images = encode(batch.planes, indices, torch.zeros(len(mask), device=mask.device))
    geometry = decode({d: images[:, indices.index(DOMAINS.index(d))] for d in ("depth", "normal")}, mask, 0.0)
    pieces, given = [], torch.zeros(images.shape[:3], device=mask.device)
    for i, generator in enumerate(generators):
        dice = torch.rand(4, generator=generator).tolist()
        given[i] = draw_known(config, dice, generator)
        rgba = torch.from_numpy(unit_picture(batch.condition[i].cpu().numpy())).to(mask.device)
        if dice[0] < PREDICTED_SHARE + VOXEL_SHARE:
            volume = batch.occupancy[i : i + 1].float()
            if dice[0] < PREDICTED_SHARE:
                space = _known_space(batch.occupancy[i].cpu().numpy() > 0, given[i], config)
                volume = predict_volume(model, rgba.cpu(), space, device=mask.device)
            pieces.append((rgba, *(x[0] for x in render_volume(volume, config.views, config.image_size))))
        else:
            pieces.append((rgba, mask[i], geometry["depth"][i], geometry["normal"][i]))
    rgba, guide_mask, depth, normal = (torch.stack(column) for column in zip(*pieces, strict=True))
    guides = project_picture(rgba, guide_mask, depth, normal, config.views)
    return Given(guides, KnownImages(images, given, mask), 1 - (guide_mask - mask).abs())


def draw_known(config: ModelConfig, dice: list[float], generator: torch.Generator) -> torch.Tensor:
    """Choose which images (d, k) of an object are known, 0 or 1.

    dice: four numbers from 0 to 1, for the source of the guides, the color views, and the materials; the last is spare.
    """
    shape = (len(config.domains), len(config.views))
    given = torch.zeros(shape)
    chances = torch.rand(shape, generator=generator)
    count = int(torch.randint(1, len(config.views), (), generator=generator))
    for j, domain in enumerate(config.domains):
        if domain in ("normal", "depth"):
            given[j] = float(dice[0] >= PREDICTED_SHARE + VOXEL_SHARE)
        elif domain == "color":
            if dice[1] < ALL_COLORS_SHARE:
                given[j] = 1.0
            elif dice[1] < ALL_COLORS_SHARE + FEW_COLORS_SHARE:
                given[j, chances[j].argsort()[:count]] = 1.0
        elif dice[2] < MATERIAL_SHARE:
            given[j] = (chances[j] < 0.5).float()
    return given


def _known_space(occupancy: np.ndarray, given: torch.Tensor, config: ModelConfig) -> np.ndarray:
    """Return the voxels (r, r, r), bool, that the silhouettes of the views with known images leave space for."""
    space = np.ones_like(occupancy)
    for k, name in enumerate(config.views):
        if name != "front" and bool(given[:, k].any()):
            space &= silhouette_space(occupancy, name, config.image_size)
    return space
