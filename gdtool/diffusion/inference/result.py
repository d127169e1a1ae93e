"""Convert sampled images to a views folder's content."""

from __future__ import annotations

import numpy as np
import torch

from gdtool.cameras import Camera, backproject, project
from gdtool.diffusion.inference.familiarity import result_figures
from gdtool.diffusion.inference.outline import add_part_to_masks, draw_part, find_lost_part
from gdtool.diffusion.inference.paint import restore_albedo_contrast
from gdtool.diffusion.network.encoding import coverage, decode
from gdtool.folders.views import Views

# Sampled coverage at which outlines overlap the true ones most, at no cost in color; at one half they cover 4 % too
# little.
OUTLINE_COVERAGE = 0.45
# Power that the odds of metallic are raised to. Above 3 it makes no difference on held-out objects; edges stay soft.
METALLIC_POWER = 4


def sharpen(mask: torch.Tensor) -> torch.Tensor:
    """Double the slope of sampled coverage (…, h, w), 0 to 1, around the value OUTLINE_COVERAGE.

    Coverage is soft where the model is unsure of the outline, but a real outline is one pixel wide.
    """
    return ((mask - OUTLINE_COVERAGE) * 2 + 0.5).clamp(0, 1)


def sharpen_metallic(metallic: torch.Tensor) -> torch.Tensor:
    """Push metallic in [0, 1] toward 0 or 1, whichever is nearer, by raising its odds to the power METALLIC_POWER.

    A material is a metal or it is none. A sampled value in between says how sure the model is.
    """
    yes, no = metallic**METALLIC_POWER, (1 - metallic) ** METALLIC_POWER
    return yes / (yes + no)


def average_opposite_views(soft: torch.Tensor, cameras: list[Camera]) -> torch.Tensor:
    """Average the coverage (k, h, w) of orthographic views from opposite sides, whose outlines are mirror images."""
    out, facing = soft.clone(), np.diag([-1.0, 1.0, -1.0])  # axes of the opposite camera in this camera's frame
    for k, camera in enumerate(cameras):
        for other, opposite in enumerate(cameras):
            if camera.projection == opposite.projection == "orthographic" and np.allclose(
                camera.world_from_camera[:3, :3] @ facing, opposite.world_from_camera[:3, :3], atol=1e-6
            ):
                out[k] = (soft[k] + soft[other].flip(-1)) / 2
    return out


