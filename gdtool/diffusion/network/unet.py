"""Define the denoising network: Stable Diffusion's UNet, with attention across views and domains.

Key names and arithmetic are those of diffusers' UNet2DConditionModel (version 1 family). diffusers' code is not used:
importing it takes three seconds, and its blocks do not know which images belong to one object.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn
from torch.utils.checkpoint import checkpoint

from gdtool.core.kinds import DOMAINS
from gdtool.diffusion.config import CLASS_WIDTH, ModelConfig
from gdtool.diffusion.network.attention import Layout, RowAttention, Transformer
from gdtool.diffusion.network.labels import WONDER3D_LABEL_WIDTH


def sinusoid(t: torch.Tensor, width: int) -> torch.Tensor:
    """Embed timesteps t (n,) as (n, width): cosines, then sines, of t times 10000^(-i / (width / 2))."""
    half = width // 2
    frequency = torch.exp(-math.log(10000.0) * torch.arange(half, device=t.device, dtype=torch.float32) / half)
    angle = t.float()[:, None] * frequency
    return torch.cat([angle.cos(), angle.sin()], -1)


class Embedding(nn.Module):
    """Embed timesteps or class labels by two linear layers."""

    def __init__(self, inputs: int, width: int):
        super().__init__()
        self.linear_1 = nn.Linear(inputs, width)
        self.linear_2 = nn.Linear(width, width)

    def forward(self, x):
        """Map (n, inputs) to (n, width)."""
        return self.linear_2(F.silu(self.linear_1(x)))


class Resnet(nn.Module):
    """Apply two convolutions with a residual connection, modulated by the embedding.

    embedding: its width. groups: of the group norms. scale_shift: the embedding scales and shifts the features between
    the convolutions; otherwise it is added to them.
    """

    def __init__(self, inputs: int, outputs: int, embedding: int, groups: int, scale_shift: bool):
        super().__init__()
        self.norm1 = nn.GroupNorm(groups, inputs)
        self.conv1 = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.time_emb_proj = nn.Linear(embedding, 2 * outputs if scale_shift else outputs)
        self.norm2 = nn.GroupNorm(groups, outputs)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, padding=1)
        self.conv_shortcut = nn.Conv2d(inputs, outputs, 1) if inputs != outputs else None
        self.scale_shift = scale_shift

    def forward(self, x, embedding):
        """Map features x (n, inputs, h, w) and embedding (n, e) to (n, outputs, h, w)."""
        h = self.conv1(F.silu(self.norm1(x)))
        e = self.time_emb_proj(F.silu(embedding))[:, :, None, None]
        if self.scale_shift:
            scale, shift = e.chunk(2, 1)
            h = torch.addcmul(shift, self.norm2(h), 1 + scale)
        else:
            h = self.norm2(h + e)
        h = self.conv2(F.silu(h))
        return h + (x if self.conv_shortcut is None else self.conv_shortcut(x))


class Downsample(nn.Module):
    """Halve the resolution by a strided convolution."""

    def __init__(self, width: int):
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, stride=2, padding=1)

    def forward(self, x):
        """Map (n, c, h, w) to (n, c, h / 2, w / 2)."""
        return self.conv(x)


class Upsample(nn.Module):
    """Double the resolution by repetition and a convolution."""

    def __init__(self, width: int):
        super().__init__()
        self.conv = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x):
        """Map (n, c, h, w) to (n, c, 2 h, 2 w)."""
        return self.conv(F.interpolate(x, scale_factor=2.0, mode="nearest"))


class Block(nn.Module):
    """Hold the layers of one resolution: residual blocks, row attention, transformers and a resampling.

    Args:
        inputs: channels that each residual block reads, one entry for each.
        width: channels that each of them writes.
        side: width and height of the features.
        config: of the model.
        attention: whether a transformer follows each residual block.
        embedding: width of the time embedding.
        rows: whether row attention follows each residual block.
        down, up: whether the block ends by halving or doubling the resolution.
    """

    def __init__(
        self,
        inputs: list[int],
        width: int,
        side: int,
        config: ModelConfig,
        *,
        attention: bool,
        embedding: int,
        rows: bool = False,
        down: bool = False,
        up: bool = False,
    ):
        super().__init__()
        heads = config.heads or max(width // config.head_width, 1)
        self.resnets = nn.ModuleList(
            Resnet(n, width, embedding, config.norm_groups, config.time_scale_shift) for n in inputs
        )
        self.row_attentions = (
            nn.ModuleList(RowAttention(width, heads, side, config.norm_groups) for _ in inputs) if rows else None
        )
        self.attentions = (
            nn.ModuleList(
                Transformer(
                    width,
                    heads,
                    config.encoder_width,
                    side if config.position_embedding else None,
                    config.norm_groups,
                    config,
                )
                for _ in inputs
            )
            if attention
            else None
        )
        self.downsamplers = nn.ModuleList([Downsample(width)]) if down else None
        self.upsamplers = nn.ModuleList([Upsample(width)]) if up else None


class UNet(nn.Module):
    """Predict noise, velocity or x_0, as config.prediction says, for every image of a batch of objects.

    latent_channels, condition_channels: of the two inputs. side: width and height of the features. outputs: channels
    that are predicted; None: as many as the latents have.
    """

    def __init__(
        self,
        config: ModelConfig,
        latent_channels: int,
        condition_channels: int,
        side: int,
        outputs: int | None = None,
    ):
        super().__init__()
        self.config = config
        widths, width0 = config.channels, config.channels[0]
        embedding = 4 * width0
        self.conv_in = nn.Conv2d(latent_channels + condition_channels, width0, 3, padding=1)
        self.time_embedding = Embedding(width0, embedding)
        self.class_embedding = Embedding(
            WONDER3D_LABEL_WIDTH if config.convention == "wonder3d" else CLASS_WIDTH, embedding
        )
        common: dict[str, Any] = {"config": config, "embedding": embedding}
        last = len(widths) - 1
        self.down_blocks, skips, previous = nn.ModuleList(), [width0], width0
        sides = [side >> i for i in range(len(widths))]
        rows = config.row_attention or (False,) * len(widths)
        for i, width in enumerate(widths):
            inputs = [previous] + [width] * (config.layers_per_block - 1)
            self.down_blocks.append(
                Block(
                    inputs, width, sides[i], attention=config.attention_levels[i], rows=rows[i], down=i < last, **common
                )
            )
            skips += [width] * (config.layers_per_block + (i < last))
            previous = width
        self.mid_block = Block([previous, previous], previous, sides[-1], attention=True, **common)
        del self.mid_block.attentions[1:]  # residual block, transformer, residual block
        self.up_blocks = nn.ModuleList()
        for i, width in reversed(list(enumerate(widths))):
            inputs = []
            for _ in range(config.layers_per_block + 1):
                inputs.append(previous + skips.pop())
                previous = width
            self.up_blocks.append(
                Block(inputs, width, sides[i], attention=config.attention_levels[i], rows=rows[i], up=i > 0, **common)
            )
        self.conv_norm_out = nn.GroupNorm(config.norm_groups, width0)
        self.conv_out = nn.Conv2d(width0, outputs or latent_channels, 3, padding=1)
        self.latent_channels = latent_channels
        self.condition_skip = config.condition_skip and outputs is None
        if config.condition_skip:
            nn.init.zeros_(self.conv_out.weight)
            nn.init.zeros_(self.conv_out.bias)
        if self.condition_skip:
            # A gate for each (domain, view) on the condition's pixels: 1 for the front color view, which nearly is it.
            gate = torch.zeros(len(DOMAINS), len(config.views))
            gate[0, 0] = 1.0
            self.condition_gate = nn.Parameter(gate)

    def forward(self, noisy, condition, timestep, label, context, layout: Layout, view_idx=None):
        """Predict (n, c, h, w) from latents noisy (n, c, h, w) and condition (n, e, h, w).

        n = layout.images, in the order (object, domain, view). timestep (b,); label (n, CLASS_WIDTH); context (b, m,
        encoder_width); view_idx (k,): indices into the configuration's views, None for all of them. The arguments are
        those of diffusers' UNet, hence more than seven.
        """
        per_object = len(layout.domains) * layout.views
        embedding = self.time_embedding(sinusoid(timestep, self.config.channels[0]))
        embedding = embedding.repeat_interleave(per_object, 0) + self.class_embedding(label)
        x = self.conv_in(torch.cat([noisy, condition], 1))
        skips = [x]
        for block in self.down_blocks:
            for j in range(len(block.resnets)):
                x = self._layer(block, j, x, embedding, context, layout)
                skips.append(x)
            if block.downsamplers:
                x = block.downsamplers[0](x)
                skips.append(x)
        for j in range(2):
            x = self._layer(self.mid_block, j, x, embedding, context, layout)
        for block in self.up_blocks:
            for j in range(len(block.resnets)):
                x = torch.cat([x, skips.pop()], 1)
                x = self._layer(block, j, x, embedding, context, layout)
            if block.upsamplers:
                x = block.upsamplers[0](x)
        out = self.conv_out(F.silu(self.conv_norm_out(x)))
        if self.condition_skip:
            views = torch.arange(layout.views) if view_idx is None else view_idx
            gate = self.condition_gate[list(layout.domains)][:, views].reshape(-1).repeat(layout.objects)
            out = out + gate[:, None, None, None] * condition[:, : self.latent_channels]
        return out

    def _layer(self, block, j, x, embedding, context, layout):
        """Run layer j of a block.

        With gradient checkpointing its activations are computed again in the backward pass instead of being held.
        """

        def run(x, embedding, context):
            """Run the residual block, the row attention and the transformer of the layer."""
            x = block.resnets[j](x, embedding)
            if block.row_attentions:
                x = block.row_attentions[j](x, layout)
            if block.attentions and j < len(block.attentions):
                x = block.attentions[j](x, context, layout)
            return x

        if self.config.gradient_checkpointing and self.training:
            return checkpoint(run, x, embedding, context, use_reentrant=False)
        return run(x, embedding, context)
