"""Define LPIPS (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric")."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import nn

# ImageNet's mean and deviation for pictures in [-1, 1], as the paper's code has them.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_TINY = 1e-10  # added to a feature vector's length, as the paper's code does


class Layer(NamedTuple):
    """Describe a convolution with ReLU: what it gives, its square kernel, and what stands before and after it."""

    channels: int
    kernel: int
    stride: int = 1
    pool: tuple[int, int] | None = None  # kernel and stride of the max-pooling before it
    tap: bool = False  # its features are compared


def _vgg16() -> tuple[Layer, ...]:
    """List VGG16's convolutions (Simonyan & Zisserman 2014), with a tap at the end of each block."""
    layers = []
    for block, (channels, count) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)]):
        layers += [
            Layer(channels, 3, pool=(2, 2) if block and not k else None, tap=k == count - 1) for k in range(count)
        ]
    return tuple(layers)


ARCHITECTURES = {
    # Krizhevsky 2014, "One weird trick for parallelizing convolutional neural networks"
    "alexnet": (
        Layer(64, 11, stride=4, tap=True),
        Layer(192, 5, pool=(3, 2), tap=True),
        Layer(384, 3, pool=(3, 2), tap=True),
        Layer(256, 3, tap=True),
        Layer(256, 3, tap=True),
    ),
    "vgg16": _vgg16(),
}


class Features(nn.Module):
    """Compute the features of a classifier at its taps, from pictures (n, 3, h, w) in [-1, 1]."""

    shift: torch.Tensor
    scale: torch.Tensor

    def __init__(self, name: str, layers: tuple[Layer, ...] | None = None):
        super().__init__()
        self.layers = layers or ARCHITECTURES[name]
        inputs = (3, *(layer.channels for layer in self.layers))
        self.convolutions = nn.ModuleList(
            nn.Conv2d(width, layer.channels, layer.kernel, layer.stride, _padding(layer))
            for width, layer in zip(inputs[:-1], self.layers, strict=True)
        )
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)

    def forward(self, pictures: torch.Tensor) -> list[torch.Tensor]:
        """Return the features (n, c, h', w') of each tap."""
        x, taps = (pictures - self.shift) / self.scale, []
        for layer, convolution in zip(self.layers, self.convolutions, strict=True):
            x = F.relu(convolution(x if layer.pool is None else F.max_pool2d(x, *layer.pool)))
            if layer.tap:
                taps.append(x)
        return taps


class Lpips(nn.Module):
    """Compute the LPIPS distance: squared differences of unit feature vectors, weighed by channel, meaned by place."""

    def __init__(self, name: str, layers: tuple[Layer, ...] | None = None):
        super().__init__()
        self.features = Features(name, layers)
        self.heads = nn.ParameterList(
            nn.Parameter(torch.zeros(layer.channels)) for layer in self.features.layers if layer.tap
        )

    def forward(self, pictures: torch.Tensor, references: torch.Tensor) -> torch.Tensor:
        """Return the distances (n,) of pictures and references, (n, 3, h, w) each, in [-1, 1]."""
        return self.compare(self.features(pictures), self.features(references))

    def compare(self, taps: list[torch.Tensor], reference_taps: list[torch.Tensor]) -> torch.Tensor:
        """Return the distances (n,) of what `features` gave for pictures and for references."""
        distance = taps[0].new_zeros(len(taps[0]))
        for a, b, head in zip(taps, reference_taps, self.heads, strict=True):
            difference = (_unit(a) - _unit(b)) ** 2
            distance = distance + torch.einsum("nchw,c->nhw", difference, head).mean((1, 2))
        return distance


def _padding(layer: Layer) -> int:
    """Return the padding of a convolution: that which keeps the size, and 2 for AlexNet's first of 11 pixels."""
    return 2 if layer.stride > 1 else layer.kernel // 2


def _unit(features: torch.Tensor) -> torch.Tensor:
    """Scale feature vectors (n, c, h, w) to length 1."""
    return features / (features.square().sum(1, keepdim=True).sqrt() + _TINY)
