"""Seeded procedural objects with PBR materials, for training, tests and demonstrations: the same seed, the same object.

    from gdtool.assets.procedural import generate
    scene = generate(7)

Every part is a closed surface wound outward; the front (a face, an entrance, a bonnet) looks toward +Z and most objects
are mirror-symmetric in x, as what people photograph is. The two UV sets are explained in finishes.py."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
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
    """Family name -> names of its object kinds."""
    return {family: list(_family(family)) for family in FAMILY_WEIGHTS}


def _family(name: str) -> dict:
    from importlib import import_module

    return import_module(f"gdtool.assets.procedural.{name}").KINDS


def generate(seed: int, kind: str | None = None) -> Scene:
    """Return the object of a seed (>= 0); `kind` (see `kinds()`) forces what it is. Raises ValueError for an unknown
    kind.

    The scene is normalised (bounding box centred, longest side 1), about 2,000 to 40,000 faces.
    """
    import numpy as np

    rng = np.random.default_rng([VERSION, int(seed)])
    names = list(FAMILY_WEIGHTS)
    weights = np.array(list(FAMILY_WEIGHTS.values()))
    family = names[rng.choice(len(names), p=weights / weights.sum())]
    makers = _family(family)
    chosen = list(makers)[rng.integers(len(makers))]
    if kind is not None:
        family = next((name for name in names if kind in _family(name)), None)
        if family is None:
            raise ValueError(
                f"no procedural kind {kind!r}; there are {', '.join(k for name in names for k in _family(name))}"
            )
        chosen = kind
    assembly = _family(family)[chosen](rng)
    return assembly.scene(f"procedural-{seed}-{chosen}")
