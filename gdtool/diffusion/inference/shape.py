"""Predict the shape of the object that a picture shows, and make the guides that its views are painted with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from gdtool.diffusion.data.volumes import front_space, picture_channels, unit_picture
from gdtool.diffusion.network.encoding import decode
from gdtool.diffusion.network.known import KnownImages
from gdtool.diffusion.network.model import Model
from gdtool.diffusion.shape.guides import Guides, project_picture
from gdtool.diffusion.shape.render import Rendered, render_volume
from gdtool.diffusion.shape.volume import carve, crop, volume_side

# Occupancy that is given to the likeliest voxel behind a pixel of the picture's silhouette where no voxel is occupied:
# the front silhouette is known, so something lies there.
LEAST_BEHIND = 0.75
PRIOR_STEPS = 8  # denoising steps of a code: more do not change the spread of the shapes


class ShapeInput(NamedTuple):
    """Hold what the shape network is given of b objects.

    channels (b, 5, r, r): the cropped pictures, as volumes.picture_channels() makes them. room (b, r, r, r): 1 where a
    voxel may be occupied, else 0. pictured (b,): whether there is a picture from the front.
    """

    channels: torch.Tensor
    room: torch.Tensor
    pictured: torch.Tensor


def network_input(rgba: torch.Tensor, space: np.ndarray | None = None) -> ShapeInput:
    """Prepare one framed picture for the shape network.

    rgba (4, h, h): sRGB color times coverage, and coverage, in [0, 1]; coverage 0 everywhere says that there is no
    picture from the front. space (r, r, r) bool: voxels that may be occupied, besides what the picture's silhouette
    says; None: all.
    """
    picture = crop(rgba).numpy()
    allowed = np.ones((picture.shape[-1],) * 3, bool) if space is None else space.copy()
    pictured = bool((picture[3] > 0.5).any())
    if pictured:
        allowed &= front_space(picture[3])
    return ShapeInput(
        torch.from_numpy(picture_channels(picture))[None],
        torch.from_numpy(allowed)[None].float(),
        torch.tensor([pictured]),
    )


@torch.no_grad()
def predict_volumes(model: Model, given: ShapeInput, *, seed: int | None = None) -> torch.Tensor:
    """Predict the occupancy (b, r, r, r) of objects, in [0, 1], indexed (z, y, x).

    seed: of the code, which chooses one of the possible shapes; None takes the network's best guess. The silhouette
    from the front is exactly the picture's.
    """
    network, config = model.shape, model.config.shape
    assert network is not None
    assert config is not None
    device, count = next(network.parameters()).device, len(given.room)
    channels, room, pictured = (x.to(device) for x in given)
    features = network.summarise(channels, room)
    code, known = torch.zeros(count, config.code, device=device), torch.zeros(count, device=device)
    if seed is not None:
        noise = torch.randn(1, config.code, generator=torch.Generator().manual_seed(seed)).expand(count, -1)
        code = network.prior.sample(features[-1].float().mean((2, 3)), noise.to(device), PRIOR_STEPS)
        known = known + 1
    logits = network.expand(features, code, known).float()
    occupancy = torch.sigmoid(logits) * room
    likeliest = torch.where(room > 0, logits, -torch.inf).argmax(1, keepdim=True)
    least = LEAST_BEHIND * room.amax(1, keepdim=True) * pictured[:, None, None, None]
    return occupancy.scatter(1, likeliest, torch.maximum(occupancy.gather(1, likeliest), least))


def predict_volume(
    model: Model, rgba: torch.Tensor, space: np.ndarray | None = None, *, seed: int | None = None
) -> torch.Tensor:
    """Predict the occupancy (1, r, r, r) of the object in one picture; see network_input() and predict_volumes()."""
    return predict_volumes(model, network_input(rgba, space), seed=seed)


def known_space(known: KnownImages, i: int, model: Model) -> np.ndarray:
    """Return the voxels (r, r, r), bool, that the known views of object i leave space for.

    A view with any known image has a known silhouette; one with known depth also says what lies before its surface.
    """
    config = model.config
    side = volume_side(config.image_size)
    space = np.ones((side, side, side), bool)
    depth_row = config.domains.index("depth") if "depth" in config.domains else None
    for k, name in enumerate(config.views):
        if not bool(known.given[i, :, k].any()):
            continue
        mask = known.mask[i, k : k + 1].cpu()
        depth = None
        if depth_row is not None and bool(known.given[i, depth_row, k]):
            depth = decode({"depth": known.images[i, depth_row, k : k + 1].cpu()}, mask, 0.0)["depth"].numpy()
        space &= carve(mask.numpy(), depth, (name,))
    return space


@torch.no_grad()
def make_guides(
    model: Model,
    rgba: torch.Tensor,
    known: KnownImages | None = None,
    *,
    seed: int | None = None,
    mirror: bool = False,
) -> Guides:
    """Make the guides of b objects from their framed pictures and from what is known of their views.

    Where normal and depth of all views are known the shape is, and the network is not asked. Otherwise it predicts a
    volume within what the known silhouettes and depths leave. rgba (b, 4, h, h): condition in [-1, 1], as
    objects.condition_plane() encodes it. seed: as in predict_volume(). mirror: average the volumes that are predicted
    for a picture and for its mirror image; for the best guess only.
    """
    config, device = model.config, rgba.device
    guides = []
    for i in range(len(rgba)):
        unit = torch.from_numpy(unit_picture(rgba[i].cpu().numpy()))
        if known is not None and shape_is_known(known, i, config.domains):
            mask = known.mask[i]
            rows = {d: config.domains.index(d) for d in ("depth", "normal")}
            values = decode({d: known.images[i, row] for d, row in rows.items()}, mask, 0.0)
            views = Rendered(mask[None], values["depth"][None], values["normal"][None])
        else:
            space = None if known is None else known_space(known, i, model)
            volume = predict_volume(model, unit, space, seed=seed)
            if mirror and seed is None:
                flipped = None if space is None else space[..., ::-1].copy()
                volume = (volume + predict_volume(model, unit.flip(-1), flipped).flip(-1)) / 2
            views = render_volume(volume, config.views, config.image_size)
        guides.append(project_picture(unit[None].to(device), views, config.views))
    return Guides(*(torch.cat(parts) for parts in zip(*guides, strict=True)))


def shape_is_known(known: KnownImages, i: int, domains: tuple[str, ...]) -> bool:
    """Tell whether normal and depth of all views of object i are known. domains: along d."""
    return all(d in domains and bool(known.given[i, domains.index(d)].all()) for d in ("normal", "depth"))


def no_images(model: Model, count: int) -> KnownImages:
    """Make the KnownImages of `count` objects of which nothing is known, to be filled."""
    config = model.config
    d, k, h = len(config.domains), len(config.views), config.image_size
    return KnownImages(torch.zeros(count, d, k, 3, h, h), torch.zeros(count, d, k), torch.zeros(count, k, h, h))
