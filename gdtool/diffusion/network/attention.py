"""Attend inside an image, across the views of an object and across its domains.

Tokens are (b * d * k, t, c): b objects, d domains and k views, in this order, with t tokens of c channels for each
image. Modules have the names of diffusers' transformer blocks, so that Stable Diffusion's keys map one to one.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import nn

from gdtool.core.kinds import DOMAINS


def learned_position(count: int, width: int) -> nn.Parameter:
    """Create a position embedding (count, width) of random values; on the meta device, without values.

    Random numbers on the meta device would load PyTorch's compiler, which takes a second.
    """
    shape = torch.empty(count, width)
    return nn.Parameter(shape if shape.is_meta else 0.1 * torch.randn(count, width))


@dataclass(frozen=True)
class Layout:
    """Describe the images of a batch: b objects, each with the same domains (indices into DOMAINS) and k views."""

    objects: int
    domains: tuple[int, ...]
    views: int

    @property
    def images(self) -> int:
        """Return the number of images, b d k."""
        return self.objects * len(self.domains) * self.views


def attend(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Compute softmax(q kᵀ / √d) v for q (…, heads, t, d) and k, v (…, heads, m, d)."""
    if q.device.type == "cpu" and k.shape[-2] <= 2048:
        # Measured on Zen 5 (bfloat16, 384 tokens): 9 ms forward and backward against 27 ms of torch's fused kernel.
        weights = torch.softmax(q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5, -1)
        return weights.to(v.dtype) @ v
    return F.scaled_dot_product_attention(q, k, v)


class Attention(nn.Module):
    """Attend from tokens to a context with several heads.

    The context is (…, m, context_width). Without one, tokens attend to each other.
    """

    def __init__(self, width: int, heads: int, context_width: int | None = None):
        super().__init__()
        self.heads = heads
        self.to_q = nn.Linear(width, width, bias=False)
        self.to_k = nn.Linear(context_width or width, width, bias=False)
        self.to_v = nn.Linear(context_width or width, width, bias=False)
        self.to_out = nn.ModuleList([nn.Linear(width, width)])

    def split(self, x: torch.Tensor) -> torch.Tensor:
        """Split heads: (n, t, c) -> (n, heads, t, c / heads)."""
        return x.unflatten(-1, (self.heads, -1)).transpose(-2, -3)

    def join(self, x: torch.Tensor) -> torch.Tensor:
        """Join heads: (n, heads, t, c / heads) -> (n, t, c)."""
        return x.transpose(-2, -3).flatten(-2)

    def forward(self, x: torch.Tensor, context: torch.Tensor | None = None) -> torch.Tensor:
        """Attend from x (…, t, c) to context (…, m, context_width)."""
        context = x if context is None else context
        out = attend(self.split(self.to_q(x)), self.split(self.to_k(context)), self.split(self.to_v(context)))
        return self.to_out[0](self.join(out))


