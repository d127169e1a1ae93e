"""Assemble the model: network, image encoder, codec, noise schedule and labels."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from torch import nn

from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.codec import PatchCodec, make_codec
from gdtool.diffusion.network.encoder import PatchEncoder, make_encoder
from gdtool.diffusion.network.labels import class_labels
from gdtool.diffusion.network.schedule import alpha_and_sigma, clean_from_prediction, input_scale
from gdtool.diffusion.network.unet import UNet


class Model(nn.Module):
    """Hold the UNet, the image encoder, the codec, the noise levels and the class labels.

    A VAE codec and a CLIP encoder are loaded from config.pretrained and are not saved with the model. codec, encoder:
    replace what the configuration names.
    """

    alpha: torch.Tensor
    sigma: torch.Tensor
    labels: torch.Tensor

    def __init__(self, config: ModelConfig, codec=None, encoder=None):
        super().__init__()
        self.config = config
        self.codec = codec or make_codec(config)
        self.encoder = encoder or make_encoder(config)
        self.unet = UNet(config, self.codec.latent_channels, self.codec.condition_channels, self.codec.side)
        alpha, sigma = alpha_and_sigma(config)
        self.register_buffer("alpha", alpha, persistent=False)
        self.register_buffer("sigma", sigma, persistent=False)
        self.register_buffer("labels", class_labels(config), persistent=False)

    def latent_shape(self, layout: Layout) -> tuple[int, int, int, int]:
        """Return the latents' shape (n, c, h, w) for a layout."""
        return (layout.images, self.codec.latent_channels, self.codec.side, self.codec.side)

    def condition_latents(self, rgba: torch.Tensor, layout: Layout, view_idx: torch.Tensor) -> torch.Tensor:
        """Encode the condition rgba (b, 4, h, w) to a latent for each image, (n, e, h, w), n = layout.images.

        view_idx (k,): indices into the configuration's views. Where the configuration has mirror_back, the back view
        gets the latent of the mirrored condition.
        """
        latent = self.codec.encode_condition(rgba)
        back = [self.config.mirror_back and self.config.views[k] == "back" for k in view_idx.tolist()]
        mirrored = self.codec.encode_condition(rgba.flip(-1)) if any(back) else latent
        per_view = torch.stack([mirrored if b else latent for b in back], 1)  # (b, k, e, h, w)
        return per_view.unsqueeze(1).expand(-1, len(layout.domains), *per_view.shape[1:]).flatten(0, 2)

    def predict_clean(self, noisy, condition, t, context, layout: Layout, view_idx: torch.Tensor) -> torch.Tensor:
        """Predict x_0 (n, c, h, w), float32, from latents noisy (n, c, h, w) and condition (n, e, h, w).

        t (b,): timesteps, one for all images of an object. context (b, m, encoder_width): the encoder's tokens.
        view_idx (k,): indices into the configuration's views.
        """
        label = self.labels[list(layout.domains)][:, view_idx].flatten(0, 1).repeat(layout.objects, 1)
        a, s = self.levels(t, layout)
        out = self.unet(noisy * input_scale(self.config, a, s), condition, t, label, context, layout, view_idx).float()
        return clean_from_prediction(self.config, out, noisy, a, s)

    def levels(self, t: torch.Tensor, layout: Layout) -> tuple[torch.Tensor, torch.Tensor]:
        """Return alpha and sigma of each image, (n, 1, 1, 1), at the objects' timesteps t (b,)."""
        n = len(layout.domains) * layout.views
        return (
            self.alpha[t].repeat_interleave(n).view(-1, 1, 1, 1),
            self.sigma[t].repeat_interleave(n).view(-1, 1, 1, 1),
        )


def parameter_count(model: nn.Module) -> int:
    """Count the parameters, trained and frozen."""
    return sum(p.numel() for p in model.parameters())


def structure(config: ModelConfig, device: str = "meta") -> Model:
    """Build the trained parts of the model on a device, by default without values on the meta device.

    A VAE has a stand-in that knows its shapes only, and CLIP is left out.
    """
    with torch.device(device):
        if config.codec == "vae":
            codec: Any = SimpleNamespace(side=config.image_size // 8, latent_channels=4, condition_channels=4)
        else:
            codec = PatchCodec(config)
        encoder = PatchEncoder(config) if config.encoder == "patch" else torch.nn.Identity()
        return Model(config, codec, encoder).to(device)
