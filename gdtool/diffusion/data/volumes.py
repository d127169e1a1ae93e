"""Draw training batches for the shape network: volumes, their pictures, and what is known of the space around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from gdtool.diffusion.config import ModelConfig, TrainConfig
from gdtool.diffusion.data.disturb import disturb_picture
from gdtool.diffusion.data.framing import FRONT_EXTENT
from gdtool.diffusion.data.objects import Objects, from_bytes
from gdtool.diffusion.network.encoding import PLANES
from gdtool.diffusion.shape.volume import carve, view_columns, volume_side

FILLED_SHARE = 0.5  # of pictures that are scaled to fill the frame, as a user's picture is; others keep their size
MAX_ZOOM = 2.5  # of that scaling: an object longer than that in depth is a line from the front
STRETCH_SHARE, STRETCH = 0.5, 0.1  # share of objects, and standard deviation of the logarithm of width over height
GIVEN_SHARE = 0.4  # of objects of which the silhouettes of other views are known
GIVEN_COUNTS = (0.4, 0.3, 0.15, 0.1, 0.05)  # shares of objects with one to five known silhouettes besides the front's
FRONT_DEPTH_SHARE = 0.05  # of objects whose front view's depth is known
NO_PICTURE_SHARE = 0.1  # of objects with known silhouettes that have no picture from the front
CODE_SHARE = 0.5  # of objects whose code is told


@dataclass(frozen=True)
class ShapeBatch:
    """Hold the inputs and the truth of a training step of the shape network, for b objects, float32.

    picture (b, 5, r, r): see picture_channels(). space (b, r, r, r): 0 where a voxel is known to be empty, else 1.
    occupancy (b, r, r, r): the true volume, 0 or 1. known (b,): 1 where the code is told.
    """

    picture: torch.Tensor
    space: torch.Tensor
    occupancy: torch.Tensor
    known: torch.Tensor

    def to(self, device: str) -> ShapeBatch:
        """Move all tensors to a device."""
        return ShapeBatch(*(x.to(device) for x in (self.picture, self.space, self.occupancy, self.known)))


def pack_volume(planes: np.ndarray, views: tuple[str, ...]) -> np.ndarray:
    """Carve an object's volume from its planes (k, 13, h, h); returns its bits, uint8 (r³ / 8 rounded up)."""
    from gdtool.diffusion.network.encoding import decode

    mask = 0.5 + 0.5 * planes[:, PLANES["mask"].start]
    value = torch.from_numpy(np.ascontiguousarray(planes[:, PLANES["depth"]])).expand(-1, 3, -1, -1)
    depth = decode({"depth": value}, torch.from_numpy(mask), 0.0)["depth"].numpy()
    return np.packbits(carve(mask, depth, views))


def unpack_volume(bits: np.ndarray, image_size: int) -> np.ndarray:
    """Unpack the bits of pack_volume() to bool (z, y, x)."""
    side = volume_side(image_size)
    return np.unpackbits(bits, count=side**3).reshape(side, side, side).astype(bool)


def unit_picture(condition: np.ndarray) -> np.ndarray:
    """Convert a condition (4, h, w) in [-1, 1] to sRGB color times coverage, and coverage, in [0, 1]."""
    rgba = 0.5 + 0.5 * condition
    rgba[:3] -= 0.5 * (1 - rgba[3])  # the condition's color is (2c - 1) m for color c and coverage m
    return rgba


def condition_from_unit(rgba: np.ndarray) -> np.ndarray:
    """Undo unit_picture()."""
    return np.concatenate([2 * rgba[:3] - rgba[3], 2 * rgba[3:] - 1]).astype(np.float32)


def picture_channels(rgba: np.ndarray) -> np.ndarray:
    """Encode a cropped picture (4, r, r) as the shape network's input (5, r, r), float32.

    rgba: sRGB color times coverage, and coverage, in [0, 1]. The channels are the color over grey, 2c - m for coverage
    m, in [-1, 1]; coverage in [-1, 1]; and the distance to the outline in half sides of the crop, 0 outside.
    """
    from scipy.ndimage import distance_transform_edt

    coverage = rgba[3]
    distance = distance_transform_edt(coverage > 0.5) / (rgba.shape[-1] / 2)
    return np.concatenate([2 * rgba[:3] - coverage, 2 * coverage[None] - 1, distance[None]]).astype(np.float32)


def front_space(coverage: np.ndarray) -> np.ndarray:
    """Return the voxels (r, r, r), bool, that a cropped front silhouette (r, r) leaves space for."""
    return np.repeat((coverage > 0.5)[None], coverage.shape[-1], 0)


def silhouette_space(occupancy: np.ndarray, name: str, image_size: int) -> np.ndarray:
    """Return the voxels (z, y, x), bool, that the silhouette of a volume (z, y, x) in a view leaves space for."""
    column, _ = view_columns(name, image_size)
    side = len(occupancy)
    covered = np.zeros((side, image_size), bool)
    rows = np.broadcast_to(np.arange(side)[None, :, None], occupancy.shape)
    columns = np.broadcast_to(column[:, None], occupancy.shape)
    covered[rows[occupancy], columns[occupancy]] = True
    # A column of pixels between two that voxels fall into is covered as well.
    covered[:, 1:-1] |= covered[:, :-2] & covered[:, 2:]
    return covered[:, column].transpose(1, 0, 2)


