"""Declare the types, bounds and help texts of options that several stages have."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from gdtool.core.stage import LEAST_EXPOSURE, MOST_EXPOSURE, MOST_SEED

Exposure = Annotated[
    float,
    Meta(
        ge=LEAST_EXPOSURE,
        le=MOST_EXPOSURE,
        description="Factor on the color. 1: a white card in the light's brightest direction has radiance 0.8.",
    ),
]
Fov = Annotated[float, Meta(ge=0, le=120, description="Field of view across, degrees; 0: orthographic.")]
Brdf = Annotated[
    Literal["gltf", "paper"], Meta(description="Reflection model of lit pictures; gltf is what engines use.")
]
Seed = Annotated[int, Meta(ge=0, le=MOST_SEED, description="Seed of all random choices.")]
