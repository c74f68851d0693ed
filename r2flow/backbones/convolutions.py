"""Pieces that the two U-Nets share: convolutions on a ring, resampling, residual and attention blocks."""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.backbones.encodings import ENCODINGS, RayEncoding, position_name
from r2flow.backbones.layers import ExactBuffers, ExactLinear, at_least_float32
from r2flow.errors import InputError

GROUPS = 8
EPS = 1e-6


class RingConv2d(nn.Conv2d):
    """3 x 3 convolution, circular in azimuth where the image is a ring, zeros beyond its other edges."""

    def __init__(self, in_channels: int, out_channels: int, ring: bool) -> None:
        super().__init__(in_channels, out_channels, 3, padding=(1, 0 if ring else 1))
        self.ring = ring

    def forward(self, x: Tensor) -> Tensor:
        return super().forward(F.pad(x, (1, 1, 0, 0), mode="circular") if self.ring else x)


class Resample(ExactBuffers):
    """Twice or half the resolution by a separable filter, circular in azimuth, zeros beyond the other edges.

    Down: every second value of the filtered image. Up: the filtered image of the pixels among zeros, the filter
    doubled so that its sum over either phase is 1.

    Args:
        window: Filter taps, normalised to sum 1; an even number.
        up: Whether to double rather than halve.
        ring: Whether the columns are a ring.
    """

    kernel: Tensor

    def __init__(self, window: Sequence[float], up: bool, ring: bool) -> None:
        super().__init__()
        taps = torch.tensor(window, dtype=torch.float32)
        self.register_buffer("kernel", taps / taps.sum() * (2 if up else 1))
        self.up, self.ring = up, ring
        self.margin = len(window) // 2 - 1  # taps that reach beyond a pixel's own pair

    def forward(self, x: Tensor) -> Tensor:
        channels, margin = x.shape[1], self.margin
        if self.ring and margin:
            x = F.pad(x, (margin, margin, 0, 0), mode="circular")
        kernel = torch.outer(self.kernel, self.kernel).to(x.dtype).expand(channels, 1, -1, -1)
        if self.up:
            crop = (margin, 3 * margin if self.ring else margin)
            return F.conv_transpose2d(x, kernel, stride=2, padding=crop, groups=channels)
        return F.conv2d(x, kernel, stride=2, padding=(margin, 0 if self.ring else margin), groups=channels)


class GroupNorm(nn.GroupNorm):
    """Group norm of 8 groups, computed in float32."""

    def __init__(self, channels: int, affine: bool = True) -> None:
        if channels % GROUPS:
            raise InputError(f"{channels} channels cannot be normed in {GROUPS} groups: make them a multiple of it.")
        super().__init__(GROUPS, channels, eps=EPS, affine=affine)

    def forward(self, x: Tensor) -> Tensor:
        wide = at_least_float32(x)
        weight, bias = (None if p is None else p.to(wide.dtype) for p in (self.weight, self.bias))
        return F.group_norm(wide, self.num_groups, weight, bias, self.eps).to(x.dtype)


class AdaGroupNorm(nn.Module):
    """norm(x) (1 + scale) + shift, with (scale, shift) = W silu(c) + b of a condition c."""

    def __init__(self, channels: int, condition_channels: int) -> None:
        super().__init__()
        self.norm = GroupNorm(channels, affine=False)
        self.proj = nn.Sequential(nn.SiLU(), ExactLinear(condition_channels, 2 * channels))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        scale, shift = self.proj(condition)[:, :, None, None].to(x.dtype).chunk(2, dim=1)
        return torch.addcmul(shift, self.norm(x), 1 + scale)


