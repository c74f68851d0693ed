"""Efficient U-Net: residual blocks at each resolution, downsampling first and upsampling last (Saharia 2022)."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from r2flow.backbones.convolutions import BlockOptions, Resample, ResidualBlock, RingConv2d, SelfAttention, UNet
from r2flow.backbones.layers import zero_initialised

FILTER = (1, 3, 3, 1)


class EfficientUNet(UNet):
    """Efficient U-Net as in R2DM, with equal numbers of residual blocks in encoder and decoder.

    For the options see `UNet`.
    """

    def build_levels(self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions) -> None:
        for level, ((above, width), count) in enumerate(zip(pairwise(widths), counts, strict=True), start=1):
            deepest = level == self.levels
            attention = heads if deepest else None
            self.add_module(f"d_block{level}", Level(above, width, count, options, attention, down=level > 1))
            channels = width if deepest else 2 * width  # with the skip
            self.add_module(f"u_block{level}", Level(channels, above, count, options, attention, up=level > 1))
        self.out_conv = zero_initialised(RingConv2d(widths[0], self.out_channels, options.ring))

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.time_embedding, t, s)
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
    """A level of encoder or decoder: optional downsampling, residual blocks, optional attention and upsampling."""

    def __init__(
        self,
        channels: int,
        out_channels: int,
        count: int,
        options: BlockOptions,
        heads: int | None = None,
        down: bool = False,
        up: bool = False,
    ) -> None:
        super().__init__()
        self.downsample = nn.Sequential()
        if down:
            convolve = RingConv2d(channels, out_channels, options.ring)
            self.downsample = nn.Sequential(convolve, Resample(FILTER, up=False, ring=options.ring))
            channels = out_channels
        inputs = [channels, *[out_channels] * (count - 1)]
        self.residual_blocks = nn.ModuleList([SkippedBlock(width, out_channels, options) for width in inputs])
        self.self_attn_block = nn.Identity() if heads is None else SelfAttention(out_channels, heads, options)
        self.upsample = nn.Sequential()
        if up:
            convolve = RingConv2d(out_channels, out_channels, options.ring)
            self.upsample = nn.Sequential(Resample(FILTER, up=True, ring=options.ring), convolve)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        x = self.downsample(x)
        for block in self.residual_blocks:
            x = block(x, condition)
        return self.upsample(self.self_attn_block(x))


class SkippedBlock(ResidualBlock):
    """A residual block with a 1 x 1 convolution as skip if its width changes."""

    def __init__(self, channels: int, out_channels: int, options: BlockOptions) -> None:
        super().__init__(channels, out_channels, options)
        self.skip = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        return (self.skip(x) + self.residual(self.norm1(x), condition)) * self.scale
