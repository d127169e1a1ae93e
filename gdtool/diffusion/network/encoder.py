"""Encode the condition image to tokens that every view and domain attends to."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from gdtool.core.errors import ResourceError
from gdtool.core.native import imported_if_installed
from gdtool.diffusion.config import ENCODER_HEAD_WIDTH, ModelConfig
from gdtool.diffusion.network.attention import Attention, FeedForward, learned_position
from gdtool.diffusion.network.eight_bit import resize_bicubic
from gdtool.diffusion.network.tensors import pretrained_part

CLIP_SIDE = 224  # pixels of the square picture that CLIP ViT-L/14 reads


class EncoderLayer(nn.Module):
    """Apply a transformer layer with pre-normalisation to tokens (b, t, width)."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attn = Attention(width, heads)
        self.ff = FeedForward(width, 2)

    def forward(self, x):
        """Map tokens (b, t, width) to the same shape."""
        x = x + self.attn(self.norm1(x))
        return x + self.ff(self.norm2(x))


class PatchEncoder(nn.Module):
    """Encode the condition's patches with a small transformer that is trained together with the UNet.

    It runs once for each object instead of once for each image, so layers cost little here.
    """

    def __init__(self, config: ModelConfig):
        super().__init__()
        width, p = config.encoder_width, config.encoder_patch
        self.patch = p
        self.embed = nn.Linear(4 * p * p, width)
        self.position = learned_position((config.image_size // p) ** 2, width)
        self.layers = nn.ModuleList(
            EncoderLayer(width, max(width // ENCODER_HEAD_WIDTH, 1)) for _ in range(config.encoder_layers)
        )
        self.norm = nn.LayerNorm(width)

    def forward(self, rgba):
        """Map rgba (b, 4, h, w) to tokens (b, tokens, width)."""
        x = self.embed(F.pixel_unshuffle(rgba, self.patch).flatten(2).transpose(1, 2)) + self.position
        for layer in self.layers:
            x = layer(x)
        return self.norm(x)


class ClipEncoder(nn.Module):
    """Encode the condition as one 768-wide token, the projected embedding of a frozen CLIP ViT-L/14.

    Stable Diffusion Image Variations does the same. Its model card resizes pictures bicubically without antialiasing.
    Wonder3D resizes them with CLIP's processor, which antialiases and works in 8 bits.
    """

    # mean and deviation of CLIP's training images (openai/clip-vit-large-patch14, preprocessor_config.json)
    MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)

    def __init__(self, config: ModelConfig, clip=None):
        super().__init__()
        if clip is None:
            if imported_if_installed("transformers") is None:
                raise ResourceError(
                    "transformers", "is not installed, and the clip encoder needs it", "pip install 'gdtool[hub]'"
                )
            from transformers import CLIPVisionModelWithProjection

            clip = CLIPVisionModelWithProjection.from_pretrained(
                pretrained_part(config, "image_encoder"), use_safetensors=True
            )
        self.eight_bit = config.convention == "wonder3d"
        # in a list, so that its weights are neither trained nor saved with the model's
        self.frozen = [clip.requires_grad_(False).eval()]

    def forward(self, rgba):
        """Map rgba (b, 4, h, w) in [-1, 1] to one token (b, 1, 768)."""
        clip = self.frozen[0].to(rgba.device)
        with torch.no_grad():
            return clip(self.pixels(rgba)).image_embeds.unsqueeze(1)

    def pixels(self, rgba):
        """Resize and normalise rgba (b, 4, h, w) in [-1, 1] to CLIP's input (b, 3, CLIP_SIDE, CLIP_SIDE)."""
        image = 0.5 + 0.5 * rgba[:, :3]
        if self.eight_bit:
            pixels = (255 * image).round().clamp(0, 255).cpu()
            image = torch.stack([resize_bicubic(p, CLIP_SIDE, CLIP_SIDE) for p in pixels]).to(rgba.device) / 255
        else:
            image = F.interpolate(image, size=(CLIP_SIDE, CLIP_SIDE), mode="bicubic")
        mean, deviation = (torch.tensor(x, device=rgba.device)[:, None, None] for x in (self.MEAN, self.DEVIATION))
        return (image - mean) / deviation


def make_encoder(config: ModelConfig) -> nn.Module:
    """Create the image encoder that the configuration names."""
    return ClipEncoder(config) if config.encoder == "clip" else PatchEncoder(config)
