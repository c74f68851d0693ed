"""Blocks of HDiT: attention by cosines of rotated queries and keys, and feed-forward layers."""

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.attention import neighbourhood_attention
from r2flow.backbones.encodings import Rotary, rotate
from r2flow.backbones.layers import (
    AdaRMSNorm,
    at_least_float32,
    geglu,
    in_bands,
    unshuffle,
    zero_initialised,
)
from r2flow.base.errors import InputError
from r2flow.base.registry import Size


class Neighbourhood(NamedTuple):
    window: Size
    ring: bool
    backend: str


class BlockOptions(NamedTuple):
    channels: int
    heads: int
    condition_channels: int
    highest: Size  # harmonics of the rotation in elevation and azimuth
    neighbourhood: Neighbourhood | None  # window of attention; None: all tokens
    dropout: float


class Block(nn.Module):
    """x + attention(x), then x + feed-forward(x), both with norms that depend on the condition."""

    def __init__(self, options: BlockOptions) -> None:
        super().__init__()
        self.residual_attn = Attention(options)
        self.residual_ffn = _FeedForward(options)

    def forward(self, x: Tensor, condition: Tensor, table: Tensor) -> Tensor:
        """x (B, H, W, C), condition (B or 1, K), table of `Rotary`."""
        x = x + self.residual_attn(x, condition, table)
        return in_bands(lambda x: (x + self.residual_ffn(x, condition),), x)[0]


class Attention(nn.Module):
    """Cosine attention: logits s (q / |q|) . (k / |k|), rotated, with a learned s <= 100."""

    def __init__(self, options: BlockOptions) -> None:
        super().__init__()
        channels = options.channels
        heads = options.heads
        if channels % (4 * heads):
            raise InputError(
                f"{channels} channels cannot be shared by {heads} heads with their rotation: give "
                f"a multiple of {4 * heads}."
            )
        self.heads = heads
        self.neighbourhood = options.neighbourhood
        self.scale = nn.Parameter(torch.full((heads, 1), math.log(10.0)))
        self.norm = AdaRMSNorm(channels, options.condition_channels)
        self.qkv_proj = nn.Linear(channels, 3 * channels, bias=False)
        self.rope = Rotary(heads, channels // heads, options.highest)
        self.dropout = nn.Dropout(options.dropout)
        self.out_proj = zero_initialised(nn.Linear(channels, channels, bias=False))

    def forward(self, x: Tensor, condition: Tensor, table: Tensor) -> Tensor:
        q, k, v = in_bands(lambda x, table: self._project(x, condition, table), x, table)
        if self.neighbourhood is None:
            q, k, v = (part.flatten(1, 2).transpose(1, 2) for part in (q, k, v))
            attended = F.scaled_dot_product_attention(q, k, v, scale=1.0)
            out = attended.transpose(1, 2).unflatten(1, x.shape[1:3])
        else:
            out = neighbourhood_attention(q, k, v, *self.neighbourhood)
        return self.out_proj(self.dropout(out.flatten(-2)))

    def macs(self, inputs: tuple[Tensor, ...], output: Tensor) -> int:
        """Both products of neighbourhood attention, with half a window beyond both ends of the
        ring.
        """
        if self.neighbourhood is None:
            return 0
        rows, columns = self.neighbourhood.window
        width = output.shape[2]
        padded = width + columns - 1 if self.neighbourhood.ring else width
        return 2 * output.numel() // width * padded * rows * columns

    def _project(self, x: Tensor, condition: Tensor, table: Tensor) -> tuple[Tensor, ...]:
        """q, k and v, each (B, H, W, N, D), q and k of length sqrt(s) and rotated."""
        qkv = self.qkv_proj(self.norm(x, condition)).unflatten(-1, (3, self.heads, -1))
        qk = at_least_float32(qkv[..., :2, :, :])  # s would amplify the rounding of q and k
        v = qkv[..., 2, :, :]
        scale = at_least_float32(self.scale).clamp(max=math.log(100.0)).exp().sqrt()
        # q / max(|q|, 1e-6)
        qk = qk * (scale * qk.square().sum(-1, keepdim=True).clamp(min=1e-12).rsqrt())
        return *rotate(qk, table).to(v.dtype).unbind(-3), v


class _FeedForward(nn.Module):
    """W_2 GEGLU(W_1 ada_rms_norm(x)), three times as wide inside."""

    def __init__(self, options: BlockOptions) -> None:
        super().__init__()
        channels = options.channels
        self.adarms = AdaRMSNorm(channels, options.condition_channels)
        self.gegelu = nn.Linear(channels, 6 * channels, bias=False)
        self.dropout = nn.Dropout(options.dropout)
        self.linear = zero_initialised(nn.Linear(3 * channels, channels, bias=False))

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        return self.linear(self.dropout(geglu(self.gegelu(self.adarms(x, condition)))))


def merge(channels: int) -> nn.Sequential:
    """2 x 2 tokens of C channels become one of 2 C."""
    return nn.Sequential(_Shuffle(), nn.Linear(4 * channels, 2 * channels, bias=False))


class _Shuffle(nn.Module):
    """(B, 2 H, 2 W, C) to (B, H, W, 4 C)."""

    def forward(self, x: Tensor) -> Tensor:
        return x.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).permute(0, 1, 3, 2, 4, 5).flatten(3)


class Expand(nn.Module):
    """A token of 2C channels becomes 2 x 2 of C, mixed with the skip: lerp(skip, x,
    sigmoid(alpha)).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(torch.zeros(channels))
        self.linear = nn.Linear(2 * channels, 4 * channels, bias=False)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        x = unshuffle(self.linear(x), (2, 2))
        return torch.lerp(skip, x.to(skip.dtype), self.alpha.sigmoid().to(skip.dtype))
