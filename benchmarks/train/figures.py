"""Measure views that were made of one picture against the true ones, over the five views that it does not show."""

from __future__ import annotations

import numpy as np
import torch

from gdtool.folders.views import Views
from gdtool.images import perceptual
from gdtool.images.color import srgb_from_linear
from gdtool.images.metrics import FULL, normal_degrees, over_white, psnr, scalar_error, ssim

SHOWN = "front"  # the view that is the picture
SIDES = ("right", "left")


def figures(result: Views, truth: Views) -> dict[str, float]:
    """Compute the errors of one object over the unseen views. "six": over all views, as the paper's protocol does."""
    true, own = _unseen(truth, truth), _unseen(result, truth)
    out: dict[str, list[float]] = {}
    for k, name in enumerate(true.names):
        full = true.mask[k] > FULL
        for domain in ("color", "albedo"):
            a, b = (over_white(views.images[domain][k], views.mask[k]) for views in (own, true))
            out.setdefault(f"{domain}_psnr_frame", []).append(psnr(a, b))
            if domain == "color":
                out.setdefault("color_ssim_frame", []).append(ssim(a, b))
            if full.any():
                a, b = (np.clip(srgb_from_linear(views.images[domain][k]), 0, 1) for views in (own, true))
                out.setdefault(f"{domain}_psnr_foreground", []).append(psnr(a, b, full))
        a, b = own.mask[k] > 0.5, true.mask[k] > 0.5
        overlap = float((a & b).sum() / max((a | b).sum(), 1))
        out.setdefault("silhouette_overlap", []).append(overlap)
        if name in SIDES:
            out.setdefault("side_overlap", []).append(overlap)
    single = {name: float(np.mean(values)) for name, values in out.items()}
    shown, shown_truth = (
        over_white(views.images["color"][k], views.mask[k])
        for views, k in ((result, result.names.index(SHOWN)), (truth, truth.names.index(SHOWN)))
    )
    for name, measure in (("psnr", psnr), ("ssim", ssim)):
        sum_of_unseen = single[f"color_{name}_frame"] * len(true.names)
        single[f"color_{name}_six"] = (sum_of_unseen + measure(shown, shown_truth)) / len(truth.names)
    single["normal_degrees"] = normal_degrees(own.images["normal"], own.mask, true.images["normal"], true.mask)
    single["depth_error"] = _depth_error(own, true, own.mask)
    for domain in ("roughness", "metallic"):
        single[f"{domain}_error"] = scalar_error(own.images[domain], true.images[domain], true.mask)
    return single


def on_shared_pixels(results: list[Views], truth: Views) -> list[dict[str, float]]:
    """Compute errors of normals and depth of several results over the pixels that are on the object in all of them.

    Each result's own figures are taken where it overlaps with the truth. One that leaves out what is hard fares better
    there.
    """
    true, own = _unseen(truth, truth), [_unseen(result, truth) for result in results]
    mask = np.min([true.mask, *(views.mask for views in own)], 0)
    return [
        {
            "normal_degrees_shared": normal_degrees(views.images["normal"], mask, true.images["normal"], mask),
            "depth_error_shared": _depth_error(views, true, mask),
        }
        for views in own
    ]


class PerceptualTruth:
    """Compare results with one object's true views by LPIPS and FLIP, over white, at the views' size.

    The networks see the truth once. What is not installed is left out.
    """

    def __init__(self, truth: Views):
        self.truth = truth
        self.pictures = _pictures(_unseen(truth, truth))
        missing = perceptual.missing()
        self.names = [name for name in perceptual.FIGURES if name not in missing]
        self.networks = {
            name: perceptual.load_lpips(network)
            for name, network in perceptual.FIGURES.items()
            if network is not None and name in self.names
        }
        with torch.no_grad():
            self.features = {name: network.features(_tensor(self.pictures)) for name, network in self.networks.items()}

    def figures(self, result: Views) -> dict[str, float]:
        """Compute the mean figures of the unseen views of a result."""
        pictures, out = _pictures(_unseen(result, self.truth)), {}
        with torch.no_grad():
            for name, network in self.networks.items():
                distances = network.compare(network.features(_tensor(pictures)), self.features[name])
                out[name] = float(distances.mean())
        if "flip" in self.names:
            out["flip"] = float(np.mean([perceptual.flip(a, b) for a, b in zip(pictures, self.pictures, strict=True)]))
        return out


def _unseen(views: Views, truth: Views) -> Views:
    """Return the views that the picture does not show, in the truth's order."""
    order = [views.names.index(name) for name in truth.names if name != SHOWN]
    return Views([views.cameras[k] for k in order], {d: x[order] for d, x in views.images.items()}, views.mask[order])


def _depth_error(result: Views, truth: Views, mask: np.ndarray) -> float:
    """Compute the mean absolute difference of depths, in world units, where a mask and the truth are on the object."""
    both = (mask > 0.5) & (truth.mask > FULL)
    return float(np.abs(result.images["depth"] - truth.images["depth"])[both].mean()) if both.any() else float("nan")


def _pictures(views: Views) -> np.ndarray:
    """Return the color of views over white, sRGB (k, h, w, 3) float32."""
    color = [over_white(image, mask) for image, mask in zip(views.images["color"], views.mask, strict=True)]
    return np.stack(color).astype(np.float32)


def _tensor(pictures: np.ndarray) -> torch.Tensor:
    """Convert pictures (k, h, w, 3) in [0, 1] to the networks' (k, 3, h, w) in [-1, 1]."""
    return 2 * torch.from_numpy(pictures).permute(0, 3, 1, 2) - 1
