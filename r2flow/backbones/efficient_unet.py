"""Efficient U-Net: residual blocks at each resolution, downsampling first and upsampling last (Saharia 2022)."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from r2flow.backbones.base import integers
from r2flow.backbones.convolutions import (
    Resample,
    ResidualBlock,
    RingConv2d,
    SelfAttention,
    UNet,
    zero_convolution,
)

FILTER = (1, 3, 3, 1)


class EfficientUNet(UNet):
    """Velocity v(t, x) by an Efficient U-Net, as in R2DM; parameters carry the published weights' names.

    Args:
        rays: Elevation and azimuth of every pixel in radians, (2, H, W).
        in_channels: Channels C of the image.
        base_channels: Width of the outermost level.
        channel_multiplier: Width of each level over base_channels.
        num_residual_blocks: Residual blocks of each level, down and up alike.
        num_heads: Heads of the self-attention at the deepest level.
        time_channels: Width of the time embedding; None for 4 x base_channels.
        position: "fourier_features", "polar", "spherical_harmonics" or "none".
        ring: Whether the columns are a full turn.
        dropout: Share of activations dropped in training.

    Raises:
        InputError: a shape, width, head count or position that cannot work.
    """

    def __init__(
        self,
        rays: Tensor,
        in_channels: int = 2,
        base_channels: int = 64,
        channel_multiplier: Sequence[int] = (1, 2, 4, 8),
        num_residual_blocks: int | Sequence[int] = (3, 3, 3, 3),
        num_heads: int = 8,
        time_channels: int | None = None,
        position: str | None = "fourier_features",
        ring: bool = True,
        dropout: float = 0.0,
    ) -> None:
        levels = len(channel_multiplier)
        super().__init__(rays, in_channels, base_channels, levels, time_channels, position, ring)
        widths = [base_channels * multiplier for multiplier in channel_multiplier]
        counts = integers("num_residual_blocks", num_residual_blocks, levels)
        self.levels = levels

        def block(level: int, channels: int, out_channels: int, **options: Any) -> Level:
            heads = num_heads if level == levels else None
            count = counts[level - 1]
            return Level(channels, out_channels, count, self.time_channels, ring, dropout, heads, **options)

        for level, width in enumerate(widths, start=1):
            above = widths[level - 2] if level > 1 else base_channels
            self.add_module(f"d_block{level}", block(level, above, width, down=level > 1))
            come = width if level == levels else 2 * width
            self.add_module(f"u_block{level}", block(level, come, above, up=level > 1))
        self.out_conv = zero_convolution(RingConv2d(base_channels, in_channels, ring))

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        condition = self.time_embedding(t)
        h = self.entrance(x)
        skips = []
        for level in range(1, self.levels + 1):
            h = self.get_submodule(f"d_block{level}")(h, condition)
            skips.append(h)
        h = self.get_submodule(f"u_block{self.levels}")(skips.pop(), condition)
        for level in range(self.levels - 1, 0, -1):
            h = self.get_submodule(f"u_block{level}")(torch.cat([h, skips.pop()], dim=1), condition)
        return self.out_conv(h)


class Level(nn.Module):
    """One resolution on the way down or up: half it, residual blocks, attention, double it; each where asked for.

    Args:
        channels: Width that comes in.
        out_channels: Width that goes out.
        count: Residual blocks.
        condition: Width of the time embedding.
        ring: Whether the columns are a ring.
        dropout: See `EfficientUNet`.
        heads: Attention heads; None for no attention.
        down: Whether to halve the resolution first.
        up: Whether to double it last.
    """

    def __init__(
        self,
        channels: int,
        out_channels: int,
        count: int,
        condition: int,
        ring: bool,
        dropout: float,
        heads: int | None = None,
        down: bool = False,
        up: bool = False,
    ) -> None:
        super().__init__()
        self.downsample = self.upsample = self.self_attn_block = None
        if down:
            convolve = RingConv2d(channels, out_channels, ring)
            self.downsample = nn.Sequential(convolve, Resample(FILTER, up=False, ring=ring))
            channels = out_channels
        inputs = [channels, *[out_channels] * (count - 1)]
        self.residual_blocks = nn.ModuleList(
            [SkippedBlock(width, out_channels, condition, ring, dropout) for width in inputs]
        )
        if heads is not None:
            self.self_attn_block = SelfAttention(out_channels, heads)
        if up:
            convolve = RingConv2d(out_channels, out_channels, ring)
            self.upsample = nn.Sequential(Resample(FILTER, up=True, ring=ring), convolve)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        if self.downsample is not None:
            x = self.downsample(x)
        for block in self.residual_blocks:
            x = block(x, condition)
        if self.self_attn_block is not None:
            x = self.self_attn_block(x)
        return x if self.upsample is None else self.upsample(x)


class SkippedBlock(ResidualBlock):
    """A residual block with a 1 x 1 convolution for a skip where its width changes."""

    def __init__(self, channels: int, out_channels: int, condition_channels: int, ring: bool, dropout: float) -> None:
        super().__init__(channels, out_channels, condition_channels, ring, dropout)
        self.skip = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        return (self.skip(x) + self.residual(self.norm1(x), condition)) * self.scale
