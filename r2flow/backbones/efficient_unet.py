"""Efficient U-Net: residual blocks at each resolution, downsampled first (Saharia et al. 2022)."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from r2flow.backbones.convolutions import (
    BlockOptions,
    Resample,
    ResidualBlock,
    RingConv2d,
    SelfAttention,
    UNet,
    projection,
)
from r2flow.backbones.layers import zero_initialised

_FILTER = (1, 3, 3, 1)


class EfficientUNet(UNet):
    """Efficient U-Net as in R2DM, with equal numbers of residual blocks in encoder and decoder.

    For the options see `UNet`.
    """

    def build_levels(
        self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions
    ) -> None:
        for level, (above, width) in enumerate(pairwise(widths), start=1):
            count = counts[level - 1]
            channels = 2 * width  # with the skip
            attention = 0
            if level == self.levels:
                channels = width
                attention = heads
            down = _Level(above, width, count, options, attention, down=level > 1)
            up = _Level(channels, above, count, options, attention, up=level > 1)
            self.add_module(f"d_block{level}", down)
            self.add_module(f"u_block{level}", up)
        self.out_conv = zero_initialised(RingConv2d(widths[0], self.out_channels, options.ring))

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.time_embedding, t, s)
        h = self.entrance(x)
        skips = []
        for level in range(1, self.levels + 1):
            h = self.get_submodule(f"d_block{level}")(h, condition)
            skips.append(h)
        h = skips.pop()
        for level in range(self.levels, 0, -1):
            h = self.get_submodule(f"u_block{level}")(h, condition)
            if skips:
                h = torch.cat([h, skips.pop()], dim=1)
        return self.out_conv(h)


class _Level(nn.Module):
    """A level of encoder or decoder: downsampling, residual blocks, attention and upsampling."""

    def __init__(
        self,
        channels: int,
        out_channels: int,
        count: int,
        options: BlockOptions,
        heads: int,
        down: bool = False,
        up: bool = False,
    ) -> None:
        super().__init__()
        self.downsample = nn.Sequential()
        if down:
            self.downsample.append(RingConv2d(channels, out_channels, options.ring))
            self.downsample.append(Resample(_FILTER, up=False, ring=options.ring))
            channels = out_channels
        self.residual_blocks = nn.ModuleList()
        for _ in range(count):
            self.residual_blocks.append(_Block(channels, out_channels, options))
            channels = out_channels
        self.self_attn_block = (
            SelfAttention(out_channels, heads, options) if heads else nn.Identity()
        )
        self.upsample = nn.Sequential()
        if up:
            self.upsample.append(Resample(_FILTER, up=True, ring=options.ring))
            self.upsample.append(RingConv2d(out_channels, out_channels, options.ring))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        x = self.downsample(x)
        for block in self.residual_blocks:
            x = block(x, condition)
        return self.upsample(self.self_attn_block(x))


class _Block(ResidualBlock):
    """A residual block with a 1 x 1 convolution as skip if its width changes."""

    def __init__(self, channels: int, out_channels: int, options: BlockOptions) -> None:
        super().__init__(channels, out_channels, options)
        self.skip = projection(channels, out_channels)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        return (self.skip(x) + self.residual(self.norm1(x), condition)) * self.scale
