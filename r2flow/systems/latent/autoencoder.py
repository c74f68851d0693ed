"""LiDM's autoencoder (Ran et al. 2024, "Towards realistic scene generation with LiDAR diffusion").

Padding is circular in azimuth and zero in elevation. Parameter names are those of the published
weights.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.convolutions import GroupNorm, projection
from r2flow.backbones.layers import wrapped
from r2flow.base.errors import InputError
from r2flow.base.registry import Count, Counts, NonNegative, Size
from r2flow.systems.latent.quantiser import Quantiser

_SQUARE: Size = (3, 3)
_FLAT: Size = (1, 4)
# Kernels of the decoder by the stride (rows, columns): of blocks and of upsampling.
_BLOCK = {None: _FLAT, (1, 2): _FLAT, (2, 2): _SQUARE}
UP = {(1, 2): (1, 5), (2, 2): _SQUARE}


def _norm(channels: int) -> GroupNorm:
    return GroupNorm(32, channels, 1e-6)


class CircularConv2d(nn.Conv2d):
    """A convolution with given margins: circular left and right, zeros at the top and bottom.

    By default, the margins (left, right, top, bottom) keep the size at stride 1.
    """

    def __init__(
        self,
        channels: int,
        out_channels: int,
        kernel: Size = _SQUARE,
        stride: Size | int = 1,
        margins: tuple[int, int, int, int] | None = None,
    ) -> None:
        super().__init__(channels, out_channels, kernel, stride)
        rows, columns = kernel
        half = ((columns - 1) // 2, columns // 2, (rows - 1) // 2, rows // 2)
        self.margins = margins or half

    def forward(self, x: Tensor) -> Tensor:
        left, right, top, bottom = self.margins
        if left or right:
            x = wrapped(x, left, right)
        if top or bottom:
            x = F.pad(x, (0, 0, top, bottom))
        return super().forward(x)


class _ResidualBlock(nn.Module):
    """shortcut(x) + conv silu norm conv silu norm (x)."""

    def __init__(self, channels: int, out_channels: int, kernel: Size = _SQUARE) -> None:
        super().__init__()
        self.norm1 = _norm(channels)
        self.conv1 = CircularConv2d(channels, out_channels, kernel)
        self.norm2 = _norm(out_channels)
        self.conv2 = CircularConv2d(out_channels, out_channels, kernel)
        self.nin_shortcut = projection(channels, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv1(F.silu(self.norm1(x)))
        return self.nin_shortcut(x) + self.conv2(F.silu(self.norm2(h)))


class _Attention(nn.Module):
    """x + attention(norm x) over all pixels, with one head."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = _norm(channels)
        self.q = nn.Conv2d(channels, channels, 1)
        self.k = nn.Conv2d(channels, channels, 1)
        self.v = nn.Conv2d(channels, channels, 1)
        self.proj_out = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        normed = self.norm(x)
        maps = (layer(normed).flatten(2).mT[:, None] for layer in (self.q, self.k, self.v))
        # Contiguous with a dimension of heads, as the fast kernels need.
        attended = F.scaled_dot_product_attention(*(part.contiguous() for part in maps))
        return x + self.proj_out(attended[:, 0].mT.view_as(x))


def _middle(channels: int) -> nn.Sequential:
    return nn.Sequential(
        OrderedDict(
            block_1=_ResidualBlock(channels, channels),
            attn_1=_Attention(channels),
            block_2=_ResidualBlock(channels, channels),
        )
    )


def _path(
    first: nn.Module, inner: dict[str, nn.Module], width: int, last: nn.Module
) -> nn.Sequential:
    """A convolution, inner layers with an output of a width, and a normalised convolution."""
    return nn.Sequential(
        OrderedDict(conv_in=first, **inner, norm_out=_norm(width), silu=nn.SiLU(), conv_out=last)
    )


class _Level(nn.Module):
    """Residual blocks of one resolution, optional attention after each, and a resampling.

    Args:
        widths: Width of the input and of each block.
        kernel: Kernel of the blocks.
        down: Stride to the next level; None: no downsampling.
        up: Factors of the upsampling; None: none.
    """

    def __init__(
        self,
        widths: Sequence[int],
        kernel: Size,
        attends: bool,
        down: Size | None = None,
        up: Size | None = None,
    ) -> None:
        super().__init__()
        last = widths[-1]
        self.block = nn.ModuleList(_ResidualBlock(*pair, kernel) for pair in pairwise(widths))
        self.attn = nn.ModuleList(
            _Attention(last) if attends else nn.Identity() for _ in self.block
        )
        self.downsample = self.upsample = nn.Sequential()
        if down is not None:
            self.downsample = nn.Sequential(
                OrderedDict(
                    conv=CircularConv2d(last, last, stride=down, margins=(0, 1, 2 - down[0], 1))
                )
            )
        if up is not None:
            layers = OrderedDict(
                enlarge=nn.Upsample(scale_factor=up, mode="bilinear", align_corners=True),
                conv=CircularConv2d(last, last, UP[up]),
            )
            self.upsample = nn.Sequential(layers)

    def forward(self, x: Tensor) -> Tensor:
        for block, attention in zip(self.block, self.attn, strict=True):
            x = attention(block(x))
        return self.upsample(self.downsample(x))


