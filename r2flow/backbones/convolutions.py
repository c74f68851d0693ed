"""Common layers of the two U-Nets: convolutions on a ring, resampling, residual and attention blocks."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone, integers
from r2flow.backbones.encodings import ENCODINGS, RayEncoding, position_name
from r2flow.backbones.layers import ExactBuffers, ExactLinear, at_least_float32, shared, wrapped, zero_initialised
from r2flow.registry import Bound, Count, Portion, Positive

GROUPS = 8
EPS = 1e-6
TimeChannels = Annotated[int, Bound("of at least 4 that is even", lambda n: n >= 4 and n % 2 == 0)]


class RingConv2d(nn.Conv2d):
    """3 x 3 convolution with circular padding in azimuth on a ring, zero padding at other edges."""

    def __init__(self, in_channels: int, out_channels: int, ring: bool) -> None:
        super().__init__(in_channels, out_channels, 3, padding=(1, 0 if ring else 1))
        self.ring = ring

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(wrapped(x, 1, 1) if self.ring else x)

    def open_ring(self) -> None:
        self.ring, self.padding = False, (1, 1)


class Resample(ExactBuffers):
    """Resample by a factor of 2 with a separable filter; circular padding in azimuth, else zeros or replication.

    Down: every second value of the filtered image. Up: the filtered image of the pixels interleaved with zeros, with
    the filter doubled so that its sum over either phase is 1. The number of filter taps is even.
    """

    kernel: Tensor

    def __init__(self, window: Sequence[float], up: bool, ring: bool, repeat: bool = False) -> None:
        super().__init__()
        taps = torch.tensor(window, dtype=torch.float32)
        self.register_buffer("kernel", taps / taps.sum() * (2 if up else 1))
        self.up, self.ring, self.repeat = up, ring, repeat
        self.margin = len(window) // 2 - 1  # taps beyond the pair of pixels

    def forward(self, x: Tensor) -> Tensor:
        channels, margin = x.shape[1], self.margin
        rows, columns = self.repeat, self.ring or self.repeat  # whether they are padded explicitly
        if columns and margin:
            x = wrapped(x, margin, margin) if self.ring else F.pad(x, (margin, margin, 0, 0), mode="replicate")
        if rows and margin:
            x = F.pad(x, (0, 0, margin, margin), mode="replicate")
        kernel = torch.outer(self.kernel, self.kernel).to(x.dtype).expand(channels, 1, -1, -1)
        if self.up:
            crop = (3 * margin if rows else margin, 3 * margin if columns else margin)
            return F.conv_transpose2d(x, kernel, stride=2, padding=crop, groups=channels)
        zeros = (0 if rows else margin, 0 if columns else margin)
        return F.conv2d(x, kernel, stride=2, padding=zeros, groups=channels)

    def open_ring(self) -> None:
        self.ring = False

    def macs(self, inputs: tuple[Tensor, ...], output: Tensor) -> int:
        return output.numel() * self.kernel.numel() ** 2


class GroupNorm(nn.GroupNorm):
    """Group norm computed in float32."""

    def __init__(self, channels: int, groups: int, eps: float = EPS, affine: bool = True) -> None:
        shared(channels, groups, f"{groups} groups")
        super().__init__(groups, channels, eps=eps, affine=affine)

    def forward(self, x: Tensor) -> Tensor:
        wide = at_least_float32(x)
        weight, bias = (None if p is None else p.to(wide.dtype) for p in (self.weight, self.bias))
        return F.group_norm(wide, self.num_groups, weight, bias, self.eps).to(x.dtype)


class AdaGroupNorm(nn.Module):
    """norm(x) (1 + scale) + shift, with (scale, shift) = W silu(c) + b of a condition c."""

    def __init__(self, channels: int, options: "BlockOptions") -> None:
        super().__init__()
        self.norm = GroupNorm(channels, options.groups, options.eps, affine=False)
        self.proj = nn.Sequential(nn.SiLU(), ExactLinear(options.condition_channels, 2 * channels))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.proj(condition)[:, :, None, None].to(x.dtype).chunk(2, dim=1)
        return torch.addcmul(shift, self.norm(x), 1 + scale)


class SinusoidalTime(nn.Module):
    """sin(f_i t), then cos(f_i t), with f_i = 10^(-4 i / (C / 2 - 1)); t is not scaled: a flow's time or a log-SNR."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def forward(self, t: Tensor) -> Tensor:
        half = self.channels // 2
        index = torch.arange(half, device=t.device, dtype=t.dtype)
        phase = t[:, None] * torch.exp(-math.log(1e4) / (half - 1) * index)
        return torch.cat([phase.sin(), phase.cos()], dim=1)


def time_embedding(channels: int, out_channels: int, bias: bool = True) -> nn.Sequential:
    """t (B,) to (B, out_channels): sinusoids, Linear, SiLU, Linear; `bias` is that of the last layer."""
    layers = ExactLinear(channels, out_channels), nn.SiLU(), ExactLinear(out_channels, out_channels, bias=bias)
    return nn.Sequential(SinusoidalTime(channels), *layers)


