"""LiDM's U-Net on latents: the guided-diffusion network (Dhariwal and Nichol 2021), circular in azimuth.

Parameter names are those of the published weights.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import integers
from r2flow.backbones.convolutions import GroupNorm
from r2flow.backbones.layers import ExactLinear, at_least_float32, halved, shared, zero_initialised
from r2flow.registry import Count
from r2flow.systems.latent.autoencoder import CircularConv2d

GROUPS, EPS = 32, 1e-5


def norm(channels: int) -> GroupNorm:
    return GroupNorm(channels, GROUPS, EPS)


def cosines_and_sines(t: Tensor, channels: int) -> Tensor:
    """Concatenated cos(f_i t) and sin(f_i t), with f_i = 10^(-4 i / (C / 2)) and step numbers t, (B,)."""
    half = channels // 2
    frequencies = torch.exp(-math.log(1e4) / half * torch.arange(half, device=t.device, dtype=torch.float32))
    phase = at_least_float32(t)[:, None] * frequencies
    return torch.cat([phase.cos(), phase.sin()], dim=1)


class ResidualBlock(nn.Module):
    """skip(x) + conv silu norm (conv silu norm (x) + W silu(c)), with a zero-initialised last convolution."""

    def __init__(self, channels: int, out_channels: int, condition_channels: int) -> None:
        super().__init__()
        self.in_layers = nn.Sequential(norm(channels), nn.SiLU(), CircularConv2d(channels, out_channels))
        self.emb_layers = nn.Sequential(nn.SiLU(), ExactLinear(condition_channels, out_channels))
        last = zero_initialised(CircularConv2d(out_channels, out_channels))
        self.out_layers = nn.Sequential(norm(out_channels), nn.SiLU(), nn.Identity(), last)  # dropout, as published
        self.skip_connection = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        h = self.in_layers(x)
        h = self.out_layers(h + self.emb_layers(condition)[:, :, None, None].to(h.dtype))
        return self.skip_connection(x) + h


class Attention(nn.Module):
    """x + attention(norm x) over all pixels; the q, k and v of a head are adjacent in `qkv`."""

    def __init__(self, channels: int, head_channels: int) -> None:
        super().__init__()
        self.heads = shared(channels, head_channels, f"heads of {head_channels}")
        self.norm = norm(channels)
        self.qkv = nn.Conv1d(channels, 3 * channels, 1)
        self.proj_out = zero_initialised(nn.Conv1d(channels, channels, 1))

    def forward(self, x: Tensor) -> Tensor:
        flat = self.norm(x).flatten(2)
        # Contiguous, since the fast kernels need adjacent channels of a head.
        q, k, v = (part.contiguous() for part in self.qkv(flat).unflatten(1, (self.heads, 3, -1)).mT.unbind(2))
        attended = F.scaled_dot_product_attention(q, k, v).mT.flatten(1, 2)
        return x + self.proj_out(attended).view(x.shape)


class Step(nn.Sequential):
    """Sequential layers; residual blocks are conditioned on time."""

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:  # type: ignore[override]
        for layer in self:
            x = layer(x, condition) if isinstance(layer, ResidualBlock) else layer(x)
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
        position: "learnable" adds a zero-initialised bias, (width, rows, columns), after the first convolution: the
            paper's LiDM + APE. "none": LiDM.
    """

    def __init__(
        self,
        shape: tuple[int, int, int],
        width: Count = 256,
        multipliers: Sequence[int] = (1, 2, 4),
        blocks: Count = 2,
        attention: Sequence[int] = (1, 2, 4),
        head_channels: Count = 32,
        position: Literal["none", "learnable"] = "none",
    ) -> None:
        super().__init__()
        channels, rows, columns = shape
        widths = [width * multiplier for multiplier in integers("multipliers", multipliers, len(multipliers))]
        halved("the U-Net of the latents (generator.unet.multipliers)", (rows, columns), len(widths) - 1)
        condition, self.width = 4 * width, width
        self.time_embed = nn.Sequential(ExactLinear(width, condition), nn.SiLU(), ExactLinear(condition, condition))
        self.position = nn.Parameter(torch.zeros(width, rows, columns)) if position == "learnable" else None

        def block(before: int, after: int) -> ResidualBlock:
            return ResidualBlock(before, after, condition)

        current, skips = width, [width]
        self.input_blocks = nn.ModuleList([Step(CircularConv2d(channels, width))])
        for level, after in enumerate(widths):
            for _ in range(blocks):
                attends = [Attention(after, head_channels)] if 2**level in attention else []
                self.input_blocks.append(Step(block(current, after), *attends))
                current = after
                skips.append(current)
            if level < len(widths) - 1:
                halve = CircularConv2d(current, current, stride=2)
                self.input_blocks.append(Step(nn.Sequential(OrderedDict(op=halve))))
                skips.append(current)
        self.middle_block = Step(block(current, current), Attention(current, head_channels), block(current, current))
        self.output_blocks = nn.ModuleList()
        for level in reversed(range(len(widths))):
            for index in range(blocks + 1):
                layers: list[nn.Module] = [block(current + skips.pop(), widths[level])]
                current = widths[level]
                layers += [Attention(current, head_channels)] if 2**level in attention else []
                if level and index == blocks:
                    double = nn.Upsample(scale_factor=2)
                    layers.append(nn.Sequential(OrderedDict(enlarge=double, conv=CircularConv2d(current, current))))
                self.output_blocks.append(Step(*layers))
        self.out = nn.Sequential(norm(current), nn.SiLU(), zero_initialised(CircularConv2d(current, channels)))

    def forward(self, z: Tensor, t: Tensor) -> Tensor:
        """eps for z, (B, channels, rows, columns), at steps t, (B,)."""
        condition = self.time_embed(cosines_and_sines(t, self.width))
        h, skips = z, []
        for index, step in enumerate(self.input_blocks):
            h = step(h, condition)
            if index == 0 and self.position is not None:
                h = h + self.position
            skips.append(h)
        h = self.middle_block(h, condition)
        for step in self.output_blocks:
            h = step(torch.cat([h, skips.pop()], dim=1), condition)
        return self.out(h)