class CrossDomainAttention(Attention):
    """Exchange features between color and each other domain of the same view, in the shape of a star.

    Color's queries attend to each other domain, and one linear layer fuses the results. With two_way the other domains'
    queries attend to color as well; otherwise their residual is zero. The output projection starts at zero, so the
    layer does not change a pretrained network before it is trained.
    """

    def __init__(self, width: int, heads: int, two_way: bool):
        super().__init__(width, heads)
        self.two_way = two_way
        # One layer over the concatenated results of the other domains; an absent domain contributes nothing.
        self.fuse = nn.Linear((len(DOMAINS) - 1) * width, width)
        nn.init.zeros_(self.to_out[0].weight)
        nn.init.zeros_(self.to_out[0].bias)

    def forward(self, x: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Map x (b d k, t, c) to a residual of the same shape; zeros where color or every other domain is absent."""
        others = [i for i, domain in enumerate(layout.domains) if domain != 0]
        if 0 not in layout.domains or not others:
            return torch.zeros_like(x)
        color = layout.domains.index(0)
        n, (t, c) = len(others), x.shape[1:]
        per_domain = x.unflatten(0, (layout.objects, len(layout.domains), layout.views))
        rest, color_tokens = per_domain[:, others], per_domain[:, color]  # (b, n, k, t, c), (b, k, t, c)
        shape = rest.shape[:3]

        queries = self.split(self.to_q(color_tokens)).unsqueeze(1).expand(-1, n, -1, -1, -1, -1)
        answers = attend(queries, self.split(self.to_k(rest)), self.split(self.to_v(rest)))  # (b, n, k, heads, t, ·)
        answers = self.join(answers)
        fused = self.fuse.bias + sum(
            F.linear(answers[:, j], self.fuse.weight[:, (layout.domains[i] - 1) * c : layout.domains[i] * c])
            for j, i in enumerate(others)
        )
        out: list = [None] * len(layout.domains)
        out[color] = self.to_out[0](fused)
        if self.two_way:
            keys, values = self.split(self.to_k(color_tokens)), self.split(self.to_v(color_tokens))
            from_color = attend(
                self.split(self.to_q(rest)),
                keys.unsqueeze(1).expand(-1, n, -1, -1, -1, -1),
                values.unsqueeze(1).expand(-1, n, -1, -1, -1, -1),
            )
            from_color = self.to_out[0](self.join(from_color))
        else:
            from_color = torch.zeros(*shape, t, c, dtype=out[color].dtype, device=x.device)
        for j, i in enumerate(others):
            out[i] = from_color[:, j]
        return torch.stack(out, 1).flatten(0, 2)


class JointAttention(Attention):
    """Attend across all domains of a view as one sequence of tokens, as Wonder3D does.

    The weights of to_out start at zero. Its bias does not, so the residual is small but not zero at first.
    """

    def __init__(self, width: int, heads: int):
        super().__init__(width, heads)
        nn.init.zeros_(self.to_out[0].weight)

    def forward(self, x: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Map x (b d k, t, c) to a residual of the same shape."""
        t, c = x.shape[1:]
        sets = x.view(layout.objects, len(layout.domains), layout.views, t, c).transpose(1, 2)
        out = super().forward(sets.reshape(layout.objects * layout.views, -1, c))
        return out.view(sets.shape).transpose(1, 2).reshape(x.shape)


class GatedLinear(nn.Module):
    """Project tokens linearly, gated by a GELU of a second projection (GEGLU, Shazeer 2020)."""

    def __init__(self, width: int, inner: int):
        super().__init__()
        self.proj = nn.Linear(width, 2 * inner)

    def forward(self, x):
        """Map (…, width) to (…, inner)."""
        value, gate = self.proj(x).chunk(2, -1)
        return value * F.gelu(gate)


class FeedForward(nn.Module):
    """Apply the gated feed-forward layer of a transformer block, with diffusers' key names.

    factor: width of the hidden layer, in units of width.
    """

    def __init__(self, width: int, factor: int):
        super().__init__()
        self.net = nn.ModuleList([GatedLinear(width, factor * width), nn.Identity(), nn.Linear(factor * width, width)])

    def forward(self, x):
        """Map (…, width) to (…, width)."""
        return self.net[2](self.net[0](x))


class TransformerBlock(nn.Module):
    """Attend across views, across domains and to the image's embedding, then apply a feed-forward layer.

    multi_view: the tokens of all views of a domain attend to each other; otherwise those of one image. cross_domain: a
    value of ModelConfig.cross_domain.
    """

    def __init__(
        self, width: int, heads: int, context_width: int, feed_forward: int, multi_view: bool, cross_domain: str
    ):
        super().__init__()
        self.multi_view = multi_view
        self.norm1 = nn.LayerNorm(width)
        self.attn1 = Attention(width, heads)
        self.joint = {"joint": "mid", "joint_last": "last"}.get(cross_domain)
        if self.joint:
            self.add_module(f"norm_joint_{self.joint}", nn.LayerNorm(width))
            self.add_module(f"attn_joint_{self.joint}", JointAttention(width, heads))
        if cross_domain in ("one_way", "two_way"):
            self.norm_cross_domain = nn.LayerNorm(width)
            self.attn_cross_domain: CrossDomainAttention | None = CrossDomainAttention(
                width, heads, cross_domain == "two_way"
            )
        else:
            self.attn_cross_domain = None
        self.norm2 = nn.LayerNorm(width)
        self.attn2 = Attention(width, heads, context_width)
        self.norm3 = nn.LayerNorm(width)
        self.ff = FeedForward(width, feed_forward)

    def forward(self, x: torch.Tensor, context: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Map tokens x (b d k, t, c) and context (b, m, context_width) to tokens of x's shape."""
        images, t, c = x.shape
        groups = layout.objects * len(layout.domains)
        tokens = self.norm1(x)
        if self.multi_view:  # keys and values of all views: the views' tokens are one sequence
            tokens = tokens.reshape(groups, layout.views * t, c)
        x = x + self.attn1(tokens).reshape(images, t, c)
        if self.attn_cross_domain is not None:
            x = x + self.attn_cross_domain(self.norm_cross_domain(x), layout)
        if self.joint == "mid":
            x = x + self.attn_joint_mid(self.norm_joint_mid(x), layout)
        # All images of an object read the same embedding: its keys and values are computed once per object.
        read = self.attn2(self.norm2(x).reshape(layout.objects, -1, c), context)
        x = x + read.reshape(images, t, c)
        x = x + self.ff(self.norm3(x))
        return x + self.attn_joint_last(self.norm_joint_last(x), layout) if self.joint == "last" else x


class Transformer(nn.Module):
    """Apply transformer blocks to features (n, c, h, w), between two 1x1 projections, and add the input.

    side: width and height of the features for a learned position, None for no position. groups: of the group norm.
    """

    def __init__(self, width: int, heads: int, context_width: int, side: int | None, groups: int, config):
        super().__init__()
        self.norm = nn.GroupNorm(groups, width, eps=1e-6)
        self.proj_in = nn.Conv2d(width, width, 1)
        self.position = learned_position(side * side, width) if side else None
        self.transformer_blocks = nn.ModuleList(
            [TransformerBlock(width, heads, context_width, config.feed_forward, config.multi_view, config.cross_domain)]
        )
        self.proj_out = nn.Conv2d(width, width, 1)

    def forward(self, x: torch.Tensor, context: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Map features x (n, c, h, w) and context (b, m, context_width) to features of x's shape."""
        n, c, h, w = x.shape
        tokens = self.proj_in(self.norm(x)).flatten(2).transpose(1, 2)
        if self.position is not None:
            tokens = tokens + self.position.to(tokens.dtype)
        for block in self.transformer_blocks:
            tokens = block(tokens, context, layout)
        return x + self.proj_out(tokens.transpose(1, 2).reshape(n, c, h, w))


class RowAttention(nn.Module):
    """Attend along image rows through all views, on levels whose images are too large to attend to all pixels.

    Orthographic cameras at one elevation see a point at the same height, so epipolar lines are rows (Era3D, Li et al.
    2024). A row has views x side tokens instead of views x side². The output projection starts at zero, so the layer
    starts as the identity.
    """

    def __init__(self, width: int, heads: int, side: int, groups: int):
        super().__init__()
        self.norm = nn.GroupNorm(groups, width, eps=1e-6)
        self.position = learned_position(side, width)
        self.attn = Attention(width, heads)
        nn.init.zeros_(self.attn.to_out[0].weight)
        nn.init.zeros_(self.attn.to_out[0].bias)

    def forward(self, x: torch.Tensor, layout: Layout) -> torch.Tensor:
        """Map features x (b d k, c, h, w) to features of the same shape."""
        n, c, h, w = x.shape
        tokens = self.norm(x).permute(0, 2, 3, 1) + self.position.to(x.dtype)  # (n, h, w, c)
        groups = layout.objects * len(layout.domains)
        rows = tokens.reshape(groups, layout.views, h, w, c).transpose(1, 2).reshape(groups * h, layout.views * w, c)
        out = self.attn(rows).reshape(groups, h, layout.views, w, c).transpose(1, 2).reshape(n, h, w, c)
        return x + out.permute(0, 3, 1, 2)
