"""Render lit pictures of a scene, by sampled direct light or in closed form, until a time or a PSNR is reached."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gdtool.cameras import Camera
from gdtool.images.color import srgb_from_linear
from gdtool.shading.bsdf.closed_form import closed_form_image
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.render.direct import DirectLight
from gdtool.shading.render.render import Goal, Renderer

# The most samples per pixel of a view that seconds or a PSNR end.
OPEN_ENDED = 4096


@dataclass(frozen=True)
class PictureOptions:
    """Set how pictures are rendered.

    samples: the most samples of a pixel, in a view that no goal ends. exposure: factor on the color. brdf: "gltf" or
    "paper", for closed form. Goals: seconds, for all views together; psnr, the estimated dB at which a view is done.
    """

    samples: int
    exposure: float = 1.0
    brdf: str = "gltf"
    seconds: float | None = None
    psnr: float | None = None

    @property
    def most_samples(self) -> int:
        """The most samples per pixel."""
        return self.samples if self.seconds is None and self.psnr is None else OPEN_ENDED


class Pictures(NamedTuple):
    """Hold, for each view, the picture, its share of clipped pixels, and its estimated PSNR.

    images: (h, w, 4), sRGB with alpha, 0 to 1. clipped: share of covered channels above 1. psnr: in dB, or None where
    it was not estimated.
    """

    images: list[np.ndarray]
    clipped: list[float]
    psnr: list[float | None]

    @property
    def clipped_share(self) -> float:
        """Mean share of clipped pixels."""
        return float(np.mean(self.clipped))

    @property
    def least_psnr(self) -> float | None:
        """Least estimated PSNR in dB; None where none was estimated."""
        return min((value for value in self.psnr if value is not None), default=None)


def render_pictures(
    renderer: Renderer,
    light: DirectLight | SphericalGaussians,
    cameras: list[Camera],
    options: PictureOptions,
    progress: Callable = lambda iterable, total, label: iterable,
) -> Pictures:
    """Render a picture for each camera.

    light: DirectLight renders with shadows; SphericalGaussians shade in closed form without. progress(iterable, total,
    label) wraps the loop over the views.
    """
    shade = light.color(options.exposure) if isinstance(light, DirectLight) else None
    out, started = Pictures([], [], []), time.perf_counter()
    for number, camera in enumerate(progress(cameras, len(cameras), "frames")):
        seconds = None
        if options.seconds is not None:
            # Each view gets an equal part of the time that is left.
            seconds = max(0.0, options.seconds - (time.perf_counter() - started)) / (len(cameras) - number)
        frame = renderer.buffers(camera, options.most_samples, shade, Goal(seconds, options.psnr))
        out.psnr.append(renderer.counts.estimated_psnr)
        if shade is None:
            frame["color"] = closed_form_image(frame, camera, light, options.brdf) * options.exposure
        covered = frame["color"][frame["mask"] > 0]
        out.clipped.append(float((covered > 1).mean()) if len(covered) else 0.0)
        color = srgb_from_linear(np.clip(frame["color"], 0, 1))
        out.images.append(np.concatenate([color, frame["mask"][..., None]], -1))
    return out
