"""From encoded images to what is denoised, and back: pixels folded into channels, or Stable Diffusion's VAE."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from gdtool.core.errors import ResourceError
from gdtool.diffusion.config import ModelConfig


class PatchCodec:
    """Space-to-depth: a patch of p x p pixels is one latent pixel. Lossless, no weights."""

    def __init__(self, config: ModelConfig):
        self.patch = config.patch
        self.side = config.image_size // config.patch
        self.latent_channels = 3 * config.patch**2
        self.condition_channels = (4 if config.condition_alpha else 3) * config.patch**2
        self.alpha = config.condition_alpha

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        """(n, 3, h, w) in [-1, 1] -> (n, 3 p², h / p, w / p)"""
        return F.pixel_unshuffle(images, self.patch)

    def encode_condition(self, rgba: torch.Tensor) -> torch.Tensor:
        """(n, 4, h, w) -> (n, condition_channels, h / p, w / p), the color's channels first."""
        return F.pixel_unshuffle(rgba if self.alpha else rgba[:, :3], self.patch)

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        return F.pixel_shuffle(latents, self.patch)


class VaeCodec:
    """Stable Diffusion's autoencoder (diffusers), frozen: factor 8, 4 channels, the mode times the scaling factor."""

    latent_channels = condition_channels = 4

    def __init__(self, config: ModelConfig, vae=None):
        self.side = config.image_size // 8
        if vae is None:
            try:
                from diffusers import AutoencoderKL
            except ImportError:
                raise ResourceError("diffusers", "is not installed, and the vae codec needs it", "pip install 'gdtool[hub]'") from None
            vae = AutoencoderKL.from_pretrained(config.pretrained, subfolder="vae", use_safetensors=True)
        self.vae = vae.requires_grad_(False).eval()

    def encode(self, images: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            return self.vae.encode(images).latent_dist.mode() * self.vae.config.scaling_factor

    def encode_condition(self, rgba: torch.Tensor) -> torch.Tensor:
        return self.encode(rgba[:, :3])

    def decode(self, latents: torch.Tensor) -> torch.Tensor:
        return self.vae.decode(latents / self.vae.config.scaling_factor).sample


def make_codec(config: ModelConfig) -> PatchCodec | VaeCodec:
    return VaeCodec(config) if config.codec == "vae" else PatchCodec(config)
