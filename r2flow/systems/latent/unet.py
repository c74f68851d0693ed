"""LiDM's U-Net on latents: the guided-diffusion network (Dhariwal and Nichol 2021) on a ring.

Parameter names are those of the published weights.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.convolutions import GroupNorm, projection
from r2flow.backbones.layers import ExactLinear, at_least_float32, halved, zero_initialised
from r2flow.base.registry import Count, Counts
from r2flow.systems.latent.autoencoder import CircularConv2d


def _norm(channels: int) -> GroupNorm:
    return GroupNorm(32, channels)


def _cosines_and_sines(t: Tensor, channels: int) -> Tensor:
    """Concatenated cos(f_i t) and sin(f_i t), with f_i = 10^(-4 i / (C / 2)) and steps t, (B,)."""
    half = channels // 2
    index = torch.arange(half, device=t.device, dtype=torch.float32)
    phase = at_least_float32(t)[:, None] * torch.exp(-math.log(1e4) / half * index)
    return torch.cat([phase.cos(), phase.sin()], dim=1)


class _ResidualBlock(nn.Module):
    """skip(x) + conv silu norm (conv silu norm (x) + W silu(c)); the last convolution is zero
    first.
    """

    def __init__(self, channels: int, out_channels: int, condition_channels: int) -> None:
        super().__init__()
        self.in_layers = nn.Sequential(
            _norm(channels), nn.SiLU(), CircularConv2d(channels, out_channels)
        )
        self.emb_layers = nn.Sequential(nn.SiLU(), ExactLinear(condition_channels, out_channels))
        self.out_layers = nn.Sequential(
            _norm(out_channels),
            nn.SiLU(),
            nn.Identity(),  # the dropout of the published network
            zero_initialised(CircularConv2d(out_channels, out_channels)),
        )
        self.skip_connection = projection(channels, out_channels)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        h = self.in_layers(x)
        h = self.out_layers(h + self.emb_layers(condition)[:, :, None, None].to(h.dtype))
        return self.skip_connection(x) + h


class _Attention(nn.Module):
    """x + attention(norm x) over all pixels; the q, k and v of a head are adjacent in `qkv`."""

    def __init__(self, channels: int, head_channels: int) -> None:
        super().__init__()
        self.heads = channels // head_channels
        self.norm = _norm(channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = zero_initialised(nn.Conv1d(channels, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        qkv = self.qkv(self.norm(x).flatten(2)).unflatten(1, (self.heads, 3, -1)).mT
        # Contiguous, since the fast kernels need adjacent channels of a head.
        attended = F.scaled_dot_product_attention(*qkv.movedim(2, 0).contiguous())
        return x + self.proj_out(attended.mT.flatten(1, 2)).view(x.shape)


class _Step(nn.Sequential):
    """Sequential layers; residual blocks are conditioned on time."""

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:  # type: ignore[override]
        for layer in self:
            x = layer(x, condition) if isinstance(layer, _ResidualBlock) else layer(x)
        return x


class LatentUNet(nn.Module):
    """eps(z, t) for latents z at the steps t of a diffusion.

    Args:
        shape: Channels, rows and columns of the latents.
        width: Width of the first level.
        multipliers: Width of each level relative to `width`.
        blocks: Residual blocks per level of the encoder; the decoder has one more.
        attention: Downsampling factors of levels with attention; the middle always has it.
        head_channels: Channels per attention head.
        position: "learnable" adds a zero-initialised bias, (width, rows, columns), after the first
            convolution: the paper's LiDM + APE. "none": LiDM.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        width: Count = 256,
        multipliers: Counts = (1, 2, 4),
        blocks: Count = 2,
        attention: Sequence[int] = (1, 2, 4),
        head_channels: Count = 32,
        position: Literal["none", "learnable"] = "none",
    ) -> None:
        super().__init__()
        channels, rows, columns = shape
        levels = len(multipliers)
        widths = [width * factor for factor in multipliers]
        halved("the U-Net of the latents (generator.unet.multipliers)", (rows, columns), levels - 1)
        condition = 4 * width
        self.width = width
        self.time_embed = nn.Sequential(
            ExactLinear(width, condition), nn.SiLU(), ExactLinear(condition, condition)
        )
        self.position = None
        if position == "learnable":
            self.position = nn.Parameter(torch.zeros(width, rows, columns))

        def step(before: int, level: int) -> _Step:
            made = _Step(_ResidualBlock(before, widths[level], condition))
            if 2**level in attention:
                made.append(_Attention(widths[level], head_channels))
            return made

        self.input_blocks = nn.ModuleList([_Step(CircularConv2d(channels, width))])
        skips = [width]
        for level, current in enumerate(widths):
            for _ in range(blocks):
                self.input_blocks.append(step(skips[-1], level))
                skips.append(current)
            if level < levels - 1:
                halve = CircularConv2d(current, current, stride=2)
                self.input_blocks.append(_Step(nn.Sequential(OrderedDict(op=halve))))
                skips.append(current)
        self.middle_block = _Step(
            _ResidualBlock(current, current, condition),
            _Attention(current, head_channels),
            _ResidualBlock(current, current, condition),
        )
        self.output_blocks = nn.ModuleList()
        for level in reversed(range(levels)):
            for _ in range(blocks + 1):
                last = step(current + skips.pop(), level)
                self.output_blocks.append(last)
                current = widths[level]
            if level:
                enlarge = nn.Upsample(scale_factor=2)
                layers = OrderedDict(enlarge=enlarge, conv=CircularConv2d(current, current))
                last.append(nn.Sequential(layers))
        self.out = nn.Sequential(
            _norm(widths[0]), nn.SiLU(), zero_initialised(CircularConv2d(widths[0], channels))
        )

    def forward(self, z: Tensor, t: Tensor) -> Tensor:
        """eps for z, (B, channels, rows, columns), at steps t, (B,)."""
        condition = self.time_embed(_cosines_and_sines(t, self.width))
        h = z
        skips: list[Tensor] = []
        for step in self.input_blocks:
            h = step(h, condition)
            if not skips and self.position is not None:
                h = h + self.position
            skips.append(h)
        h = self.middle_block(h, condition)
        for step in self.output_blocks:
            h = step(torch.cat([h, skips.pop()], dim=1), condition)
        return self.out(h)