class _FromCoarse(nn.Sequential):
    """Levels in order of decreasing resolution, applied from the last to the first."""

    def forward(self, x: Tensor) -> Tensor:
        for level in reversed(self):
            x = level(x)
        return x


class Autoencoder(nn.Module):
    """Images (B, C, H, W) to latents (B, code_channels, h, w), quantisation, and back.

    The decoder's kernels follow the stride of their level.

    Args:
        channels: Image channels C.
        width: Width of the first level, a multiple of 32.
        multipliers: Width of each level relative to `width`.
        strides: Downsampling of rows and columns between levels: [1, 2] or [2, 2].
        blocks: Residual blocks per level of the encoder; the decoder has one more.
        attention: Indices of levels with attention; the middle always has it.
        latent_channels: Channels between the encoder and the projection to codes.
        code_channels: Channels of a code.
        codes: Size of the codebook.
        beta, legacy: See `Quantiser`.
        mask: Whether the decoder's last channel is a mask, negative at dropped rays.
    """

    def __init__(
        self,
        channels: Count = 1,
        width: Count = 64,
        multipliers: Counts = (1, 2, 2, 4),
        strides: Sequence[Size] = ((1, 2), (2, 2), (2, 2)),
        blocks: Count = 2,
        attention: Sequence[int] = (),
        latent_channels: Count = 8,
        code_channels: Count = 8,
        codes: Count = 16384,
        beta: NonNegative = 0.25,
        legacy: bool = False,
        mask: bool = False,
    ) -> None:
        super().__init__()
        levels = len(multipliers)
        widths = [width * n for n in multipliers]
        self.strides: list[Any] = [tuple(stride) for stride in strides]
        if len(strides) != levels - 1 or not UP.keys() >= set(self.strides):
            raise InputError(
                f"an autoencoder of {levels} levels needs {levels - 1} strides, each [1, 2] or "
                f"[2, 2]; found {list(strides)}."
            )
        self.mask = mask
        self.code_channels = code_channels
        coarsest = widths[-1]
        inputs = [width, *widths]
        between = [*self.strides, None]  # the last is also that before the first
        down = nn.Sequential()
        up = _FromCoarse()
        for i, after in enumerate(widths):
            attends = i in attention
            inner = [after] * blocks
            above = between[i - 1]
            down.append(_Level([inputs[i], *inner], _SQUARE, attends, down=between[i]))
            up.append(
                _Level(
                    [widths[min(i + 1, levels - 1)], *inner, after],
                    _BLOCK[above],
                    attends,
                    up=above,
                )
            )
        self.encoder = _path(
            CircularConv2d(channels, width),
            {"down": down, "mid": _middle(coarsest)},
            coarsest,
            CircularConv2d(coarsest, latent_channels),
        )
        self.decoder = _path(
            CircularConv2d(latent_channels, coarsest),
            {"mid": _middle(coarsest), "up": up},
            widths[0],
            CircularConv2d(widths[0], channels + mask, _FLAT),
        )
        self.quantize = Quantiser(codes, code_channels, beta, legacy)
        self.quant_conv = nn.Conv2d(latent_channels, code_channels, 1)
        self.post_quant_conv = nn.Conv2d(code_channels, latent_channels, 1)

    def latent_shape(self, rows: int, columns: int) -> tuple[int, int, int]:
        """Shape (code_channels, h, w) of the latents of an image."""
        high = math.prod(stride[0] for stride in self.strides)
        wide = math.prod(stride[1] for stride in self.strides)
        if rows % high or columns % wide:
            raise InputError(
                f"the autoencoder makes one latent of {high} x {wide} pixels, which do not divide "
                f"{rows} x {columns}."
            )
        return self.code_channels, rows // high, columns // wide

    def encode(self, x: Tensor) -> Tensor:
        """Latents before quantisation."""
        return self.quant_conv(self.encoder(x))

    def decode(self, z: Tensor, quantise: bool = True) -> Tensor:
        """Decode latents, by default after quantisation; rays dropped by the mask are -1."""
        image = self.decoder(self.post_quant_conv(self.quantize(z)[0] if quantise else z))
        return torch.where(image[:, -1:] < 0, -1.0, image[:, :-1]) if self.mask else image

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Reconstruction, including the mask channel, and the quantiser's loss."""
        codes, loss = self.quantize(self.encode(x))
        return self.decoder(self.post_quant_conv(codes)), loss
