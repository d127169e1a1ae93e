"""Hold images that are given to the model, which it makes the others from."""

from __future__ import annotations

from typing import NamedTuple

import torch


class KnownImages(NamedTuple):
    """Hold the known images of b objects in d domains and k views.

    images (b, d, k, 3, h, h): encoded over grey as encoding.encode() makes them; any value where not given. given (b,
    d, k): 1 where an image is known, else 0.
    """

    images: torch.Tensor
    given: torch.Tensor


def keep_known(images: torch.Tensor, known: KnownImages) -> torch.Tensor:
    """Replace predicted images (b, d, k, 3, h, h) by the known ones where these are given."""
    return torch.where(known.given[..., None, None, None] > 0, known.images, images)
