"""Place a volume of voxels in the six-view rig: carve it from views, turn it into views, and render it.

A volume is indexed (z, y, x). z grows toward the front camera, y grows downward like an image's rows, x grows to the
right. A voxel is as wide as a pixel, so the front view's pixel (row, column) is the volume's column of voxels at (y,
x), and a view's row shows the volume's slice at that y. The volume covers the middle CROP_SHARE of the image, which
holds a unit box; the rig's image is wider because the box is also seen at 45 degrees.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
import torch.nn.functional as F

from gdtool.cameras.camera import DISTANCE, HALF_WIDTH, rig

CROP_SHARE = 0.75  # of the image's side that the volume covers: 1.08 world units, a unit box and a margin
# Half the depth range that a turned volume is sampled over, in world units: half the diagonal of the volume's base.
DEPTH_RANGE = CROP_SHARE * HALF_WIDTH * 2**0.5


def volume_side(image_size: int) -> int:
    """Return the number of voxels along each side of the volume for images of this size in pixels."""
    return round(CROP_SHARE * image_size)


def crop(image: torch.Tensor) -> torch.Tensor:
    """Cut the part (…, r, r) that the volume covers out of images (…, h, h); r = volume_side(h)."""
    size = image.shape[-1]
    margin = (size - volume_side(size)) // 2
    return image[..., margin : size - margin, margin : size - margin]


@cache
def world_axes(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the unit vectors (3,) to the right and backward of a camera of the rig."""
    camera = next(camera for camera in rig("six", 8) if camera.name == name)
    return camera.world_from_camera[:3, 0], camera.backward


@cache
def _centres(side: int) -> np.ndarray:
    """Return the coordinates (side,) of the voxels' centres along an axis, in world units, increasing."""
    half = CROP_SHARE * HALF_WIDTH
    return ((np.arange(side) + 0.5) / side * 2 - 1) * half


@cache
def view_columns(name: str, image_size: int) -> tuple[np.ndarray, np.ndarray]:
    """Find where each voxel of a slice lies in a view: its column in pixels, and its distance along the view's axis.

    Returns two arrays (z, x): column, the index of the pixel, and depth in world units from the camera's plane.
    """
    right, backward = world_axes(name)
    centres = _centres(volume_side(image_size))
    z, x = np.meshgrid(centres, centres, indexing="ij")
    across = x * right[0] + z * right[2]
    column = np.floor((across / HALF_WIDTH + 1) / 2 * image_size).astype(np.int64)
    depth = DISTANCE - (x * backward[0] + z * backward[2])
    return np.clip(column, 0, image_size - 1), depth


def carve(mask: np.ndarray, depth: np.ndarray | None, views: tuple[str, ...]) -> np.ndarray:
    """Keep the voxels that lie inside every view's silhouette and not in front of its surface; returns bool (z, y, x).

    mask (k, h, h): coverage, 0 to 1. depth (k, h, h): world units, or None for silhouettes alone (the visual hull). A
    voxel is kept up to half its width in front of the surface, so that the voxel which holds the surface stays.
    """
    size = mask.shape[-1]
    side = volume_side(size)
    margin, tolerance = (size - side) // 2, HALF_WIDTH / size
    rows = slice(margin, margin + side)
    kept = np.ones((side, side, side), bool)
    for k, name in enumerate(views):
        column, distance = view_columns(name, size)
        inside = (mask[k, rows] > 0.5)[:, column]  # (y, z, x)
        if depth is not None:
            inside &= distance[None] >= depth[k, rows][:, column] - tolerance
        kept &= inside.transpose(1, 0, 2)
    return kept


# Views along an axis of the volume, which need no interpolation: whether that axis is x instead of z, whether its order
# is turned around, and whether the columns run against the other axis.
_ALONG_AXES = {
    "front": (False, True, False),
    "back": (False, False, True),
    "right": (True, True, True),
    "left": (True, False, False),
}


@cache
def ray_positions(name: str, image_size: int) -> np.ndarray:
    """Return the positions (s,) of the samples along a view's rays, in world units toward the camera, nearest first.

    They are one voxel apart.
    """
    if name in _ALONG_AXES:
        return _centres(volume_side(image_size))[::-1].copy()
    step = 2 * HALF_WIDTH / image_size
    count = int(np.ceil(2 * DEPTH_RANGE / step))
    return (count / 2 - 0.5 - np.arange(count)) * step


@cache
def _turning_grid(name: str, image_size: int, device: str, dtype: torch.dtype) -> torch.Tensor:
    """Make the sampling grid (s, u, 2) that turns a slice (z, x) into a view; u: columns of the whole image."""
    right, backward = world_axes(name)
    half = CROP_SHARE * HALF_WIDTH
    across = ((np.arange(image_size) + 0.5) / image_size * 2 - 1) * HALF_WIDTH
    along = ray_positions(name, image_size)
    x = across * right[0] + along[:, None] * backward[0]
    z = across * right[2] + along[:, None] * backward[2]
    return torch.tensor(np.stack([x, z], -1) / half, dtype=dtype, device=device)


def turn(volume: torch.Tensor, name: str, image_size: int) -> torch.Tensor:
    """Turn volumes (b, z, y, x), or some of their slices y, into a view: (b, y, s, u).

    s: samples along the rays, at ray_positions(). u: columns of the whole image. Interpolates linearly between the
    voxels of a slice; 0 outside the volume.
    """
    slices = volume.permute(0, 2, 1, 3)
    if name in _ALONG_AXES:
        along_x, farthest_first, columns_reversed = _ALONG_AXES[name]
        slices = slices.transpose(2, 3) if along_x else slices
        slices = slices.flip([axis for axis, flipped in ((2, farthest_first), (3, columns_reversed)) if flipped])
        margin = (image_size - volume.shape[-1]) // 2
        return F.pad(slices, (margin, margin))
    grid = _turning_grid(name, image_size, str(volume.device), volume.dtype)
    return F.grid_sample(
        slices, grid.expand(len(volume), *grid.shape), mode="bilinear", padding_mode="zeros", align_corners=False
    )
