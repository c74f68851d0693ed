"""Pieces that the backbones share: float32 islands, norms, time embeddings, circular convolutions."""

import math
from collections.abc import Callable
from typing import Any, Self

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def at_least_float32(x: Tensor) -> Tensor:
    """x in float32, or in its own type where that is wider."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


class ExactBuffers(nn.Module):
    """A module whose own buffers move between devices but never change type.

    Rays, frequencies and the tables made of them are angles up to several hundred radians: `.half()` would
    move them by whole radians. Autocast does not touch buffers, and this keeps `.half()` and its like off.
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        before = dict(self._buffers)
        super()._apply(fn, recurse)
        for name, buffer in before.items():
            moved = self._buffers[name]
            if buffer is not None and moved is not None and moved.dtype != buffer.dtype:
                self._buffers[name] = buffer.to(moved.device)
        return self


class ExactLinear(nn.Linear):
    """A linear layer computed in float32 whatever autocast does; for the few numbers that steer all others."""

    def forward(self, x: Tensor) -> Tensor:
        weight, bias = at_least_float32(self.weight), self.bias
        with torch.autocast(x.device.type, enabled=False):
            return F.linear(x.to(weight.dtype), weight, None if bias is None else bias.to(weight.dtype))


def zero_initialised(layer: nn.Linear) -> nn.Linear:
    """The layer with zero weights: a residual branch that starts as the identity."""
    nn.init.zeros_(layer.weight)
    return layer


def rms_norm(x: Tensor, scale: Tensor, eps: float = 1e-6) -> Tensor:
    """x / sqrt(mean_c x^2 + eps) * scale over the last dimension, computed in float32."""
    wide = at_least_float32(x)
    return (wide * torch.rsqrt(wide.square().mean(-1, keepdim=True) + eps) * scale).to(x.dtype)


class RMSNorm(nn.Module):
    """`rms_norm` with a learned scale per channel."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        return rms_norm(x, self.scale)


class AdaRMSNorm(nn.Module):
    """rms_norm(x) (1 + W c): the condition c sets the scale, and W = 0 at the start."""

    def __init__(self, channels: int, condition_channels: int) -> None:
        super().__init__()
        # a Sequential of one, because the published weights are named `proj.0`
        self.proj = nn.Sequential(zero_initialised(ExactLinear(condition_channels, channels, bias=False)))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """x (B, H, W, C) normed under a condition (B, K), or (1, K) for the whole batch."""
        return rms_norm(x, 1 + self.proj(condition)[:, None, None, :])


class GEGLU(nn.Module):
    """h gelu(g) with (h, g) the two halves of one projection, and gelu the exact one (erf)."""

    def forward(self, x: Tensor) -> Tensor:
        h, gate = x.chunk(2, dim=-1)
        return h * F.gelu(gate)


class RandomFourierFeatures(ExactBuffers):
    """W [cos(2 pi f t), sin(2 pi f t)] with fixed frequencies f ~ N(0, 1).

    Args:
        channels: Width of the embedding; half as many frequencies.
    """

    freqs: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("freqs", torch.randn(channels // 2))
        self.linear = ExactLinear(channels // 2 * 2, channels, bias=False)

    def forward(self, t: Tensor) -> Tensor:
        """t (B,) to (B, channels)."""
        phase = 2 * math.pi * at_least_float32(t)[:, None] * self.freqs
        return self.linear(torch.cat([phase.cos(), phase.sin()], dim=-1))


class MappingLayer(nn.Module):
    """x + W_2 GEGLU(W_1 rms_norm(x)), three times as wide inside."""

    def __init__(self, channels: int, linear: type[nn.Linear], dropout: float) -> None:
        super().__init__()
        self.norm = RMSNorm(channels)
        self.gegelu = linear(channels, 2 * 3 * channels, bias=False)
        self.glu = GEGLU()
        self.dropout = nn.Dropout(dropout)
        self.linear = linear(3 * channels, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.linear(self.dropout(self.glu(self.gegelu(self.norm(x)))))


def mapping_network(
    channels: int, layers: int = 2, linear: type[nn.Linear] = ExactLinear, dropout: float = 0.0
) -> nn.Sequential:
    """RMSNorm, residual GEGLU layers, RMSNorm: what HDiT puts between an embedding and its use."""
    middle = [MappingLayer(channels, linear, dropout) for _ in range(layers)]
    return nn.Sequential(RMSNorm(channels), *middle, RMSNorm(channels))


def times(t: Tensor | float, x: Tensor) -> Tensor:
    """t as (B,), or as (1,) where one time holds for the whole batch; at least float32, on x's device.

    Raises:
        ValueError: t is neither a scalar nor one time for each image of x.
    """
    t = torch.as_tensor(t, device=x.device)
    if t.ndim > 1 or t.numel() not in (1, len(x)):
        raise ValueError(f"t must be a scalar or of shape ({len(x)},), found {tuple(t.shape)}.")
    return at_least_float32(t).reshape(-1)


def pair(value: Any) -> tuple[int, int]:
    """Two integers from a sequence, which YAML delivers as a list."""
    first, second = value
    return int(first), int(second)
