"""The paper's U-Nets: ADM (Dhariwal and Nichol 2021) and Efficient (Saharia et al. 2022)."""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn

from r2flow.backbones.convolutions import (
    BlockOptions,
    GroupNorm,
    Resample,
    ResidualBlock,
    RingConv2d,
    SelfAttention,
    UNet,
)
from r2flow.backbones.layers import zero_initialised

AVERAGE, BINOMIAL = (1, 1), (1, 3, 3, 1)  # filters of resampling: ADM, Efficient


class ADMUNet(UNet):
    """ADM U-Net: each level has one more residual block in the decoder than in the encoder.

    Every output of the encoder, including the first convolution and resampling blocks, is a skip of a decoder block.
    The bottleneck also has attention. For the options see `UNet`.
    """

    def build_levels(self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions) -> None:
        """Build `down_blocks`, `mid_blocks`, `up_blocks` and the last norm and convolution."""
        deepest = self.levels - 1
        width, *widths = widths
        skips = [width]
        self.down_blocks = nn.ModuleList()
        for level, (out, count) in enumerate(zip(widths, counts, strict=True)):
            for _ in range(count):
                self.down_blocks.append(ADMBlock(width, out, options, heads=heads if level == deepest else None))
                width = out
                skips.append(width)
            if level != deepest:
                halve = Resample(AVERAGE, up=False, ring=options.ring)
                self.down_blocks.append(ADMBlock(width, width, options, halve))
                skips.append(width)
        self.mid_blocks = nn.ModuleList([ADMBlock(width, width, options, heads=heads), ADMBlock(width, width, options)])
        self.up_blocks = nn.ModuleList()
        for level in reversed(range(self.levels)):
            for index in range(counts[level] + 1):
                attention = heads if level == deepest else None
                step = nn.ModuleList([ADMBlock(width + skips.pop(), widths[level], options, heads=attention)])
                width = widths[level]
                if level > 0 and index == counts[level]:
                    double = Resample(AVERAGE, up=True, ring=options.ring)
                    step.append(ADMBlock(width, width, options, double))
                self.up_blocks.append(step)
        head = zero_initialised(RingConv2d(width, self.out_channels, options.ring))
        self.out_conv = nn.Sequential(GroupNorm(width, options.groups, options.eps), nn.SiLU(), head)

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.time_embedding, t, s)
        h = self.entrance(x)
        skips = [h]
        for block in self.down_blocks:
            h = block(h, condition)
            skips.append(h)
        for block in self.mid_blocks:
            h = block(h, condition)
        for first, *resampling in cast("Iterable[Iterable[ADMBlock]]", self.up_blocks):
            h = first(torch.cat([h, skips.pop()], dim=1), condition)
            for block in resampling:
                h = block(h, condition)
        return self.out_conv(h)


class ADMBlock(ResidualBlock):
    """A residual block with optional resampling of the normalised input and the skip, and optional attention."""

    def __init__(
        self,
        channels: int,
        out_channels: int,
        options: BlockOptions,
        resample: Resample | None = None,
        heads: int | None = None,
    ) -> None:
        super().__init__(channels, out_channels, options)
        self.resample = resample or nn.Identity()
        self.skip_conv = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)
        self.self_attn_block = nn.Identity() if heads is None else SelfAttention(out_channels, heads, options)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        residual = self.residual(self.resample(self.norm1(x)), condition)
        return self.self_attn_block((self.resample(self.skip_conv(x)) + residual) * self.scale)


class EfficientUNet(UNet):
    """Efficient U-Net as in R2DM, with equal numbers of residual blocks in encoder and decoder.

    For the options see `UNet`.
    """

    def build_levels(self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions) -> None:
        """Build `d_block1`, `u_block1`, `d_block2`, ... and the last convolution."""
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
            self.downsample = nn.Sequential(convolve, Resample(BINOMIAL, up=False, ring=options.ring))
            channels = out_channels
        inputs = [channels, *[out_channels] * (count - 1)]
        self.residual_blocks = nn.ModuleList([SkippedBlock(width, out_channels, options) for width in inputs])
        self.self_attn_block = nn.Identity() if heads is None else SelfAttention(out_channels, heads, options)
        self.upsample = nn.Sequential()
        if up:
            convolve = RingConv2d(out_channels, out_channels, options.ring)
            self.upsample = nn.Sequential(Resample(BINOMIAL, up=True, ring=options.ring), convolve)

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
