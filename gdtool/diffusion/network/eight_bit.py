"""Resize and composite pictures in 8 bits, as Pillow and Wonder3D's code do, with equal results.

Pixels are whole numbers 0 to 255, held as floating-point numbers.
"""

from __future__ import annotations

import torch

FRACTION_BITS = 22  # of Pillow's filter weights, which are whole numbers (Resample.c)
CUBIC = -0.5  # parameter a of Keys' cubic convolution kernel, Pillow's value
REACH = 2.0  # pixels that the cubic kernel extends to each side of its centre
CHUNK_ROWS = 256  # resized at once, so that a large picture needs little memory


def resize_bicubic(pixels: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Resize pixels (c, h, w), 0 to 255, to (c, height, width) by Pillow's antialiased bicubic filter.

    Pillow resizes along rows first, then along columns, and rounds to 8 bits after each (Image.resize with BICUBIC).
    """
    along_rows = _resize_last(pixels, width)
    return _resize_last(along_rows.transpose(1, 2), height).transpose(1, 2).contiguous()


def _resize_last(pixels: torch.Tensor, size: int) -> torch.Tensor:
    """Resize the last axis of pixels (c, h, w) to `size` and round to 8 bits; pixels of that size are unchanged."""
    if pixels.shape[2] == size:
        return pixels
    weights = _filter_weights(pixels.shape[2], size)
    rows = pixels.reshape(-1, pixels.shape[2])
    half = 2.0 ** (FRACTION_BITS - 1)
    # In float64 all products and sums are exact: weights below 2^23 times pixels below 2^8.
    parts = [((part.double() @ weights + half) / (2 * half)).floor() for part in rows.split(CHUNK_ROWS)]
    return torch.cat(parts).clamp(0, 255).to(pixels.dtype).reshape(*pixels.shape[:2], size)


def _filter_weights(before: int, after: int) -> torch.Tensor:
    """Compute the weights (before, after) of the cubic filter, float64 whole numbers in units of 2^-FRACTION_BITS.

    Where the picture shrinks, the kernel is widened by the factor that it shrinks by. Each column sums to one.
    """
    scale = before / after
    widening = max(scale, 1.0)
    centre = (torch.arange(after, dtype=torch.float64) + 0.5) * scale
    position = torch.arange(before, dtype=torch.float64)[:, None]
    first = (centre - REACH * widening + 0.5).trunc().clamp_min(0)
    end = (centre + REACH * widening + 0.5).trunc()
    x = ((position - centre + 0.5) / widening).abs()
    near = ((CUBIC + 2) * x - (CUBIC + 3)) * x * x + 1
    far = (((x - 5) * x + 8) * x - 4) * CUBIC
    kernel = torch.where(x < 1, near, torch.where(x < REACH, far, 0.0))
    kernel = torch.where((position >= first) & (position < end), kernel, 0.0)
    fixed = kernel / kernel.sum(0) * 2**FRACTION_BITS
    return (fixed.abs() + 0.5).floor() * fixed.sign()


def resize_rgba(rgba: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Resize rgba (h, w, 4), 0 to 255 with straight alpha, to (height, width, 4), premultiplied meanwhile as in Pillow.

    A picture that has that size already is returned as it is.
    """
    if tuple(rgba.shape[:2]) == (height, width):
        return rgba
    color, alpha = rgba[..., :3], rgba[..., 3:]
    premultiplied = torch.cat([(color * alpha / 255 + 0.5).floor(), alpha], -1)
    resized = resize_bicubic(premultiplied.permute(2, 0, 1), height, width).permute(1, 2, 0)
    color, alpha = resized[..., :3], resized[..., 3:]
    # Pillow divides whole numbers and drops the remainder.
    straight = (255 * color.long() // alpha.long().clamp_min(1)).clamp(0, 255).to(rgba.dtype)
    return torch.cat([torch.where((alpha == 0) | (alpha == 255), color, straight), alpha], -1)


def composite(rgba: torch.Tensor, background: torch.Tensor) -> torch.Tensor:
    """Composite rgba (b, 4, h, w) in [-1, 1] over backgrounds (b,) as Wonder3D's code does, coverage unchanged.

    rgba: premultiplied color and coverage, as objects.condition_plane() encodes them. background: encoded value in
    [-1, 1]. Straight color and alpha are rounded to 8 bits, mixed in float32, and the result is truncated to 8 bits,
    which torchvision's to_pil_image does. Returns (b, 4, h, w) in [-1, 1].
    """
    coverage = 0.5 + 0.5 * rgba[:, 3:]
    color = (127.5 * (rgba[:, :3] / coverage.clamp_min(1e-6) + 1)).round().clamp(0, 255) / 255
    alpha = (255 * coverage).round() / 255
    behind = (0.5 + 0.5 * background)[:, None, None, None]
    mixed = color * alpha + behind * (1 - alpha)
    return torch.cat([(mixed * 255).floor() / 255 * 2 - 1, rgba[:, 3:]], 1)
