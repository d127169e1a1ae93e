"""Guess views without a model, from what the training objects have: constants, their mean, and the nearest of them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.common.measure import say
from benchmarks.train.authored import is_authored
from benchmarks.train.figures import SHOWN
from benchmarks.train.inflate import Picture
from gdtool.cameras import Camera
from gdtool.core.folder import Folder, open_folder
from gdtool.folders.views import Views, read_views
from gdtool.images.color import linear_from_srgb, srgb_from_linear
from gdtool.images.metrics import FULL, resized

PICTURE_SIZE = 64  # pixels: side of the pictures among which the nearest is looked for
GREY = 0.5  # behind them, sRGB
_BINS = 1000  # of the histograms that medians are taken from
_COLORS, _SCALARS = ("color", "albedo"), ("roughness", "metallic")
_UNKNOWN = {"roughness": 0.5, "metallic": 0.0}  # where no training object has an authored one
_DEPTH_RANGE = (1.0, 3.0)  # world units: near and far of the rig's cameras


@dataclass(frozen=True)
class TrainingObjects:
    """Hold what the baselines need of n training objects.

    folders: of their views. pictures (n, 64, 64, 4) uint8: their front views. mean: the mean object's views; its color
    is the mean over white. color, albedo (3,): mean sRGB of the foreground. depth: median of the foreground. roughness,
    metallic: medians of the foreground of those objects where they are authored, 0.5 and 0 where none is.
    """

    folders: tuple[str, ...]
    pictures: np.ndarray
    mean: dict[str, np.ndarray]
    color: np.ndarray
    albedo: np.ndarray
    roughness: float
    metallic: float
    depth: float

    def nearest(self, picture: Picture) -> Views:
        """Return the views of the object whose front view has the least squared error over grey."""
        wanted = _over_grey(_small(picture.color, picture.mask))
        errors = [float(np.square(_over_grey(candidate) - wanted).mean()) for candidate in self.pictures]
        return read_views(open_folder(Path(self.folders[int(np.argmin(errors))]), ("views",), check=False))

    def mean_views(self, cameras: list[Camera]) -> Views:
        """Return the mean object's views, seen by cameras of the training objects' size."""
        return Views(cameras, {d: x for d, x in self.mean.items() if d != "mask"}, self.mean["mask"])

    def constant_views(self, picture: Picture, cameras: list[Camera]) -> Views:
        """Return the picture's silhouette in each view, filled with the best constant of each domain.

        Normals face the camera.
        """
        mask = np.stack([picture.mask[:, ::-1] if c.name == "back" else picture.mask for c in cameras])
        inside = (mask > 0).astype(np.float32)
        images = {d: inside[..., None] * linear_from_srgb(getattr(self, d)).astype(np.float32) for d in _COLORS}
        images |= {domain: inside * np.float32(getattr(self, domain)) for domain in (*_SCALARS, "depth")}
        images["normal"] = inside[..., None] * np.stack([c.backward for c in cameras])[:, None, None].astype(np.float32)
        return Views(cameras, images, mask)


def digest_of(folders: list[Folder]) -> str:
    """Return a digest of a training set, in this order, by the keys of its views folders."""
    return hashlib.sha256("".join(folder.manifest.key for folder in folders).encode()).hexdigest()[:16]


def read_training_objects(folders: list[Folder], cache: Path) -> TrainingObjects:
    """Read the training objects' views, a tenth of a second each, or what cache holds of the same ones."""
    file = cache / f"training-{digest_of(folders)}.npz"
    if not file.exists():
        sums = _Sums()
        for count, folder in enumerate(folders):
            sums.add(read_views(folder), is_authored(folder))
            if count % 500 == 0:
                say(f"  read {count} of {len(folders)} training objects")
        cache.mkdir(parents=True, exist_ok=True)
        partial = file.with_suffix(".part.npz")
        np.savez_compressed(partial, **sums.arrays())
        partial.replace(file)
    with np.load(file) as found:
        mean = {name.removeprefix("mean_"): found[name] for name in found.files if name.startswith("mean_")}
        scalars = {domain: float(found[domain]) for domain in (*_SCALARS, "depth")}
        colors = {domain: found[domain] for domain in _COLORS}
        return TrainingObjects(tuple(str(f.path) for f in folders), found["pictures"], mean, **colors, **scalars)


class _Sums:
    """Sum what training objects have, so that they need not be in memory together."""

    def __init__(self) -> None:
        self.count, self.mask = 0, np.zeros(0)
        self.images: dict[str, np.ndarray] = {}
        self.pictures: list[np.ndarray] = []
        self.colors = {domain: np.zeros(3) for domain in _COLORS}
        self.pixels = 0
        self.histograms = {domain: np.zeros(_BINS) for domain in (*_SCALARS, "depth")}

    def add(self, views: Views, authored: bool) -> None:
        """Add one object. authored: whether its roughness and metallic count for the medians."""
        front, full = views.names.index(SHOWN), views.mask > FULL
        self.pictures.append(_small(views.images["color"][front], views.mask[front]))
        self.count, self.mask = self.count + 1, views.mask.astype(np.float64) + (self.mask if self.count else 0)
        self.pixels += int(full.sum())
        for domain, image in views.images.items():
            value = np.clip(srgb_from_linear(image), 0, 1) if domain in _COLORS else image
            weight = views.mask[..., None] if value.ndim == 4 else views.mask
            self.images[domain] = value * weight + self.images.get(domain, 0)
            if domain in _COLORS:
                self.colors[domain] += value[full].sum(0)
            elif domain == "depth" or (domain in _SCALARS and authored):
                limits = _DEPTH_RANGE if domain == "depth" else (0.0, 1.0)
                self.histograms[domain] += np.histogram(np.clip(value[full], *limits), _BINS, limits)[0]

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of TrainingObjects."""
        out = {"pictures": np.stack(self.pictures), "mean_mask": (self.mask / self.count).astype(np.float32)}
        for domain, total in self.images.items():
            weight = np.maximum(self.mask[..., None] if total.ndim == 4 else self.mask, 1e-6)
            value = total / weight
            if domain in _COLORS:
                value = linear_from_srgb(value)
            elif domain == "normal":
                value = value / np.maximum(np.linalg.norm(value, axis=-1, keepdims=True), 1e-6)
            out[f"mean_{domain}"] = value.astype(np.float32)
        out |= {domain: total / self.pixels for domain, total in self.colors.items()}
        for domain, histogram in self.histograms.items():
            low, high = _DEPTH_RANGE if domain == "depth" else (0.0, 1.0)
            middle = np.searchsorted(np.cumsum(histogram), histogram.sum() / 2) + 0.5
            median = low + (high - low) * middle / _BINS
            out[domain] = np.array(median if histogram.any() else _UNKNOWN[domain])
        return out


def _small(color: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return a picture (64, 64, 4), sRGB and straight alpha, uint8."""
    rgba = np.concatenate([np.clip(srgb_from_linear(color), 0, 1) * mask[..., None], mask[..., None]], -1)
    small = resized(rgba, PICTURE_SIZE, PICTURE_SIZE)
    small[..., :3] /= np.maximum(small[..., 3:], 1e-6)
    return np.round(255 * np.clip(small, 0, 1)).astype(np.uint8)


def _over_grey(picture: np.ndarray) -> np.ndarray:
    """Lay a picture of _small() over grey; returns (64, 64, 4) in [0, 1]."""
    rgba = picture.astype(np.float32) / 255
    alpha = rgba[..., 3:]
    return np.concatenate([rgba[..., :3] * alpha + GREY * (1 - alpha), alpha], -1)
