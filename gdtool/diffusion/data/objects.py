"""Decode views folders once into memory-mapped arrays, and draw training batches from them.

Each random choice comes from a generator that is seeded by the run's seed and the step's number. So a resumed run makes
the same choices as a run that was never stopped.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from gdtool.core.errors import InputError
from gdtool.core.folder import Folder
from gdtool.core.manifest import MANIFEST
from gdtool.core.names import path_inside
from gdtool.core.reading import read_json
from gdtool.diffusion.config import ModelConfig, TrainConfig
from gdtool.diffusion.network.encoding import PLANE_COUNT, PLANES, mirrored_order, planes_from_images

LIGHT_COUNT = 16


@dataclass(frozen=True)
class Objects:
    """Hold n decoded objects, with k views and c condition images each.

    planes (n, k, 13, h, w) uint8: the channels that encoding.PLANES lists. conditions (n, c, 4, h, w) uint8: red,
    green, blue and coverage; the first is the front view. Bytes 0 to 254 stand for -1 to 1, so 127 is 0. lights (n, 16,
    7) float32: axis, sharpness and amplitude of spherical Gaussians. names: one for each object. volumes (n, bytes)
    uint8: bits of the volumes that the views carve, as volumes.pack_volume() makes them; None for a model without a
    shape network.
    """

    planes: np.ndarray
    conditions: np.ndarray
    lights: np.ndarray
    names: tuple[str, ...]
    volumes: np.ndarray | None = None

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self.planes)

    def part(self, chosen: slice) -> Objects:
        """Return the objects that a slice selects."""
        volumes = None if self.volumes is None else self.volumes[chosen]
        return Objects(self.planes[chosen], self.conditions[chosen], self.lights[chosen], self.names[chosen], volumes)


def to_bytes(x: np.ndarray) -> np.ndarray:
    """Quantise [-1, 1] to the bytes 0 to 254, with 0 exactly at 127."""
    return np.round((np.clip(x, -1, 1) + 1) * 127).astype(np.uint8)


def from_bytes(x: np.ndarray) -> torch.Tensor:
    """Convert the bytes 0 to 254 back to [-1, 1]."""
    return torch.from_numpy(np.array(x)).float() / 127 - 1  # a copy: memory maps are read-only


def shrink(image: np.ndarray, size: int) -> np.ndarray:
    """Box-filter (…, h, w) down to (…, size, size); the values must be premultiplied."""
    if image.shape[-1] == size:
        return image
    factor = image.shape[-1] // size
    return image.reshape(*image.shape[:-2], size, factor, size, factor).mean((-3, -1))


def condition_plane(image: np.ndarray) -> np.ndarray:
    """Encode a condition image (h, w, 4), linear color and straight alpha in [0, 1], as (4, h, w) in [-1, 1].

    Color c becomes 2c - 1 in sRGB times coverage; coverage m becomes 2m - 1.
    """
    from gdtool.images.color import srgb_from_linear

    alpha = image[..., 3]
    color = (2 * srgb_from_linear(np.clip(image[..., :3], 0, 1)) - 1) * alpha[..., None]
    return np.concatenate([np.moveaxis(color, -1, 0), 2 * alpha[None] - 1]).astype(np.float32)


def decode_object(folder: Folder, config: ModelConfig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Decode an object's views folder to the arrays that training reads, at the configuration's image size.

    Returns planes (k, 13, h, w) as encoding.planes_from_images() makes them, conditions (c, 4, h, w) as
    condition_plane() makes them, and light (16, 7): axis, sharpness and amplitude of spherical Gaussians. Raises
    InputError for a folder that lacks a view or a domain, or whose size is no multiple of the model's.
    """
    from gdtool.diffusion.data.framing import frame
    from gdtool.folders.views import read_views
    from gdtool.images.color import linear_from_srgb
    from gdtool.images.io import read_image

    views = read_views(folder, config.domains)
    missing = [name for name in config.views if name not in views.names]
    lacking = [domain for domain in config.domains if domain not in views.images]
    if missing or lacking:
        raise InputError(
            folder.path, f"lacks {', '.join(missing + lacking)}", "render it again with the default rig and all domains"
        )
    order = [views.names.index(name) for name in config.views]
    size, rendered_size = config.image_size, views.mask.shape[-1]
    if views.mask.shape[-2] != rendered_size or rendered_size % size:
        raise InputError(
            folder.path,
            f"has views of {rendered_size} px, not a multiple of the model's {size}",
            f"run gdtool render-dataset --size {size}",
        )
    planes = planes_from_images({d: x[order] for d, x in views.images.items()}, views.mask[order])
    front = np.concatenate([views.images["color"][order[0]], views.mask[order[0]][..., None]], -1)
    extent = bounding_side(front[..., 3]) / rendered_size
    conditions = [condition_plane(front)]
    for path in sorted(folder.path.glob("condition/*.png")):
        image = read_image(
            path_inside(
                folder.path, f"condition/{path.name}", folder.path / MANIFEST, "condition image", byte_escapes=True
            )
        )
        image = image.astype(np.float32) / np.iinfo(image.dtype).max
        if image.ndim == 3 and image.shape[2] == 4 and image[..., 3].max() > 0.5:
            image = np.concatenate([linear_from_srgb(image[..., :3]), image[..., 3:]], -1)
            # Centred and as large as in the front view, as a picture is framed when sampling.
            conditions.append(condition_plane(frame(image, size, extent)))
    conditions = [shrink(c, size) for c in conditions]
    light = np.zeros((LIGHT_COUNT, 7), np.float32)
    if views.light is not None:
        rows = np.concatenate([views.light["axes"], views.light["sharpness"][:, None], views.light["amplitudes"]], 1)
        light[: len(rows)] = rows[:LIGHT_COUNT]
    light[:, 2] += (light[:, :3] == 0).all(1)  # an unused light still needs a unit axis
    return shrink(planes, size), np.stack(conditions), light


