"""Grow a model to larger images: the same network over patches of proportionally more pixels.

A model with the patch codec sees image_size / patch tokens a side. Twice the size with twice the patch gives as many
tokens, so the same network at the same cost a step. Only the layers that read or write pixels change shape. Shown the
small model's inputs, each pixel repeated to a square, the grown model predicts what the small one predicts, repeated
likewise.
"""

from __future__ import annotations

import math

import msgspec
import torch

from gdtool.core.errors import InputError
from gdtool.diffusion.config import ModelConfig


def resized(config: ModelConfig, size: int) -> ModelConfig:
    """Return the configuration at another image size (pixels), with patches that keep the number of tokens.

    Raises InputError.
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


def grown(tensors: dict[str, torch.Tensor], small: ModelConfig, large: ModelConfig) -> dict[str, torch.Tensor]:
    """Convert the weights of `small` to those of `large`, the same configuration at a multiple of its size.

    Weights that read pixels are divided among the pixels of each square; weights that write them are repeated.
    Unchanged where the sizes are equal. Raises InputError when the two are not the same network.
    """
    if small.image_size == large.image_size:
        return tensors
    if small.codec != "patch" or large.image_size % small.image_size or resized(small, large.image_size) != large:
        raise InputError(
            "start",
            f"is a model of {small.image_size} px that cannot be grown to {large.image_size} px",
            "start from a model of the patch codec that differs in nothing but a size which is a whole number of "
            "times smaller",
        )
    factor = large.image_size // small.image_size
    out = dict(tensors)
    out["unet.conv_in.weight"] = _squares(tensors["unet.conv_in.weight"], 1, small.patch, factor) / factor**2
    for name in ("unet.conv_out.weight", "unet.conv_out.bias"):
        out[name] = _squares(tensors[name], 0, small.patch, factor)
    if small.encoder == "patch":
        name = "encoder.embed.weight"
        out[name] = _squares(tensors[name], 1, small.encoder_patch, factor) / factor**2
    return out


def _squares(weight: torch.Tensor, dim: int, patch: int, factor: int) -> torch.Tensor:
    """Repeat each pixel of patches folded into weight's dimension dim (c p², as pixel_unshuffle folds) to a square."""
    pixels = weight.unflatten(dim, (-1, patch, patch))
    return pixels.repeat_interleave(factor, dim + 1).repeat_interleave(factor, dim + 2).flatten(dim, dim + 2)
