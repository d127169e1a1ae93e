"""Declare the types, bounds and help texts of the options that say how views are sampled from noise.

None stands for the model's own value.
"""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta

from gdtool.core.stage import FILE, MOST_SEED

Steps = (
    Annotated[
        int, Meta(ge=1, le=1000, description="Denoising steps; without it the number that measured best for the model.")
    ]
    | None
)
Guidance = (
    Annotated[
        float,
        Meta(
            ge=0,
            le=30,
            description="Classifier-free guidance; 1: none, and half the time. Without it the model's own: 1 for "
            "gdtool's models, 3 for Wonder3D's.",
        ),
    ]
    | None
)
GuidedFrom = Annotated[
    float, Meta(ge=0, le=1, description="Least noise that guidance acts at, as a share of the timesteps.")
]
GuidedTo = Annotated[
    float,
    Meta(ge=0, le=1, description="Most noise that guidance acts at. Steps outside of the two take half the time."),
]
Scheduler = Annotated[Literal["ddim", "dpm"], Meta(description="Sampler: DDIM or DPM-Solver++.")]
Eta = (
    Annotated[
        float,
        Meta(
            ge=0,
            le=1,
            description="Share of the noise that each step of DDIM renews; 0: none. Without it the model's own: 0 for "
            "gdtool's models, 1 for Wonder3D's.",
        ),
    ]
    | None
)
Spacing = Annotated[
    Literal["auto", "trailing", "leading"],
    Meta(
        description="Timesteps that the steps visit: from the last one (trailing), or down to the first (leading). "
        "auto: the model's own, trailing for gdtool's models and as its scheduler says for Wonder3D's."
    ),
]
ViewName = Annotated[
    Literal["front", "front_right", "right", "back", "left", "front_left"],
    Meta(description="View that the source's picture shows."),
]
PictureOf = Annotated[str, Meta(description="Picture of the object from this view.", extra=FILE)] | None
Mirror = Annotated[
    bool,
    Meta(
        description="Average with the views of the picture's mirror image, where the model's card says that it "
        "gains from that; twice the time."
    ),
]
Seed = Annotated[
    int,
    Meta(
        ge=0,
        le=MOST_SEED,
        description="Seed of the noise, the same for every object whatever the order. With a model that predicts "
        "the shape first, 0 is its best guess, and other seeds give other shapes.",
    ),
]
Precision = Annotated[Literal["float32", "bfloat16"], Meta(description="Arithmetic of the networks.")]
Compile = Annotated[
    bool,
    Meta(
        description="Compile the network first (torch.compile, needs a C++ compiler). It takes two minutes the "
        "first time and ten seconds afterwards, and saves a third of each step."
    ),
]
