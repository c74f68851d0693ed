"""Common layers of the two U-Nets: convolutions on a ring, resampling, residual and attention."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.backbones.encodings import ENCODINGS, RayEncoding, position_name
from r2flow.backbones.layers import (
    ExactBuffers,
    ExactLinear,
    at_least_float32,
    wrapped,
    zero_initialised,
)
from r2flow.base.errors import InputError
from r2flow.base.registry import Bound, Count, Counts, Portion, Positive

TimeChannels = Annotated[int, Bound("even and at least 4", lambda n: n >= 4 and n % 2 == 0)]


class RingConv2d(nn.Conv2d):
    """3 x 3 convolution with circular padding in azimuth on a ring, zero padding at other edges."""

    def __init__(self, in_channels: int, out_channels: int, ring: bool) -> None:
        super().__init__(in_channels, out_channels, 3, padding=(1, 0 if ring else 1))
        self.ring = ring

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(wrapped(x, 1, 1) if self.ring else x)


class Resample(ExactBuffers):
    """Resample by a factor of 2 with a separable filter.

    Down: every second value of the filtered image. Up: the filtered image of the pixels interleaved
    with zeros, with the filter doubled so that its sum over either phase is 1. The filter has an
    even number of taps.

    Args:
        window: Taps of the filter, not normalised.
        ring: Circular padding in azimuth.
        repeat: Replicate the edge rows; else zeros.
    """

    def __init__(self, window: Sequence[float], up: bool, ring: bool, repeat: bool = False) -> None:
        super().__init__()
        taps = torch.tensor(window, dtype=torch.float32)
        self.kernel = nn.Buffer(taps / taps.sum() * (2 if up else 1))
        self.up = up
        self.ring = ring
        self.repeat = repeat
        self.margin = len(window) // 2 - 1  # taps beyond the pair of pixels

    def forward(self, x: Tensor) -> Tensor:
        channels = x.shape[1]
        margin = self.margin
        rows = columns = margin  # zeros that the convolution has to add
        if self.ring:
            columns = 0
            x = wrapped(x, margin, margin) if margin else x
        if self.repeat:
            x = F.pad(x, (0, 0, margin, margin), mode="replicate")
            rows = 0
        kernel = torch.outer(self.kernel, self.kernel).to(x.dtype).expand(channels, 1, -1, -1)
        if self.up:
            crop = (3 * margin - 2 * rows, 3 * margin - 2 * columns)
            return F.conv_transpose2d(x, kernel, stride=2, padding=crop, groups=channels)
        return F.conv2d(x, kernel, stride=2, padding=(rows, columns), groups=channels)

    def macs(self, inputs: tuple[Tensor, ...], output: Tensor) -> int:
        return output.numel() * self.kernel.numel() ** 2


class GroupNorm(nn.GroupNorm):
    """Group norm computed in float32."""

    def forward(self, x: Tensor) -> Tensor:
        wide = at_least_float32(x)
        weight, bias = (p if p is None else p.to(wide.dtype) for p in (self.weight, self.bias))
        return F.group_norm(wide, self.num_groups, weight, bias, self.eps).to(x.dtype)


@dataclass(frozen=True)
class BlockOptions:
    condition_channels: int
    ring: bool
    dropout: float
    groups: int
    eps: float

    def norm(self, channels: int, affine: bool = True) -> GroupNorm:
        return GroupNorm(self.groups, channels, self.eps, affine)


class _AdaGroupNorm(nn.Module):
    """norm(x) (1 + scale) + shift, with (scale, shift) = W silu(c) + b of a condition c."""

    def __init__(self, channels: int, options: BlockOptions) -> None:
        super().__init__()
        self.norm = options.norm(channels, affine=False)
        self.proj = nn.Sequential(nn.SiLU(), ExactLinear(options.condition_channels, 2 * channels))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.proj(condition)[:, :, None, None].to(x.dtype).chunk(2, dim=1)
        return torch.addcmul(shift, self.norm(x), 1 + scale)


class _SinusoidalTime(nn.Module):
    """sin(f_i t), then cos(f_i t), with f_i = 10^(-4 i / (C / 2 - 1)).

    t is not scaled: a flow's time or a log-SNR.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def forward(self, t: Tensor) -> Tensor:
        half = self.channels // 2
        index = torch.arange(half, device=t.device, dtype=t.dtype)
        phase = t[:, None] * torch.exp(-math.log(1e4) / (half - 1) * index)
        return torch.cat([phase.sin(), phase.cos()], dim=1)


def time_embedding(channels: int, out_channels: int, bias: bool = True) -> nn.Sequential:
    """t (B,) to (B, out_channels): sinusoids, Linear, SiLU, Linear; `bias` is that of the last."""
    return nn.Sequential(
        _SinusoidalTime(channels),
        ExactLinear(channels, out_channels),
        nn.SiLU(),
        ExactLinear(out_channels, out_channels, bias=bias),
    )


