"""Compute the class labels that tell the network which domain and which view an image is."""

from __future__ import annotations

import math

import torch

from gdtool.cameras.camera import SIX_VIEWS
from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import ModelConfig

# Wonder3D's elevation and azimuth (radians) of each view relative to the picture's, as its pipeline has them.
ELEVATION = {
    "front": 0.0,
    "front_right": -0.2362,
    "right": -0.1686,
    "back": 0.5220,
    "left": 0.6904,
    "front_left": 0.3733,
}
AZIMUTH = {"front": 0.0, "front_right": 0.8125, "right": 1.6934, "back": 3.1406, "left": 4.8359, "front_left": 5.5859}
SWITCH = {"normal": (1.0, 0.0), "color": (0.0, 1.0)}
WONDER3D_LABEL_WIDTH = 10  # sin and cos of [elevation of the condition, elevation, azimuth, switch]


def class_labels(config: ModelConfig) -> torch.Tensor:
    """Compute labels (domains, views, CLASS_WIDTH): the sines, then the cosines of raw values.

    The raw values are [elevation of the condition, elevation and azimuth of the view relative to it (radians), one-hot
    domain]. The elevation of a photograph is not known when sampling. So it is 0 in training as well, and the network
    infers it from the picture.
    """
    if config.convention == "wonder3d":
        return _wonder3d_labels(config)
    azimuth = dict(SIX_VIEWS)
    raw = torch.zeros(len(DOMAINS), len(config.views), 3 + len(DOMAINS), device="cpu")
    for k, view in enumerate(config.views):
        raw[:, k, 2] = math.radians(azimuth[view])
    for i in range(len(DOMAINS)):
        raw[i, :, 3 + i] = 1.0
    return torch.cat([raw.sin(), raw.cos()], -1)


def _wonder3d_labels(config: ModelConfig) -> torch.Tensor:
    """Compute Wonder3D's labels (domains, views, 10): the sines, then the cosines of raw values.

    The raw values are [elevation of the condition, elevation, azimuth, two switches for the domain], in half precision.
    The switches are 0 for domains that Wonder3D does not have.
    """
    raw = torch.tensor(
        [
            [[0.0, ELEVATION[view], AZIMUTH[view], *SWITCH.get(domain, (0.0, 0.0))] for view in config.views]
            for domain in DOMAINS
        ],
        dtype=torch.float16,
        device="cpu",
    ).float()
    return torch.cat([raw.sin(), raw.cos()], -1)