def bounding_side(alpha: np.ndarray) -> float:
    """Return the longest side in pixels of the bounding box of alpha (h, w) > 0.5."""
    rows, columns = np.nonzero(alpha > 0.5)
    return float(max(np.ptp(rows), np.ptp(columns)) + 1) if len(rows) else float(alpha.shape[0])


def decode_dataset(
    folders: Iterable[Folder], count: int, config: ModelConfig, cache: Path, conditions: int = 5, warn=lambda text: None
) -> Objects:
    """Decode views folders into files in cache, unless they are there already, and memory-map them.

    Args:
        folders: the views folders; not read where cache is complete.
        count: number of objects that the files have space for, at least the number of folders.
        config: gives the image size, the views and the domains.
        cache: folder that is kept between runs.
        conditions: condition images stored for each object; an object that has fewer repeats them.
        warn: called with a text for each object that cannot be used; it is left out.

    Returns:
        The decoded objects. Raises InputError when no object is usable.
    """
    from gdtool.diffusion.data.volumes import pack_volume
    from gdtool.diffusion.shape.volume import volume_side

    h, k = config.image_size, len(config.views)
    names_file = cache / "objects.json"
    files = {
        "planes": ((k, PLANE_COUNT, h, h), np.uint8),
        "conditions": ((conditions, 4, h, h), np.uint8),
        "lights": ((LIGHT_COUNT, 7), np.float32),
    }
    if config.shape is not None:
        files["volumes"] = ((-(-(volume_side(h) ** 3) // 8),), np.uint8)
    if not names_file.is_file():
        arrays = {
            name: np.lib.format.open_memmap(cache / f"{name}.npy", "w+", dtype, (count, *shape))
            for name, (shape, dtype) in files.items()
        }
        names: list[str] = []
        for folder in folders:
            try:
                planes, rgba, light = decode_object(folder, config)
            except InputError as error:
                warn(f"left out: {error}")
                continue
            i = len(names)
            arrays["planes"][i] = to_bytes(planes)
            arrays["conditions"][i] = to_bytes(rgba)[np.arange(conditions) % len(rgba)]
            arrays["lights"][i] = light
            if config.shape is not None:
                arrays["volumes"][i] = pack_volume(planes, config.views)
            names.append(folder.path.parent.name if folder.path.name == "views" else folder.name)
        for array in arrays.values():
            array.flush()
        part = names_file.with_suffix(".part")
        part.write_text(json.dumps(names))
        part.replace(names_file)  # a killed run leaves no partial file
    names = read_json(names_file)
    if not names:
        raise InputError("dataset", "has no object that can be trained on", "render it with gdtool render-dataset")
    loaded = {name: np.load(cache / f"{name}.npy", mmap_mode="r")[: len(names)] for name in files}
    return Objects(**loaded, names=tuple(names))


@dataclass(frozen=True)
class Batch:
    """Hold the inputs of a training step for b objects with k views.

    planes (b, k, 13, h, w), condition (b, 4, h, w), lights (b, 16, 7): float32, as Objects stores them but in [-1, 1].
    Nothing is composited over a background yet. occupancy (b, r, r, r) uint8: the volumes; None without a shape
    network.
    """

    planes: torch.Tensor
    condition: torch.Tensor
    lights: torch.Tensor
    occupancy: torch.Tensor | None = None

    def to(self, device: str) -> Batch:
        """Move all tensors to a device."""
        occupancy = None if self.occupancy is None else self.occupancy.to(device)
        return Batch(self.planes.to(device), self.condition.to(device), self.lights.to(device), occupancy)


def object_order(count: int, step: int, batch: int, seed: int) -> np.ndarray:
    """Return the indices (batch,) of a step's objects, out of count. Each pass over the data is a new permutation."""
    positions = step * batch + np.arange(batch)
    epochs = positions // count
    orders = {epoch: np.random.default_rng((seed, 1, int(epoch))).permutation(count) for epoch in np.unique(epochs)}
    return np.array([orders[epoch][position % count] for epoch, position in zip(epochs, positions, strict=True)])


def draw_batch(
    objects: Objects,
    idx: np.ndarray,
    config: ModelConfig,
    train: TrainConfig,
    generators: Sequence[np.random.Generator],
) -> Batch:
    """Make a batch of the objects idx (b,), with random condition images, mirroring and permuted color channels.

    generators: one for each object, so that the result does not depend on how a batch is split.
    """
    from gdtool.diffusion.data.disturb import disturb_picture
    from gdtool.diffusion.data.volumes import condition_from_unit, unit_picture, unpack_volume

    planes: list[torch.Tensor] = []
    rgba: list[torch.Tensor] = []
    lights: list[torch.Tensor] = []
    volumes: list[torch.Tensor] = []
    for i, generator in zip(idx, generators, strict=True):
        tilted = generator.random() < train.tilted and objects.conditions.shape[1] > 1
        pick = int(generator.integers(1, objects.conditions.shape[1])) if tilted else 0
        sample = (
            from_bytes(objects.planes[i]),
            from_bytes(objects.conditions[i, pick]),
            torch.from_numpy(np.array(objects.lights[i])),
        )
        volume = None
        if config.shape is not None and objects.volumes is not None:
            volume = torch.from_numpy(unpack_volume(objects.volumes[i], config.image_size).astype(np.uint8))
        if train.mirror and generator.random() < 0.5:
            sample = mirror_object(*sample, config.views)
            volume = None if volume is None else volume.flip(-1)
        if train.hue:
            sample = permute_colors(*sample, generator.permutation(3))
        if train.disturb:
            unit = disturb_picture(unit_picture(sample[1].numpy()), generator)
            sample = (sample[0], torch.from_numpy(condition_from_unit(unit)), sample[2])
        for out, value in zip((planes, rgba, lights), sample, strict=True):
            out.append(value)
        if volume is not None:
            volumes.append(volume)
    stacked = (torch.stack(planes), torch.stack(rgba), torch.stack(lights))
    return Batch(*stacked, torch.stack(volumes) if volumes else None)


def mirror_object(planes, rgba, light, views: tuple[str, ...]):
    """Mirror one object about the plane x = 0.

    Takes planes (k, 13, h, w), rgba (4, h, w), light (16, 7) and the views' names. Left and right views are exchanged;
    the x of normals and of light axes changes its sign.
    """
    order = mirrored_order(views)
    planes = planes[order].flip(-1)
    x = PLANES["normal"].start
    planes[:, x] = -planes[:, x]
    light = light.clone()
    light[:, 0] = -light[:, 0]
    return planes, rgba.flip(-1), light


def permute_colors(planes, rgba, light, order):
    """Permute the red, green and blue of one object's color, albedo, condition and light.

    Takes planes (k, 13, h, w), rgba (4, h, w), light (16, 7) and order, a permutation of (0, 1, 2). Light transport is
    the same for each channel, so the result is an object that could exist.
    """
    planes, rgba, light = planes.clone(), rgba.clone(), light.clone()
    for domain in ("color", "albedo"):
        start = PLANES[domain].start
        planes[:, start : start + 3] = planes[:, [start + int(j) for j in order]]
    rgba[:3] = rgba[[int(j) for j in order]]
    light[:, 4:] = light[:, [4 + int(j) for j in order]]
    return planes, rgba, light


def condition_batch(image: np.ndarray) -> torch.Tensor:
    """Encode one framed image (h, w, 4), linear color and straight alpha, as a batch (1, 4, h, w) in [-1, 1]."""
    return torch.from_numpy(condition_plane(image)).unsqueeze(0)
