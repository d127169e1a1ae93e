"""Compute LPIPS and FLIP of pictures where the packages that they need are installed."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gdtool.core.errors import GdtoolError
from gdtool.core.native import imported_if_installed
from gdtool.images.metrics import PUBLISHED_SIZE, over_white, resized
from gdtool.images.perceptual.weights import NETWORKS, MissingWeights, weights_file

if TYPE_CHECKING:
    from gdtool.images.perceptual.network import Lpips

# Figures by name, with the network that each needs; FLIP needs none.
FIGURES: dict[str, str | None] = {"lpips_alex": "alexnet", "lpips_vgg": "vgg16", "flip": None}
INSTALL_FLIP = "pip install 'gdtool[perceptual]'"


def missing() -> dict[str, str]:
    """Return the figures that cannot be computed here, each with the reason and the cure in one line."""
    reasons = {}
    for name, network in FIGURES.items():
        try:
            if network is not None:
                weights_file(network)
            elif imported_if_installed("flip_evaluator") is None:
                reasons[name] = f"needs the package flip-evaluator; {INSTALL_FLIP}"
        except (MissingWeights, GdtoolError) as error:
            reasons[name] = str(error)
    return reasons


def perceptual_metrics(
    color: np.ndarray, mask: np.ndarray, true_color: np.ndarray, true_mask: np.ndarray, names: Sequence[str]
) -> dict[str, float]:
    """Compute figures of k pictures over white, full frame, at 256², as the mean of each one's figure.

    Colors are (k, h, w, 3) linear, coverages (k, h, w). names: keys of FIGURES that missing() does not name.
    """
    pairs = [
        tuple(resized(over_white(x, y), PUBLISHED_SIZE, PUBLISHED_SIZE).astype(np.float32) for x, y in ((a, m), (b, n)))
        for a, m, b, n in zip(color, mask, true_color, true_mask, strict=True)
    ]
    out = {}
    for name in names:
        network = FIGURES[name]
        measure = flip if network is None else functools.partial(lpips, network=network)
        out[name] = float(np.mean([measure(image, reference) for image, reference in pairs]))
    return out


def flip(image: np.ndarray, reference: np.ndarray) -> float:
    """Compute the mean FLIP difference of two sRGB pictures (h, w, 3) in [0, 1]; 0 for equal ones, at most 1.

    Seen at 67 pixels a degree, the paper's default. By NVIDIA's package flip-evaluator, low dynamic range.
    """
    evaluator = imported_if_installed("flip_evaluator")
    assert evaluator is not None  # missing() says so before
    a, b = (np.ascontiguousarray(np.clip(x, 0, 1), np.float32) for x in (image, reference))
    return float(evaluator.evaluate(b, a, "LDR", applyMagma=False)[1])


def lpips(image: np.ndarray, reference: np.ndarray, network: str) -> float:
    """Compute the LPIPS distance of two sRGB pictures (h, w, 3) in [0, 1]; network: a name of NETWORKS."""
    import torch

    pair = [torch.from_numpy(np.ascontiguousarray(x, np.float32)).permute(2, 0, 1)[None] for x in (image, reference)]
    with torch.no_grad():
        return float(load_lpips(network)(*(2 * x - 1 for x in pair)))


@functools.lru_cache(len(NETWORKS))
def load_lpips(network: str) -> Lpips:
    """Load a network with its weights. Raises MissingWeights, GdtoolError."""
    import torch
    from safetensors.torch import load_file

    from gdtool.images.perceptual.network import Lpips

    lpips = Lpips(network)
    lpips.load_state_dict(load_file(weights_file(network)))
    for weight in lpips.parameters():  # channels last in memory: a fifth less time on a processor
        if weight.ndim == 4:
            weight.data = weight.data.contiguous(memory_format=torch.channels_last)
    return lpips.eval().requires_grad_(False)
