"""ADM U-Net: resampling residual blocks with a skip from each block (Dhariwal and Nichol 2021)."""

from collections.abc import Sequence

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


class ADMUNet(UNet):
    """ADM U-Net: each level has one more residual block in the decoder than in the encoder.

    Every output of the encoder, including the first convolution and resampling blocks, is a skip of
    a decoder block. The bottleneck also has attention. For the options see `UNet`.
    """

    multiplied = True

    def build_levels(
        self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions
    ) -> None:
        deepest = self.levels - 1
        width = widths[0]
        skips = [width]
        self.down_blocks = nn.ModuleList()
        for level, count in enumerate(counts):
            attention = heads if level == deepest else 0
            for _ in range(count):
                block = _ADMBlock(width, widths[level + 1], options, attention)
                self.down_blocks.append(block)
                width = widths[level + 1]
                skips.append(width)
            if level != deepest:
                self.down_blocks.append(_resampling(width, options, up=False))
                skips.append(width)
        self.mid_blocks = nn.ModuleList(
            [_ADMBlock(width, width, options, heads), _ADMBlock(width, width, options)]
        )
        self.up_blocks = nn.ModuleList()
        for level in reversed(range(self.levels)):
            attention = heads if level == deepest else 0
            for _ in range(counts[level] + 1):
                block = _ADMBlock(width + skips.pop(), widths[level + 1], options, attention)
                self.up_blocks.append(nn.ModuleList([block]))
                width = widths[level + 1]
            if level:
                self.up_blocks[-1].append(  # type: ignore[operator]
                    _resampling(width, options, up=True)
                )
        self.out_conv = nn.Sequential(
            options.norm(width),
            nn.SiLU(),
            zero_initialised(RingConv2d(width, self.out_channels, options.ring)),
        )

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        condition = self.condition(self.time_embedding, t, s)
        h = self.entrance(x)
        skips = [h]
        for block in self.down_blocks:
            h = block(h, condition)
            skips.append(h)
        for block in self.mid_blocks:
            h = block(h, condition)
        for step in self.up_blocks:
            h = torch.cat([h, skips.pop()], dim=1)
            for block in step:  # type: ignore[attr-defined]
                h = block(h, condition)
        return self.out_conv(h)


class _ADMBlock(ResidualBlock):
    """A residual block with optional resampling of the normalised input and the skip, and
    attention.

    Args:
        heads: Heads of attention; 0: none.
        resample: None: the size stays.
    """

    def __init__(
        self,
        channels: int,
        out_channels: int,
        options: BlockOptions,
        heads: int = 0,
        resample: Resample | None = None,
    ) -> None:
        super().__init__(channels, out_channels, options)
        self.resample = resample or nn.Identity()
        self.skip_conv = projection(channels, out_channels)
        self.self_attn_block = (
            SelfAttention(out_channels, heads, options) if heads else nn.Identity()
        )

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        residual = self.residual(self.resample(self.norm1(x)), condition)
        return self.self_attn_block((self.resample(self.skip_conv(x)) + residual) * self.scale)


def _resampling(width: int, options: BlockOptions, up: bool) -> _ADMBlock:
    return _ADMBlock(width, width, options, resample=Resample((1, 1), up, options.ring))
