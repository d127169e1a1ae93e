"""Hold images that are given to the model, which it makes the others from."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gdtool.diffusion.network.encoding import mirror_images, mirrored_order


class KnownImages(NamedTuple):
    """Hold the known images of b objects in d domains and k views.

    images (b, d, k, 3, h, h): encoded over grey as encoding.encode() makes them; any value where not given. given (b,
    d, k): 1 where an image is known, else 0. mask (b, k, h, h): coverage of the views with known images, 0 to 1; any
    value elsewhere.
    """

    images: torch.Tensor
    given: torch.Tensor
    mask: torch.Tensor


def keep_known(images: torch.Tensor, known: KnownImages) -> torch.Tensor:
    """Replace predicted images (b, d, k, 3, h, h) by the known ones where these are given."""
    return torch.where(known.given[..., None, None, None] > 0, known.images, images)


def mirror_known(known: KnownImages, domains: tuple[int, ...], views: tuple[str, ...]) -> KnownImages:
    """Mirror objects about x = 0. domains: indices into DOMAINS along d. views: names along k."""
    order = mirrored_order(views)
    return KnownImages(
        mirror_images(known.images.clone(), domains, views), known.given[:, :, order], known.mask[:, order].flip(-1)
    )
