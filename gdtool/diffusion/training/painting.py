"""Draw what the painting network is given in training: guides from true or predicted shapes, and known images."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.data.objects import Batch
from gdtool.diffusion.data.volumes import silhouette_space, unit_picture
from gdtool.diffusion.inference.sampling import precision_context
from gdtool.diffusion.inference.shape import ShapeInput, network_input, predict_volumes
from gdtool.diffusion.network.encoding import PLANES, decode, encode
from gdtool.diffusion.network.known import KnownImages
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.shape.guides import Guides, project_picture
from gdtool.diffusion.shape.render import Rendered, render_volume

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


def draw_given(model: Model, batch: Batch, generators: list[torch.Generator], precision: str) -> Given:
    """Draw guides and known images for a batch; its k views are all of the configuration's.

    generators: one for each object. precision: of the shape network, "float32" or "bfloat16".
    """
    config = model.config
    assert batch.occupancy is not None
    mask = 0.5 + 0.5 * batch.planes[:, :, PLANES["mask"].start]
    indices = tuple(DOMAINS.index(d) for d in config.domains)
    images = encode(batch.planes, indices, torch.zeros(len(mask), device=mask.device))
    geometry = decode({d: images[:, indices.index(DOMAINS.index(d))] for d in ("depth", "normal")}, mask, 0.0)
    given = torch.zeros(images.shape[:3], device=mask.device)
    pictures, inputs, sources = [], [], torch.zeros(len(mask))
    for i, generator in enumerate(generators):
        dice = torch.rand(4, generator=generator).tolist()
        given[i] = draw_known(config, dice, generator)
        pictures.append(torch.from_numpy(unit_picture(batch.condition[i].cpu().numpy())))
        sources[i] = dice[0]
        if dice[0] < PREDICTED_SHARE:
            inputs.append(
                network_input(pictures[i], _known_space(batch.occupancy[i].cpu().numpy() > 0, given[i], config))
            )
    rgba = torch.stack(pictures).to(mask.device)
    volumes = batch.occupancy.float()
    if inputs:
        with precision_context(mask.device, precision):
            predicted = predict_volumes(model, ShapeInput(*(torch.cat(parts) for parts in zip(*inputs, strict=True))))
        volumes[sources < PREDICTED_SHARE] = predicted
    rendered = Rendered(mask.clone(), geometry["depth"].clone(), geometry["normal"].clone())
    from_volume = torch.nonzero(sources < PREDICTED_SHARE + VOXEL_SHARE).flatten()
    if len(from_volume):
        views = render_volume(volumes[from_volume], config.views, config.image_size)
        for whole, part in zip(rendered, views, strict=True):
            whole[from_volume] = part
    guides = project_picture(rgba, rendered, config.views)
    return Given(guides, KnownImages(images, given, mask), 1 - (guides.mask - mask).abs())


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