def draw_shape_batch(
    objects: Objects,
    idx: np.ndarray,
    config: ModelConfig,
    train: TrainConfig,
    generators: Sequence[np.random.Generator],
) -> ShapeBatch:
    """Make a batch of the objects idx (b,), each disturbed by its own generator.

    Raises ValueError for objects that were decoded without volumes.
    """
    if objects.volumes is None:
        raise ValueError("the objects have no volumes")
    drawn = [
        _draw_object(objects, int(i), config, train, generator) for i, generator in zip(idx, generators, strict=True)
    ]
    stacked = [
        torch.from_numpy(np.stack([np.asarray(part, np.float32) for part in parts]))
        for parts in zip(*drawn, strict=True)
    ]
    return ShapeBatch(*stacked)


def _draw_object(objects: Objects, i: int, config: ModelConfig, train: TrainConfig, rng: np.random.Generator):
    """Draw one object: its picture's channels, the space around it, its volume, and whether its code is told."""
    assert objects.volumes is not None
    occupancy = unpack_volume(objects.volumes[i], config.image_size)
    tilted = rng.random() < train.tilted and objects.conditions.shape[1] > 1
    pick = int(rng.integers(1, objects.conditions.shape[1])) if tilted else 0
    rgba = unit_picture(from_bytes(objects.conditions[i, pick]).numpy())
    rgba, occupancy = _rescale(rgba, occupancy, rng)
    if train.mirror and rng.random() < 0.5:
        rgba, occupancy = rgba[..., ::-1], occupancy[..., ::-1]
    if train.hue and rng.random() < 0.5:
        rgba = rgba[[*rng.permutation(3), 3]]
    rgba = disturb_picture(np.ascontiguousarray(rgba), rng)
    space = np.ones_like(occupancy)
    has_picture = True
    if rng.random() < GIVEN_SHARE:
        count = 1 + int(rng.choice(len(GIVEN_COUNTS), p=GIVEN_COUNTS))
        others = [name for name in config.views if name != "front"]
        for k in rng.permutation(len(others))[:count]:
            space &= silhouette_space(occupancy, others[k], config.image_size)
        has_picture = rng.random() > NO_PICTURE_SHARE
    if rng.random() < FRONT_DEPTH_SHARE:
        space &= np.maximum.accumulate(occupancy[::-1], 0)[::-1]
    if has_picture:
        space &= front_space(rgba[3])
    else:
        rgba = np.zeros_like(rgba)
    return picture_channels(rgba), space, occupancy & space, rng.random() < CODE_SHARE


def _rescale(rgba: np.ndarray, occupancy: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Scale and stretch a picture (4, h, h) and its volume (r, r, r) alike; returns the picture's crop (4, r, r) too.

    The object's longest side in the picture stays within a unit box. An object that is longer in depth than the volume
    is cut off there, which tells that the picture has to be framed smaller.
    """
    size, side = rgba.shape[-1], len(occupancy)
    rows, columns = np.nonzero(rgba[3] > 0.5)
    stretch = np.exp(rng.normal(0, STRETCH)) if rng.random() < STRETCH_SHARE else 1.0
    filled = rng.random() < FILLED_SHARE
    if not len(rows):
        return rgba[:, (size - side) // 2 : (size + side) // 2, (size - side) // 2 : (size + side) // 2], occupancy
    height, width = float(np.ptp(rows) + 1), float(np.ptp(columns) + 1)
    longest = FRONT_EXTENT * size if filled else max(height, width)
    zoom = longest / max(width * stretch**0.5, height / stretch**0.5)
    zoom_x, zoom_y = (min(zoom * s, MAX_ZOOM) for s in (stretch**0.5, stretch**-0.5))
    if filled or stretch != 1.0:
        zooms = ((zoom_x * zoom_y) ** 0.5, zoom_y, zoom_x)
        inside_z, inside_y, inside_x = (_inside(side, zoom) for zoom in zooms)
        occupancy = occupancy[np.ix_(*(_source_voxels(side, zoom) for zoom in zooms))]
        occupancy = occupancy & inside_z[:, None, None] & inside_y[:, None] & inside_x
    theta = torch.tensor([[[side / size / zoom_x, 0, 0], [0, side / size / zoom_y, 0]]], dtype=torch.float32)
    grid = F.affine_grid(theta, [1, 4, side, side], align_corners=False)
    cropped = F.grid_sample(torch.from_numpy(np.ascontiguousarray(rgba))[None], grid, align_corners=False)[0]
    return cropped.numpy(), occupancy


def _source_voxels(side: int, zoom: float) -> np.ndarray:
    """Return the voxel (side,) that each voxel of a volume, scaled about its middle, takes its value from."""
    source = (np.arange(side) + 0.5 - side / 2) / zoom + side / 2
    return np.clip(np.floor(source), 0, side - 1).astype(np.int64)


def _inside(side: int, zoom: float) -> np.ndarray:
    """Return which voxels (side,) of a volume, scaled about its middle, have a source inside of it."""
    source = (np.arange(side) + 0.5 - side / 2) / zoom
    return np.abs(source) <= side / 2
