"""A light ready for use: environment, metered, with its spherical Gaussians and their record."""

from __future__ import annotations

from typing import Any

import numpy as np

from gdtool.core.errors import InputError
from gdtool.core.reading import MAX_INTEGER_DIGITS
from gdtool.shading.bsdf.sg import SphericalGaussians
from gdtool.shading.lights.bundled import paint, random_lobes
from gdtool.shading.lights.environment import Environment
from gdtool.shading.lights.load import load_environment
from gdtool.shading.lights.sg_fit import fit_error, fit_sg

# Height of the image that a random studio is drawn into for sampling; its sharpest lobe is 7 degrees wide.
RANDOM_HEIGHT = 64


def studio(source: str, seed: int = 0, fit: bool = True) -> tuple[Environment, SphericalGaussians, dict[str, Any]]:
    """random:NUMBER, a bundled light's name, or a lat-long file -> the metered environment, its lobes, and the record
    of light.json. A random studio is made of lobes, so nothing is fitted and the error is that of its pixels; without
    fit other lights have no lobes and an empty error."""
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
        environment = paint(axes, sharpness, amplitudes, RANDOM_HEIGHT, source).metered()
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
