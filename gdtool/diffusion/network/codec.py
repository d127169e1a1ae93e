"""Convert encoded images to the latents that the network denoises, and back: by patches, or Stable Diffusion's VAE."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch.utils.checkpoint import checkpoint

from gdtool.core.errors import ResourceError
from gdtool.core.native import imported_if_installed
from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.tensors import pretrained_part

CHUNK = 4  # images that go through the VAE at once: its memory does not grow with the batch


class PatchCodec:
    """Fold each patch of p x p pixels into the channels of one latent pixel. Lossless, without weights."""

    def __init__(self, config: ModelConfig):
        self.patch = config.patch
        self.side = config.image_size // config.patch
        self.latent_channels = 3 * config.patch**2
        self.condition_channels = (4 if config.condition_alpha else 3) * config.patch**2
        self.alpha = config.condition_alpha

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        """Fold patches into channels: (n, 3, h, w) in [-1, 1] -> (n, 3 p², h / p, w / p)."""
        return F.pixel_unshuffle(images, self.patch)

    def encode_condition(self, rgba: torch.Tensor) -> torch.Tensor:
        """Fold patches of rgba (n, 4, h, w) in [-1, 1] -> (n, condition_channels, h / p, w / p).

        The color's channels come first; those of coverage follow where the configuration has condition_alpha.
        """
        return F.pixel_unshuffle(rgba if self.alpha else rgba[:, :3], self.patch)

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        """Unfold (n, 3 p², h / p, w / p) -> (n, 3, h, w)."""
        return F.pixel_shuffle(latents, self.patch)


class VaeCodec:
    """Encode and decode images with Stable Diffusion's frozen autoencoder (diffusers), 8 times smaller and 4 channels.

    A latent is the mode of the encoder's distribution times the VAE's scaling factor. The autoencoder moves to its
    input's device and takes CHUNK images at a time. Where a gradient goes through decode(), each chunk is computed
    again in the backward pass, so that the activations of one chunk are held, not of all.
    """

    latent_channels = condition_channels = 4

    def __init__(self, config: ModelConfig, vae=None):
        self.side = config.image_size // 8
        if vae is None:
            if imported_if_installed("diffusers") is None:
                raise ResourceError(
                    "diffusers", "is not installed, and the vae codec needs it", "pip install 'gdtool[hub]'"
                )
            from diffusers import AutoencoderKL

            vae = AutoencoderKL.from_pretrained(pretrained_part(config, "vae"), use_safetensors=True)
        self.vae = vae.requires_grad_(False).eval()

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        """Encode (n, 3, h, w) in [-1, 1] -> (n, 4, h / 8, w / 8)."""
        vae = self.vae.to(images.device)
        with torch.no_grad():
            return in_chunks(lambda x: vae.encode(x).latent_dist.mode() * vae.config.scaling_factor, images)

    def encode_condition(self, rgba: torch.Tensor) -> torch.Tensor:
        """Encode the color of rgba (n, 4, h, w) in [-1, 1] -> (n, 4, h / 8, w / 8); coverage is left out."""
        return self.encode(rgba[:, :3])

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        """Decode (n, 4, h / 8, w / 8) -> (n, 3, h, w); differentiable."""
        vae = self.vae.to(latents.device)
        return in_chunks(lambda x: vae.decode(x / vae.config.scaling_factor).sample, latents)


def in_chunks(function: Callable[[torch.Tensor], torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """Apply function to CHUNK rows of x (n, …) at a time.

    Where x has a gradient, each chunk is computed again in the backward pass instead of being held.
    """
    if torch.is_grad_enabled() and x.requires_grad:
        return torch.cat([checkpoint(function, part, use_reentrant=False) for part in x.split(CHUNK)])
    return torch.cat([function(part) for part in x.split(CHUNK)])


def make_codec(config: ModelConfig) -> PatchCodec | VaeCodec:
    """Create the codec that the configuration names."""
    return VaeCodec(config) if config.codec == "vae" else PatchCodec(config)
