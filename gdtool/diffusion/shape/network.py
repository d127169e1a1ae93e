"""Predict a volume of occupancies from a picture: a 2D network that gives each pixel its column of voxels."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from gdtool.diffusion.config import ShapeConfig
from gdtool.diffusion.network.attention import Attention, learned_position
from gdtool.diffusion.network.unet import Downsample, Embedding, Resnet, Upsample
from gdtool.diffusion.shape.latent import LatentPrior, ShapeCode

PICTURE_CHANNELS = 5  # red, green, blue, coverage, distance to the outline
FOLD = 2  # pixels along each side that are folded into one of the network
# Initial bias of the logits: most voxels are empty, and a start near their share saves the first hundreds of steps.
EMPTY_BIAS = -3.0


class SelfAttention(nn.Module):
    """Let all pixels of an image's features attend to each other, with a residual connection that starts at zero."""

    def __init__(self, width: int, config: ShapeConfig):
        super().__init__()
        self.norm = nn.GroupNorm(config.norm_groups, width)
        self.attention = Attention(width, max(width // config.head_width, 1))
        for p in self.attention.to_out.parameters():
            nn.init.zeros_(p)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map features (b, c, h, w) to features of the same shape."""
        tokens = self.norm(x).flatten(2).transpose(1, 2)
        return x + self.attention(tokens).transpose(1, 2).reshape(x.shape)


class Level(nn.Module):
    """Hold the layers of one resolution on the way down or up.

    inputs: channels that each residual block reads; width: channels that each writes.
    """

    def __init__(self, inputs: list[int], width: int, attention: bool, config: ShapeConfig):
        super().__init__()
        self.resnets = nn.ModuleList(Resnet(n, width, config.embedding, config.norm_groups, True) for n in inputs)
        self.attention = SelfAttention(width, config) if attention else nn.Identity()

    def forward(self, x: torch.Tensor, embedding: torch.Tensor) -> torch.Tensor:
        """Map features x (b, c, h, w) and embedding (b, e) to (b, width, h, w)."""
        for resnet in self.resnets:
            x = resnet(x, embedding)
        return self.attention(x)


class ShapeNetwork(nn.Module):
    """Predict the logits of a volume's occupancy from a picture and from what is known of the space around the object.

    The picture is seen along z, so each of its pixels belongs to one column of voxels; the network's output channels
    are the voxels of that column. The way down sees picture and space alone. The way up is told the shape's code as
    well, where one is given: a few numbers that say which of the possible shapes it is (latent.py). side: voxels along
    each side of the volume, and pixels along each side of the picture.
    """

    def __init__(self, config: ShapeConfig, side: int):
        super().__init__()
        self.config, self.side = config, side
        widths, last = config.channels, len(config.channels) - 1
        folded = side // FOLD
        self.read_picture = nn.Conv2d(PICTURE_CHANNELS * FOLD**2, widths[0], 3, padding=1)
        self.read_space = nn.Conv2d(side * FOLD**2, widths[0], 1)
        self.position = learned_position(folded * folded, widths[0])
        self.embed_code = Embedding(config.code + 1, config.embedding)  # the code, and whether there is one
        self.no_code = nn.Parameter(torch.zeros(config.embedding))  # what the way down is told
        self.down, self.up, previous = nn.ModuleList(), nn.ModuleList(), widths[0]
        attends = [folded >> i <= config.attention_side for i in range(len(widths))]
        for i, width in enumerate(widths):
            inputs = [previous] + [width] * (config.layers_per_block - 1)
            self.down.append(Level(inputs, width, attends[i], config))
            previous = width
        self.shrink = nn.ModuleList(Downsample(width) for width in widths[:-1])
        self.middle = Level([previous] * 2, previous, True, config)
        for i, width in reversed(list(enumerate(widths))):
            inputs = [previous + width] + [width] * (config.layers_per_block - 1)
            self.up.append(Level(inputs, width, attends[i], config))
            previous = width
        self.grow = nn.ModuleList(Upsample(width) for width in reversed(widths[1:]))
        self.norm_out = nn.GroupNorm(config.norm_groups, widths[0])
        self.write = nn.Conv2d(widths[0], side * FOLD**2, 3, padding=1)
        nn.init.normal_(self.write.weight, std=0.01)
        assert self.write.bias is not None
        nn.init.constant_(self.write.bias, EMPTY_BIAS)
        self.code = ShapeCode(config.code, side)
        self.prior = LatentPrior(config.code, widths[last], config.prior_width)

    def summarise(self, picture: torch.Tensor, space: torch.Tensor) -> list[torch.Tensor]:
        """Run the way down; returns the features of each level and, last, those of the middle.

        picture (b, 5, r, r): PICTURE_CHANNELS, as picture_channels() makes them. space (b, r, r, r): 1 where a voxel
        may be occupied, 0 where it is known to be empty.
        """
        x = self.read_picture(F.pixel_unshuffle(picture, FOLD)) + self.read_space(F.pixel_unshuffle(space, FOLD))
        x = x + self.position.T.reshape(1, -1, self.side // FOLD, self.side // FOLD)
        embedding = self.no_code.expand(len(x), -1)
        features = []
        for i, level in enumerate(self.down):
            x = level(x, embedding)
            features.append(x)
            x = self.shrink[i](x) if i < len(self.shrink) else x
        features.append(self.middle(x, embedding))
        return features

    def expand(self, features: list[torch.Tensor], code: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
        """Run the way up; returns logits (b, r, r, r), indexed (z, y, x).

        features: as summarise() returns them. code (b, config.code): ignored where known (b,), 0 or 1, is 0.
        """
        known = known[:, None].to(code.dtype)
        embedding = self.embed_code(torch.cat([code * known, known], 1))
        x = features[-1]
        for i, level in enumerate(self.up):
            x = level(torch.cat([x, features[-2 - i]], 1), embedding)
            x = self.grow[i](x) if i < len(self.grow) else x
        return F.pixel_shuffle(self.write(F.silu(self.norm_out(x))), FOLD)

    def forward(self, picture, space, code, known) -> torch.Tensor:
        """Predict logits (b, r, r, r); the arguments are those of summarise() and expand()."""
        return self.expand(self.summarise(picture, space), code, known)
