"""ADM U-Net: resampling residual blocks with a skip from each block (Dhariwal and Nichol 2021)."""

from collections.abc import Iterable, Sequence
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

FILTER = (1, 1)


class ADMUNet(UNet):
    """ADM U-Net: each level has one more residual block in the decoder than in the encoder.

    Every output of the encoder, including the first convolution and resampling blocks, is a skip of a decoder block.
    The bottleneck also has attention. For the options see `UNet`.
    """

    multiplied = True

    def build_levels(self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions) -> None:
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
                self.down_blocks.append(ADMBlock(width, width, options, Resample(FILTER, up=False, ring=options.ring)))
                skips.append(width)
        self.mid_blocks = nn.ModuleList([ADMBlock(width, width, options, heads=heads), ADMBlock(width, width, options)])
        self.up_blocks = nn.ModuleList()
        for level in reversed(range(self.levels)):
            for index in range(counts[level] + 1):
                attention = heads if level == deepest else None
                step = nn.ModuleList([ADMBlock(width + skips.pop(), widths[level], options, heads=attention)])
                width = widths[level]
                if level > 0 and index == counts[level]:
                    step.append(ADMBlock(width, width, options, Resample(FILTER, up=True, ring=options.ring)))
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
