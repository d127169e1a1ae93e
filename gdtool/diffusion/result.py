"""Sampled images as a views folder's content."""

from __future__ import annotations

import numpy as np
import torch

from gdtool.cameras import Camera
from gdtool.diffusion.encoding import coverage, decode
from gdtool.folders.views import Views


def sharpen(mask: torch.Tensor) -> torch.Tensor:
    """A model's coverage is soft where it is unsure of the outline; a real outline is a pixel wide: twice the slope at one half."""
    return ((mask - 0.5) * 2 + 0.5).clamp(0, 1)


def tied(soft: torch.Tensor, cameras: list[Camera]) -> torch.Tensor:
    """Coverage (k, h, w), where two orthographic cameras face one another the mean of both: they see one outline, mirrored."""
    out, facing = soft.clone(), np.diag([-1.0, 1.0, -1.0])  # the other's axes, as seen from a camera
    for k, camera in enumerate(cameras):
        for other, opposite in enumerate(cameras):
            if camera.projection == opposite.projection == "orthographic" and np.allclose(
                    camera.world_from_camera[:3, :3] @ facing, opposite.world_from_camera[:3, :3], atol=1e-6):
                out[k] = (soft[k] + soft[other].flip(-1)) / 2
    return out


def views_from_images(images: dict[str, torch.Tensor], cameras: list[Camera], background: float, domains: tuple[str, ...],
                      picture_alpha: np.ndarray | None = None) -> Views:
    """Encoded images (k, 3, h, w) of one object -> Views of the asked domains with one mask per view, shared by all.

    picture_alpha (h, w): coverage of the framed picture. It is the front view's silhouette, and mirrored the back's
    (both orthographic), so neither is guessed; the front color, nearly the picture itself, is divided by it.
    """
    from gdtool.images.color import linear_from_srgb

    soft = coverage(images, background)
    mask = sharpen(tied(soft, cameras)).numpy()
    values = decode(images, soft, background)
    if picture_alpha is not None:
        known = np.ascontiguousarray(picture_alpha, np.float32)
        for k, camera in enumerate(cameras):
            if camera.name == "back":
                mask[k] = known[:, ::-1]
            elif camera.name == "front":
                mask[k] = known
                if "color" in images:
                    values["color"][k] = decode({"color": images["color"][k]}, torch.from_numpy(known), background)["color"]
    out = {}
    for domain in images:
        if domain not in domains:
            continue
        value = values[domain].numpy()
        if domain in ("color", "albedo"):
            value = linear_from_srgb(np.moveaxis(value, 1, -1))
        elif domain == "normal":
            value = np.moveaxis(value, 1, -1)
        inside = mask > 0
        out[domain] = np.where(inside[..., None] if value.ndim == 4 else inside, value, 0).astype(np.float32)
    return Views(cameras, out, mask.astype(np.float32))