class SinusoidalTime(nn.Module):
    """sin(f_i t), then cos(f_i t), with f_i = 10^(-4 i / (C / 2 - 1)); t as it is, in [0, 1]."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.channels = channels

    def forward(self, t: Tensor) -> Tensor:
        half = self.channels // 2
        index = torch.arange(half, device=t.device, dtype=t.dtype)
        phase = t[:, None] * torch.exp(-math.log(1e4) / (half - 1) * index)
        return torch.cat([phase.sin(), phase.cos()], dim=1)


def time_embedding(channels: int, out_channels: int) -> nn.Sequential:
    """t (B,) to (B, out_channels): sinusoids, Linear, SiLU, Linear."""
    layers = ExactLinear(channels, out_channels), nn.SiLU(), ExactLinear(out_channels, out_channels)
    return nn.Sequential(SinusoidalTime(channels), *layers)


class ResidualBlock(nn.Module):
    """(x + f(x)) / sqrt 2, with f = conv silu AdaGN conv silu GN, its last convolution zero at the start."""

    scale: Tensor

    def __init__(self, channels: int, out_channels: int, condition_channels: int, ring: bool, dropout: float) -> None:
        super().__init__()
        self.register_buffer("scale", torch.tensor(0.5**0.5))
        self.norm1 = GroupNorm(channels)
        self.conv1 = RingConv2d(channels, out_channels, ring)
        self.norm2 = AdaGroupNorm(out_channels, condition_channels)
        self.dropout = nn.Dropout(dropout)
        self.conv2 = zero_convolution(RingConv2d(out_channels, out_channels, ring))

    def residual(self, x: Tensor, condition: Tensor) -> Tensor:
        """f of an x that `norm1` has normed."""
        x = self.norm2(self.conv1(F.silu(x)), condition)
        return self.conv2(self.dropout(F.silu(x)))


class SelfAttention(nn.Module):
    """(x + attention(GN x)) / sqrt 2 among all pixels, its projection zero at the start."""

    scale: Tensor

    def __init__(self, channels: int, heads: int) -> None:
        super().__init__()
        if channels % heads:
            raise InputError(f"{channels} channels cannot be shared by {heads} attention heads.")
        self.register_buffer("scale", torch.tensor(0.5**0.5))
        self.norm = GroupNorm(channels)
        self.attn = nn.MultiheadAttention(channels, heads, batch_first=True)
        nn.init.zeros_(self.attn.out_proj.weight)

    def forward(self, x: Tensor) -> Tensor:
        tokens = self.norm(x).flatten(2).mT
        attended, _ = self.attn(tokens, tokens, tokens, need_weights=False)
        return (x + attended.mT.unflatten(2, x.shape[2:])) * self.scale


def zero_convolution(layer: nn.Conv2d) -> nn.Conv2d:
    """The layer with zero weights and bias: a residual branch that starts as the identity."""
    nn.init.zeros_(layer.weight)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
    return layer


class UNet(Backbone):
    """A U-Net on the image beside features of its rays.

    Args:
        rays: See `Backbone`.
        in_channels: See `Backbone`.
        base_channels: Width of the first convolution and of the sinusoidal time features.
        levels: Resolutions, each half the one before.
        time_channels: Width of the time embedding; None for 4 x base_channels.
        position: Features beside the image: "fourier_features", "polar", "spherical_harmonics" or "none".
        ring: Whether the columns are a full turn.
    """

    features: Tensor

    def __init__(
        self,
        rays: Tensor,
        in_channels: int,
        base_channels: int,
        levels: int,
        time_channels: int | None,
        position: str | None,
        ring: bool,
    ) -> None:
        super().__init__(rays, in_channels, patch=(1, 1), levels=levels)
        name = position_name(position, "none")
        shape = rays.shape[1], rays.shape[2]
        self.coords_encoding: RayEncoding | None = None if name == "none" else ENCODINGS[name](shape)
        extra = self.coords_encoding.channels if self.coords_encoding else 0
        self.time_channels = time_channels or 4 * base_channels
        self.time_embedding = time_embedding(base_channels, self.time_channels)
        self.in_conv = RingConv2d(in_channels + extra, base_channels, ring)
        self.follow_rays()

    def follow_rays(self) -> None:
        """Compute again the features of the rays."""
        if self.coords_encoding is not None:
            self.register_buffer("features", self.coords_encoding(self.coords), persistent=False)

    def entrance(self, x: Tensor) -> Tensor:
        """The first convolution, on the image and its rays' features."""
        if self.coords_encoding is None:
            return self.in_conv(x)
        features = self.features.to(x.dtype).expand(len(x), -1, -1, -1)
        return self.in_conv(torch.cat([x, features], dim=1))
