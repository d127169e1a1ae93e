"""Assemble the model: network, image encoder, codec, noise schedule, labels and shape network."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import nn

from gdtool.diffusion.config import ModelConfig
from gdtool.diffusion.network.attention import Layout
from gdtool.diffusion.network.codec import PatchCodec, make_codec
from gdtool.diffusion.network.encoder import PatchEncoder, make_encoder
from gdtool.diffusion.network.known import KnownImages
from gdtool.diffusion.network.labels import class_labels
from gdtool.diffusion.network.schedule import alpha_and_sigma, clean_from_prediction, input_scale
from gdtool.diffusion.network.unet import UNet
from gdtool.diffusion.shape.guides import GUIDE_CHANNELS, Guides, base_images, guide_channels
from gdtool.diffusion.shape.network import ShapeNetwork
from gdtool.diffusion.shape.volume import volume_side


class Condition(NamedTuple):
    """Hold what the network is given besides the noisy latents.

    inputs (m, e, h, w): latents that it reads. base (m, c, h, w): latents that its output is added to; None: none. m is
    the number of images, or with the domains as channels that of views.
    """

    inputs: torch.Tensor
    base: torch.Tensor | None = None

    def scaled(self, factor: torch.Tensor) -> Condition:
        """Multiply the inputs by a factor that broadcasts against them; 0 drops the condition."""
        return Condition(self.inputs * factor, self.base)

    def with_dropped(self) -> Condition:
        """Append a condition without inputs for each, as classifier-free guidance compares with."""
        return Condition(
            torch.cat([self.inputs, torch.zeros_like(self.inputs)]),
            None if self.base is None else torch.cat([self.base, self.base]),
        )


class Model(nn.Module):
    """Hold the UNet, the image encoder, the codec, the noise levels, the class labels, and the shape network if any.

    A VAE codec and a CLIP encoder are loaded from config.pretrained and are not saved with the model. codec, encoder:
    replace what the configuration names.

    With config.domain_layout "channels" the domains of a view are channels of one image inside of the network. Outside,
    latents are one for each image in either layout.
    """

    alpha: torch.Tensor
    sigma: torch.Tensor
    labels: torch.Tensor
    shape: ShapeNetwork | None

    def __init__(self, config: ModelConfig, codec=None, encoder=None):
        super().__init__()
        self.config = config
        self.codec = codec or make_codec(config)
        self.encoder = encoder or make_encoder(config)
        self.shape = ShapeNetwork(config.shape, volume_side(config.image_size)) if config.shape else None
        latent, read = self.codec.latent_channels, self.codec.condition_channels
        if config.domain_layout == "channels":
            count = len(config.domains)
            # noisy latents, picture, guides, known images, and one channel for each domain that says what is known
            inputs = 2 * count * latent + read + count
            inputs += GUIDE_CHANNELS * config.patch**2 if config.shape else 0
            self.conv_mix = nn.Conv2d(inputs, config.channels[0], 1)
            self.base_gate = nn.Parameter(torch.ones(count, len(config.views)))
            self.unet = UNet(config, 0, config.channels[0], self.codec.side, outputs=count * latent)
        else:
            self.unet = UNet(config, latent, read, self.codec.side)
        alpha, sigma = alpha_and_sigma(config)
        self.register_buffer("alpha", alpha, persistent=False)
        self.register_buffer("sigma", sigma, persistent=False)
        self.register_buffer("labels", class_labels(config), persistent=False)

    def latent_shape(self, layout: Layout) -> tuple[int, int, int, int]:
        """Return the latents' shape (n, c, h, w) for a layout."""
        return (layout.images, self.codec.latent_channels, self.codec.side, self.codec.side)

    def condition_latents(
        self,
        rgba: torch.Tensor,
        layout: Layout,
        view_idx: torch.Tensor,
        guides: Guides | None = None,
        known: KnownImages | None = None,
    ) -> Condition:
        """Encode what the network is given, n = layout.images.

        rgba (b, 4, h, w): the condition, whose latent every image gets. Where the configuration has mirror_back, the
        back view gets that of the mirrored condition. view_idx (k,): indices into the configuration's views. guides: of
        all the configuration's views, for a model with a shape network. known: images that are given, for a model with
        the domains as channels.
        """
        latent = self.codec.encode_condition(rgba)
        back = [self.config.mirror_back and self.config.views[k] == "back" for k in view_idx.tolist()]
        mirrored = self.codec.encode_condition(rgba.flip(-1)) if any(back) else latent
        per_view = torch.stack([mirrored if b else latent for b in back], 1)  # (b, k, e, h, w)
        if self.config.domain_layout == "images":
            return Condition(per_view.unsqueeze(1).expand(-1, len(layout.domains), *per_view.shape[1:]).flatten(0, 2))
        return self._view_condition(per_view.flatten(0, 1), layout, view_idx, guides, known)

    def _view_condition(self, picture, layout: Layout, view_idx, guides, known) -> Condition:
        """Encode the condition of a model with the domains as channels; picture (b k, e, h, w)."""
        inputs, base = [picture], None
        count, side = len(layout.domains), self.codec.side
        if self.config.shape:
            if guides is None:
                raise ValueError("a model with a shape network needs guides")
            guides = Guides(*(x[:, view_idx.to(x.device)] for x in guides))
            channels = guide_channels(guides).flatten(0, 1)
            inputs.append(nn.functional.pixel_unshuffle(channels, self.config.patch))
            images = base_images(guides, layout.domains)
            gate = self.base_gate[:, view_idx][None, :, :, None, None, None]
            base = group_domains(self.codec.encode((gate * images).flatten(0, 2)), layout)
        if known is None:
            zeros = picture.new_zeros(len(picture), count * (self.codec.latent_channels + 1), side, side)
            inputs.append(zeros)
        else:
            images = known.images[:, :, view_idx] * known.given[:, :, view_idx, None, None, None]
            inputs.append(group_domains(self.codec.encode(images.flatten(0, 2)), layout))
            flags = known.given[:, :, view_idx].transpose(1, 2).flatten(0, 1)
            inputs.append(flags[:, :, None, None].expand(-1, -1, side, side).to(picture.dtype))
        return Condition(torch.cat(inputs, 1), base)

    def predict_clean(
        self, noisy, condition: Condition, t, context, layout: Layout, view_idx: torch.Tensor
    ) -> torch.Tensor:
        """Predict x_0 (n, c, h, w), float32, from latents noisy (n, c, h, w).

        condition: as condition_latents() returns it. t (b,): timesteps, one for all images of an object. context (b, m,
        encoder_width): the encoder's tokens. view_idx (k,): indices into the configuration's views.
        """
        a, s = self.levels(t, layout)
        scaled = noisy * input_scale(self.config, a, s)
        if self.config.domain_layout == "images":
            label = self.labels[list(layout.domains)][:, view_idx].flatten(0, 1).repeat(layout.objects, 1)
            out = self.unet(scaled, condition.inputs, t, label, context, layout, view_idx).float()
            return clean_from_prediction(self.config, out, noisy, a, s)
        views = Layout(layout.objects, layout.domains[:1], layout.views)
        label = self.labels[layout.domains[0], view_idx].repeat(layout.objects, 1)
        mixed = self.conv_mix(torch.cat([group_domains(scaled, layout), condition.inputs], 1))
        out = self.unet(mixed[:, :0], mixed, t, label, context, views, view_idx).float()
        if condition.base is not None:
            out = out + condition.base
        return clean_from_prediction(self.config, split_domains(out, layout), noisy, a, s)

    def levels(self, t: torch.Tensor, layout: Layout) -> tuple[torch.Tensor, torch.Tensor]:
        """Return alpha and sigma of each image, (n, 1, 1, 1), at the objects' timesteps t (b,)."""
        n = len(layout.domains) * layout.views
        return (
            self.alpha[t].repeat_interleave(n).view(-1, 1, 1, 1),
            self.sigma[t].repeat_interleave(n).view(-1, 1, 1, 1),
        )


def group_domains(latents: torch.Tensor, layout: Layout) -> torch.Tensor:
    """Make the domains of a view channels of one image: (b d k, c, h, w) -> (b k, d c, h, w)."""
    parts = latents.unflatten(0, (layout.objects, len(layout.domains), layout.views))
    return parts.transpose(1, 2).flatten(2, 3).flatten(0, 1)


def split_domains(grouped: torch.Tensor, layout: Layout) -> torch.Tensor:
    """Undo group_domains(): (b k, d c, h, w) -> (b d k, c, h, w)."""
    parts = grouped.unflatten(0, (layout.objects, layout.views)).unflatten(2, (len(layout.domains), -1))
    return parts.transpose(1, 2).flatten(0, 2)


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