class ResidualBlock(nn.Module):
    """(x + f(x)) / sqrt 2, with f = conv silu AdaGN conv silu GN; its last convolution is zero
    first.
    """

    def __init__(self, channels: int, out_channels: int, options: BlockOptions) -> None:
        super().__init__()
        self.scale = nn.Buffer(torch.tensor(0.5**0.5))
        self.norm1 = options.norm(channels)
        self.conv1 = RingConv2d(channels, out_channels, options.ring)
        self.norm2 = _AdaGroupNorm(out_channels, options)
        self.dropout = nn.Dropout(options.dropout)
        self.conv2 = zero_initialised(RingConv2d(out_channels, out_channels, options.ring))

    def residual(self, x: Tensor, condition: Tensor) -> Tensor:
        """f(x) after `norm1`."""
        x = self.norm2(self.conv1(F.silu(x)), condition)
        return self.conv2(self.dropout(F.silu(x)))


def projection(channels: int, out_channels: int) -> nn.Module:
    """The skip of a residual block: a 1 x 1 convolution if the width changes."""
    if channels == out_channels:
        return nn.Identity()
    return nn.Conv2d(channels, out_channels, 1)


class SelfAttention(nn.Module):
    """(x + attention(GN x)) / sqrt 2 over all pixels; the projection is initialised to zero."""

    def __init__(self, channels: int, heads: int, options: BlockOptions) -> None:
        super().__init__()
        self.scale = nn.Buffer(torch.tensor(0.5**0.5))
        self.norm = options.norm(channels)
        self.attn = nn.MultiheadAttention(channels, heads, batch_first=True)
        nn.init.zeros_(self.attn.out_proj.weight)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.norm(x).flatten(2).mT
        attended, _ = self.attn(tokens, tokens, tokens, need_weights=False)
        return (x + attended.mT.view_as(x)) * self.scale


class UNet(Backbone, ABC):
    """U-Net on the image concatenated with features of its rays.

    Parameters have the names of the published weights.

    Args:
        base_channels: Width of the first convolution, unless `multiplied`, and of the sinusoids of
            t.
        channel_multiplier: Width of each level over base_channels.
        num_residual_blocks: Residual blocks of each level, or one number for all levels.
        num_heads: Heads of self-attention, which is at the deepest level only.
        time_channels: Width of the time embedding; None: 4 x base_channels.
        position: Features of the rays: "fourier_features", "polar", "spherical_harmonics" or
            "none".
        ring: Whether the columns are a full turn.
        dropout: Dropout rate of activations in training.
        groups: Number of groups of group norms; every width is a multiple of it.
    """

    takes_second_time = True
    # Whether the first convolution has the first level's width, as in the published ADM U-Net.
    multiplied = False

    def __init__(
        self,
        rays: Tensor,
        base_channels: TimeChannels = 64,
        channel_multiplier: Counts = (1, 2, 4, 8),
        num_residual_blocks: Count | Counts = (3, 3, 3, 3),
        num_heads: Count = 8,
        time_channels: Count | None = None,
        position: str | None = "fourier_features",
        ring: bool = True,
        dropout: Portion = 0.0,
        groups: Count = 8,
        eps: Positive = 1e-6,
        **common: Any,
    ) -> None:
        levels = len(channel_multiplier)
        counts = num_residual_blocks
        if isinstance(counts, int):
            counts = [counts] * levels
        if len(counts) != levels:
            raise InputError(
                f"num_residual_blocks must be of {levels} levels, as channel_multiplier, found "
                f"{counts}."
            )
        unit = 2 ** (levels - 1)
        super().__init__(rays, (unit, unit), **common)
        self.levels = levels
        name = position_name(position, "none")
        self.coords_encoding: RayEncoding | None = None
        inputs = self.in_channels
        if name != "none":
            self.coords_encoding = ENCODINGS[name](rays.shape[1:])  # type: ignore[arg-type]
            inputs += self.coords_encoding.channels
        width = time_channels or 4 * base_channels
        self.time_embedding = time_embedding(base_channels, width)
        first = channel_multiplier[0] if self.multiplied else 1
        widths = [base_channels * n for n in (first, *channel_multiplier)]
        self.in_conv = RingConv2d(inputs, widths[0], ring)
        self.build_levels(
            widths, counts, num_heads, BlockOptions(width, ring, dropout, groups, eps)
        )
        if self.second_time:
            self.interval_embedding = time_embedding(base_channels, width, bias=False)
            zero_initialised(self.interval_embedding[-1])
        self.follow_rays()

    @abstractmethod
    def build_levels(
        self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions
    ) -> None:
        """Build all layers after the first convolution.

        Its output has widths[0]; each level has the next width.
        """

    def follow_rays(self) -> None:
        if self.coords_encoding is not None:
            self.register_buffer("features", self.coords_encoding(self.coords), persistent=False)

    def entrance(self, x: Tensor) -> Tensor:
        """The first convolution, on the image and the features of its rays."""
        if self.coords_encoding is not None:
            features = self.get_buffer("features").to(x.dtype)
            x = torch.cat([x, features.expand(x.shape[0], -1, -1, -1)], dim=1)
        return self.in_conv(x)
