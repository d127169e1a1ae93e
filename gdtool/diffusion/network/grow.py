"""Grow a model to larger images: the same network over patches of proportionally more pixels.

A model with the patch codec sees image_size / patch tokens a side. Twice the size with twice the patch gives as many
tokens, so a step costs the same. Only the layers that read or write pixels change their shape. Let each pixel of the
small model's inputs be repeated to a square. The grown model then predicts the small model's prediction, with each
pixel repeated in the same way.
"""

from __future__ import annotations

import math

import msgspec
import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.config import ModelConfig


def resize_config(config: ModelConfig, size: int) -> ModelConfig:
    """Return the configuration for images of `size` pixels a side, with patches that keep the number of tokens.

    Raises InputError for a size at which a patch has no whole number of pixels or the network cannot be built.
    """
    if size % config.image_size and config.image_size % size:
        raise InputError(
            "size",
            f"{size} is neither a multiple nor a divisor of the configuration's {config.image_size}",
            f"give {config.image_size} times a whole number, or a part of it, such as {config.image_size // 2}",
        )
    patches = {}
    for name in ("patch", "encoder_patch"):
        if (name == "patch" and config.codec != "patch") or (name == "encoder_patch" and config.encoder != "patch"):
            continue
        value = getattr(config, name) * size
        if value % config.image_size:
            raise InputError(
                "size",
                f"{size} leaves no whole pixel in a patch of {getattr(config, name)}",
                f"give a multiple of {config.image_size // math.gcd(config.image_size, getattr(config, name))}",
            )
        patches[name] = value // config.image_size
    try:
        return msgspec.structs.replace(config, image_size=size, **patches)
    except ValueError as fault:
        raise InputError(
            "size", f"{size} does not fit the configuration: {fault}", f"give a multiple of {config.image_size}"
        ) from None


def grow_weights(tensors: dict[str, torch.Tensor], small: ModelConfig, large: ModelConfig) -> dict[str, torch.Tensor]:
    """Convert the weights of `small` to those of `large`, the same configuration at a multiple of its size.

    The weight of a pixel that is read is divided among the pixels of its square; the weight of a pixel that is written
    is repeated. Returns tensors unchanged where the sizes are equal. Raises InputError when the networks differ in more
    than the size.
    """
    if small.image_size == large.image_size:
        return tensors
    if small.codec != "patch" or large.image_size % small.image_size or resize_config(small, large.image_size) != large:
        raise InputError(
            "start",
            f"is a model of {small.image_size} px that cannot be grown to {large.image_size} px",
            "start from a model of the patch codec that differs in nothing but a size which is a whole number of "
            "times smaller",
        )
    factor = large.image_size // small.image_size
    out = dict(tensors)
    out["unet.conv_in.weight"] = _repeat_pixels(tensors["unet.conv_in.weight"], 1, small.patch, factor) / factor**2
    for name in ("unet.conv_out.weight", "unet.conv_out.bias"):
        out[name] = _repeat_pixels(tensors[name], 0, small.patch, factor)
    if small.encoder == "patch":
        name = "encoder.embed.weight"
        out[name] = _repeat_pixels(tensors[name], 1, small.encoder_patch, factor) / factor**2
    return out


def _repeat_pixels(weight: torch.Tensor, dim: int, patch: int, factor: int) -> torch.Tensor:
    """Repeat each pixel of a patch to factor x factor pixels, in a weight whose dimension dim holds folded patches.

    That dimension has c patch² entries, in the order of torch's pixel_unshuffle.
    """
    pixels = weight.unflatten(dim, (-1, patch, patch))
    return pixels.repeat_interleave(factor, dim + 1).repeat_interleave(factor, dim + 2).flatten(dim, dim + 2)
