"""ADM U-Net: residual blocks that resample, and a skip from each of them (Dhariwal and Nichol 2021)."""

from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn

from r2flow.backbones.base import integers
from r2flow.backbones.convolutions import (
    GroupNorm,
    Resample,
    ResidualBlock,
    RingConv2d,
    SelfAttention,
    UNet,
    zero_convolution,
)

FILTER = (1, 1)


class ADMUNet(UNet):
    """Velocity v(t, x) by an ADM U-Net; parameters carry the published weights' names.

    Every output on the way down, of the first convolution and of the resampling blocks too, is a skip; each
    block on the way up takes one.

    Args:
        rays: Elevation and azimuth of every pixel in radians, (2, H, W).
        in_channels: Channels C of the image.
        base_channels: Width of the outermost level.
        channel_multiplier: Width of each level over base_channels.
        num_residual_blocks: Residual blocks of each level on the way down; on the way up it is one more.
        num_heads: Heads of the self-attention at the deepest level and in the middle.
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
        deepest = levels - 1

        def block(channels: int, out_channels: int, **options: Any) -> ADMBlock:
            return ADMBlock(channels, out_channels, self.time_channels, ring, dropout, **options)

        width, skips = base_channels, [base_channels]
        self.down_blocks = nn.ModuleList()
        for level, (out, count) in enumerate(zip(widths, counts, strict=True)):
            heads = num_heads if level == deepest else None
            for _ in range(count):
                self.down_blocks.append(block(width, out, heads=heads))
                width = out
                skips.append(width)
            if level != deepest:
                self.down_blocks.append(block(width, width, resample=Resample(FILTER, up=False, ring=ring)))
                skips.append(width)
        self.mid_blocks = nn.ModuleList([block(width, width, heads=num_heads), block(width, width)])
        self.up_blocks = nn.ModuleList()
        for level in reversed(range(levels)):
            heads = num_heads if level == deepest else None
            for index in range(counts[level] + 1):
                step = nn.ModuleList([block(width + skips.pop(), widths[level], heads=heads)])
                width = widths[level]
                if level > 0 and index == counts[level]:
                    step.append(block(width, width, resample=Resample(FILTER, up=True, ring=ring)))
                self.up_blocks.append(step)
        head = zero_convolution(RingConv2d(width, in_channels, ring))
        self.out_conv = nn.Sequential(GroupNorm(width), nn.SiLU(), head)

    def velocity(self, t: Tensor, x: Tensor) -> Tensor:
        condition = self.time_embedding(t)
        h = self.entrance(x)
        skips = [h]
        for block in self.down_blocks:
            h = block(h, condition)
            skips.append(h)
        for block in self.mid_blocks:
            h = block(h, condition)
        for first, *resampling in cast(Iterable[Iterable[ADMBlock]], self.up_blocks):
            h = first(torch.cat([h, skips.pop()], dim=1), condition)
            for block in resampling:
                h = block(h, condition)
        return self.out_conv(h)


class ADMBlock(ResidualBlock):
    """A residual block that may resample after its first norm, and attend last.

    Args:
        channels: Width that comes in.
        out_channels: Width that goes out.
        condition_channels: Width of the time embedding.
        ring: Whether the columns are a ring.
        dropout: See `ADMUNet`.
        resample: Applied to the normed input and to the skip alike.
        heads: Attention heads; None for no attention.
    """

    def __init__(
        self,
        channels: int,
        out_channels: int,
        condition_channels: int,
        ring: bool,
        dropout: float,
        resample: Resample | None = None,
        heads: int | None = None,
    ) -> None:
        super().__init__(channels, out_channels, condition_channels, ring, dropout)
        self.resample = resample or nn.Identity()
        self.skip_conv = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)
        self.self_attn_block = nn.Identity() if heads is None else SelfAttention(out_channels, heads)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        residual = self.residual(self.resample(self.norm1(x)), condition)
        return self.self_attn_block((self.resample(self.skip_conv(x)) + residual) * self.scale)
