"""Generate seeded objects with PBR materials for training, tests and demonstrations: the same seed, the same object.

    from gdtool.assets.procedural import generate
    scene = generate(7)

Every part is a closed surface with outward winding. The front (a face, an entrance, a bonnet) looks toward +Z. Most
objects are mirror-symmetric in x, like most things that people photograph. finishes.py explains the two UV sets.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np

    from gdtool.assets.procedural.assembly import Assembly
    from gdtool.assets.scene import Scene

VERSION = 1  # rises when any seed's object changes: the version is part of every random stream

FAMILY_WEIGHTS = {
    "creatures": 0.24,
    "vessels": 0.17,
    "nature": 0.17,
    "household": 0.16,
    "buildings": 0.09,
    "vehicles": 0.09,
    "abstract": 0.08,
}


def kinds() -> dict[str, list[str]]:
    """List the names of the object kinds of each family."""
    return {family: list(_family(family)) for family in FAMILY_WEIGHTS}


def _family(name: str) -> dict[str, Callable[[np.random.Generator], Assembly]]:
    """Load the functions of a family, by the name of the kind that each makes."""
    from importlib import import_module

    return import_module(f"gdtool.assets.procedural.{name}").KINDS


def generate(seed: int, kind: str | None = None) -> Scene:
    """Generate the object of a seed (>= 0); `kind`, one of `kinds()`, forces what it is.

    The scene is normalised: its bounding box is centred at the origin and its longest side is 1. It has about 2,000 to
    40,000 faces. Raises ValueError for an unknown kind.
    """
    import numpy as np

    rng = np.random.default_rng([VERSION, int(seed)])
    names = list(FAMILY_WEIGHTS)
    weights = np.array(list(FAMILY_WEIGHTS.values()))
    family = names[rng.choice(len(names), p=weights / weights.sum())]
    makers = _family(family)
    chosen = list(makers)[rng.integers(len(makers))]
    if kind is not None:
        makers = {name: make for family in names for name, make in _family(family).items()}
        if kind not in makers:
            raise ValueError(f"no procedural kind {kind!r}; there are {', '.join(makers)}")
        chosen = kind
    assembly = makers[chosen](rng)
    return assembly.scene(f"procedural-{seed}-{chosen}")