def move_depth_within_silhouettes(depth: np.ndarray, mask: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """Move depth (k, h, w) so that no point projects outside the outline of another view.

    mask (k, h, w) is the views' coverage, 0 to 1. A point moves along its ray, between the camera's near and far plane.
    Only pairs of upright orthographic cameras at one height and of one pixel size take part. Their rows match, so a ray
    of one view projects into a row of the other.
    """
    out, (height, width) = depth.astype(np.float64), mask.shape[1:]
    for k, camera in enumerate(cameras):
        inside = mask[k] > 0.5
        for j, other in enumerate(cameras):
            right, up = other.world_from_camera[:3, :2].T
            per_depth = (
                -float(camera.backward @ right) / other.pixel_size if other.projection == "orthographic" else 0.0
            )
            upright = camera.projection == "orthographic" and np.allclose(
                camera.world_from_camera[:3, 1], up, atol=1e-6
            )
            if (
                abs(per_depth) * other.pixel_size < 0.3
                or not upright
                or abs((camera.position - other.position) @ up) > 1e-6
                or camera.pixel_size != other.pixel_size
            ):
                continue
            row_covered = (mask[j] > 0.5).any(1)
            first, last = _first_covered_column(mask[j]), width - _first_covered_column(mask[j][:, ::-1])
            column = project(other, backproject(camera, out[k]).reshape(-1, 3))[0][:, 0].reshape(height, width)
            outside_by = np.clip(column, first[:, None], last[:, None]) - column
            out[k] += np.where(inside & row_covered[:, None], outside_by / per_depth, 0.0)
        # Contradictory outlines would move points out of the camera's range.
        out[k] = np.where(inside, np.clip(out[k], camera.near, camera.far), out[k])
    return out.astype(np.float32)


def _first_covered_column(mask: np.ndarray) -> np.ndarray:
    """Find the column (h,) at which the coverage (h, w) of each row first reaches one half.

    Interpolates between pixel centres; pixel i covers i to i + 1. Returns 0 for a row that stays below one half.
    """
    row, first = np.arange(len(mask)), (mask > 0.5).argmax(1)
    inner, outer = mask[row, first], np.where(first > 0, mask[row, first - 1], 0.0)
    return np.where(inner > 0.5, first + 0.5 - (inner - 0.5) / np.maximum(inner - outer, 1e-6), 0.0)


def views_from_images(
    images: dict[str, torch.Tensor],
    cameras: list[Camera],
    background: float,
    domains: tuple[str, ...],
    picture_alpha: np.ndarray | None = None,
    silhouettes: torch.Tensor | None = None,
) -> tuple[Views, dict[str, float]]:
    """Convert encoded images (k, 3, h, w) of one object to the Views of some domains, and report what was corrected.

    Args:
        images: by domain, as sample_images() returns them, of one object.
        cameras: of the k views.
        background: encoded value that the images are composited over.
        domains: those to return.
        picture_alpha: (h, w), coverage of the framed picture. It replaces the sampled silhouette of the front view and,
            mirrored, that of the back view. The front view's color is divided by it, since that color is nearly the
            picture.
        silhouettes: (k, h, w), coverage by the shape that the images were painted on; None takes it from the images.

    Returns:
        The views with one mask each, and a report. drawn_share: share of the picture that the other views had no space
            for (see outline.py). painted_share: share whose albedo got the picture's contrast (see paint.py).
            outline_blur in pixels and row_mismatch: see familiarity.result_figures().
    """
    from gdtool.images.color import linear_from_srgb

    soft = coverage(images, background) if silhouettes is None else silhouettes
    mask = sharpen(average_opposite_views(soft, cameras) if silhouettes is None else soft).numpy()
    values = decode(images, soft, background)
    if picture_alpha is not None:
        known = np.ascontiguousarray(picture_alpha, np.float32)
        for k, camera in enumerate(cameras):
            if camera.name == "back":
                mask[k] = known[:, ::-1]
            elif camera.name == "front":
                mask[k] = known
                if "color" in images:
                    values["color"][k] = decode({"color": images["color"][k]}, torch.from_numpy(known), background)[
                        "color"
                    ]
    part, before, names = None, mask, [camera.name for camera in cameras]
    front = names.index("front") if picture_alpha is not None and "front" in names else None
    if front is not None:
        part = find_lost_part(
            soft.numpy(), mask, cameras, front, values["depth"][front].numpy() if "depth" in images else None
        )
    if part is not None and front is not None:
        mask = add_part_to_masks(part, mask, cameras, front)
    out = {}
    for domain in images:  # those left out below as well: others are corrected by them
        value = values[domain].numpy()
        if domain in ("color", "albedo"):
            value = linear_from_srgb(np.moveaxis(value, 1, -1))
        elif domain == "normal":
            value = np.moveaxis(value, 1, -1)
        elif domain == "metallic":
            value = sharpen_metallic(values[domain]).numpy()
        if domain == "depth":
            value = move_depth_within_silhouettes(value, mask, cameras)
        inside = mask > 0
        out[domain] = np.where(inside[..., None] if value.ndim == 4 else inside, value, 0).astype(np.float32)
    report = {"drawn_share": 0.0, "painted_share": 0.0} | result_figures(soft.numpy(), front, picture_alpha)
    if front is not None and "albedo" in out and "color" in values:
        color = linear_from_srgb(np.moveaxis(values["color"][front].numpy(), 0, -1))
        normal, metallic = (out[domain][front] if domain in out else None for domain in ("normal", "metallic"))
        out["albedo"][front], share = restore_albedo_contrast(
            out["albedo"][front], color, mask[front], normal, metallic
        )
        report["painted_share"] = float((share * mask[front]).sum() / max(mask[front].sum(), 1.0))
    if part is not None and front is not None:
        draw_part(part, out, before, cameras, front)
        report["drawn_share"] = float(part.lost.sum() / (mask[front] > 0.5).sum())
    return Views(cameras, {d: out[d] for d in out if d in domains}, mask.astype(np.float32)), report
