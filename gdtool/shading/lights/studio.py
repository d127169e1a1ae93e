"""Prepare a light for use: a metered environment, its spherical Gaussians, and the record of light.json."""

from __future__ import annotations

from typing import Any

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.reading import MAX_INTEGER_DIGITS
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.lights.bundled import random_lobes, rasterise_lobes
from gdtool.shading.lights.environment import Environment
from gdtool.shading.lights.load import load_environment
from gdtool.shading.lights.sg_fit import fit_error, fit_sg

# Height in pixels of a random studio's image: 2.8 degrees a pixel, where the sharpest lobe is 7 degrees wide.
RANDOM_HEIGHT = 64


def studio(source: str, seed: int = 0, fit: bool = True) -> tuple[Environment, SphericalGaussians, dict[str, Any]]:
    """Prepare the light that source names: random:NUMBER, a bundled light, or a lat-long file.

    A random light is made of lobes, so nothing is fitted; its error is that of the image made from them. seed: of the
    fit. fit: whether to fit lobes to other lights; otherwise these have no lobes and no error.

    Returns:
        The metered environment, its lobes, and the record that light.json stores. Raises InputError for a source that
            is none of these.
    """
    import torch

    if source.startswith("random:"):
        number = source.removeprefix("random:")
        if not (number.isascii() and number.isdigit() and len(number) <= MAX_INTEGER_DIGITS):
            raise InputError(
                source,
                "is not random:NUMBER",
                f"write random: and a whole number of at most {MAX_INTEGER_DIGITS} digits, as in random:7",
            )
        axes, sharpness, amplitudes = random_lobes(np.random.default_rng(int(number)))
        environment = rasterise_lobes(axes, sharpness, amplitudes, RANDOM_HEIGHT, source).metered()
        lobes = SphericalGaussians(
            *(torch.tensor(x, dtype=torch.float64) for x in (axes, sharpness, amplitudes * environment.scale))
        )
        error = fit_error(environment, lobes)
    else:
        environment = load_environment(source).metered()
        none = SphericalGaussians(torch.zeros(0, 3), torch.zeros(0), torch.zeros(0, 3))
        lobes, error = fit_sg(environment, seed=seed) if fit else (none, {})
    record = {
        "kind": "spherical_gaussians",
        "axes": lobes.axes.numpy(),
        "sharpness": lobes.sharpness.numpy(),
        "amplitudes": lobes.amplitudes.numpy(),
        "environment": environment.name,
        "fit_error": error,
    }
    return environment, lobes, record