@dataclass(frozen=True)
class BlockOptions:
    condition_channels: int
    ring: bool
    dropout: float
    groups: int
    eps: float


class ResidualBlock(nn.Module):
    """(x + f(x)) / sqrt 2, with f = conv silu AdaGN conv silu GN; the last convolution is initialised to zero."""

    scale: Tensor

    def __init__(self, channels: int, out_channels: int, options: BlockOptions) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(0.5**0.5))
        self.norm1 = GroupNorm(channels, options.groups, options.eps)
        self.conv1 = RingConv2d(channels, out_channels, options.ring)
        self.norm2 = AdaGroupNorm(out_channels, options)
        self.dropout = nn.Dropout(options.dropout)
        self.conv2 = zero_initialised(RingConv2d(out_channels, out_channels, options.ring))

    def residual(self, x: Tensor, condition: Tensor) -> Tensor:
        """f(x) after `norm1`."""
        x = self.norm2(self.conv1(F.silu(x)), condition)
        return self.conv2(self.dropout(F.silu(x)))


class SelfAttention(nn.Module):
    """(x + attention(GN x)) / sqrt 2 over all pixels; the projection is initialised to zero."""

    scale: Tensor

    def __init__(self, channels: int, heads: int, options: BlockOptions) -> None:
        super().__init__()
        shared(channels, heads, f"{heads} attention heads")
        self.register_buffer("scale", torch.tensor(0.5**0.5))
        self.norm = GroupNorm(channels, options.groups, options.eps)
        self.attn = nn.MultiheadAttention(channels, heads, batch_first=True)
        nn.init.zeros_(self.attn.out_proj.weight)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.norm(x).flatten(2).mT
        attended, _ = self.attn(tokens, tokens, tokens, need_weights=False)
        return (x + attended.mT.unflatten(2, x.shape[2:])) * self.scale


class UNet(Backbone, ABC):
    """U-Net on the image concatenated with features of its rays.

    Parameters have the names of the published weights.

    Args:
        base_channels: Width of the first convolution, unless `multiplied`, and of the sinusoidal time features.
        channel_multiplier: Width of each level over base_channels.
        num_residual_blocks: Residual blocks of each level, or one number for all levels.
        num_heads: Heads of self-attention, which is at the deepest level only.
        time_channels: Width of the time embedding; None: 4 x base_channels.
        position: Features of the rays: "fourier_features", "polar", "spherical_harmonics" or "none".
        ring: Whether the columns are a full turn.
        dropout: Dropout rate of activations in training.
        groups: Number of groups of group norms; every width is a multiple of it.
    """

    takes_second_time = True
    croppable = True
    multiplied = False  # whether the first convolution has the width of the first level, as the published ADM U-Net's
    features: Tensor

    def __init__(
        self,
        rays: Tensor,
        base_channels: TimeChannels = 64,
        channel_multiplier: Sequence[int] = (1, 2, 4, 8),
        num_residual_blocks: int | Sequence[int] = (3, 3, 3, 3),
        num_heads: Count = 8,
        time_channels: Count | None = None,
        position: str | None = "fourier_features",
        ring: bool = True,
        dropout: Portion = 0.0,
        groups: Count = GROUPS,
        eps: Positive = EPS,
        **common: Any,
    ) -> None:
        levels = max(len(channel_multiplier), 1)
        multipliers = integers("channel_multiplier", channel_multiplier, levels)
        counts = integers("num_residual_blocks", num_residual_blocks, levels)
        super().__init__(rays, (2 ** (levels - 1), 2 ** (levels - 1)), **common)
        self.levels = levels
        name = position_name(position, "none")
        shape = rays.shape[1], rays.shape[2]
        self.coords_encoding: RayEncoding | None = None if name == "none" else ENCODINGS[name](shape)
        extra = self.coords_encoding.channels if self.coords_encoding else 0
        width = time_channels or 4 * base_channels
        self.time_embedding = time_embedding(base_channels, width)
        widths = [base_channels * n for n in (multipliers[0] if self.multiplied else 1, *multipliers)]
        self.in_conv = RingConv2d(self.in_channels + extra, widths[0], ring)
        self.build_levels(widths, counts, num_heads, BlockOptions(width, ring, dropout, groups, eps))
        if self.second_time:
            self.interval_embedding = time_embedding(base_channels, width, bias=False)
            zero_initialised(self.interval_embedding[-1])
        self.follow_rays()

    @abstractmethod
    def build_levels(self, widths: Sequence[int], counts: Sequence[int], heads: int, options: BlockOptions) -> None:
        """Build all layers after the first convolution, whose output has widths[0]; a level has the next width."""

    def follow_rays(self) -> None:
        if self.coords_encoding is not None:
            self.register_buffer("features", self.coords_encoding(self.coords), persistent=False)

    def entrance(self, x: Tensor) -> Tensor:
        """The first convolution, on the image and the features of its rays."""
        if self.coords_encoding is None:
            return self.in_conv(x)
        return self.in_conv(torch.cat([x, self.features.to(x.dtype).expand(x.shape[0], -1, -1, -1)], dim=1))
