"""LiDM's autoencoder (Ran et al. 2024, "Towards realistic scene generation with LiDAR diffusion models").

Padding is circular in azimuth and zero in elevation. Parameter names are those of the published weights.
"""

import math
from collections import OrderedDict
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import integers
from r2flow.backbones.convolutions import GroupNorm
from r2flow.backbones.layers import wrapped
from r2flow.errors import InputError
from r2flow.registry import Count, NonNegative
from r2flow.systems.latent.quantiser import Quantised, Quantiser

GROUPS = 32
Size = tuple[int, int]
Margins = tuple[int, int, int, int]  # left, right, top, bottom

# Stride (rows, columns) -> kernel and margins of downsampling, decoder blocks and upsampling.
DOWN: dict[Size, tuple[Size, Margins]] = {(1, 2): ((3, 3), (0, 1, 1, 1)), (2, 2): ((3, 3), (0, 1, 0, 1))}
BLOCK: dict[Size, tuple[Size, Margins]] = {(1, 2): ((1, 4), (1, 2, 0, 0)), (2, 2): ((3, 3), (1, 1, 1, 1))}
UP: dict[Size, tuple[Size, Margins]] = {(1, 2): ((1, 5), (2, 2, 0, 0)), (2, 2): ((3, 3), (1, 1, 1, 1))}
SQUARE = BLOCK[2, 2]
FLAT = BLOCK[1, 2]


class CircularConv2d(nn.Conv2d):
    """A convolution with given margins: circular left and right, zeros at the top and bottom."""

    def __init__(
        self,
        channels: int,
        out_channels: int,
        kernel: Size = SQUARE[0],
        margins: Margins = SQUARE[1],
        stride: Size | int = 1,
    ) -> None:
        super().__init__(channels, out_channels, kernel, stride)
        self.margins = margins

    def forward(self, x: Tensor) -> Tensor:
        left, right, top, bottom = self.margins
        x = wrapped(x, left, right) if left or right else x
        return super().forward(F.pad(x, (0, 0, top, bottom)) if top or bottom else x)


class ResidualBlock(nn.Module):
    """shortcut(x) + conv silu norm conv silu norm (x)."""

    def __init__(self, channels: int, out_channels: int, shape: tuple[Size, Margins] = SQUARE) -> None:
        super().__init__()
        self.norm1 = GroupNorm(channels, GROUPS)
        self.conv1 = CircularConv2d(channels, out_channels, *shape)
        self.norm2 = GroupNorm(out_channels, GROUPS)
        self.conv2 = CircularConv2d(out_channels, out_channels, *shape)
        self.nin_shortcut = nn.Identity() if channels == out_channels else nn.Conv2d(channels, out_channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv1(F.silu(self.norm1(x)))
        return self.nin_shortcut(x) + self.conv2(F.silu(self.norm2(h)))


class Attention(nn.Module):
    """x + attention(norm x) over all pixels, with one head."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = GroupNorm(channels, GROUPS)
        self.q, self.k, self.v, self.proj_out = (nn.Conv2d(channels, channels, 1) for _ in range(4))

    def forward(self, x: Tensor) -> Tensor:
        normed = self.norm(x)
        # Contiguous with a dimension of heads, as the fast kernels need.
        q, k, v = (layer(normed).flatten(2).mT[:, None].contiguous() for layer in (self.q, self.k, self.v))
        attended = F.scaled_dot_product_attention(q, k, v)[:, 0].mT.unflatten(2, x.shape[2:])
        return x + self.proj_out(attended)


def _middle(channels: int) -> nn.Module:
    blocks = ResidualBlock(channels, channels), ResidualBlock(channels, channels)
    return nn.Sequential(OrderedDict(block_1=blocks[0], attn_1=Attention(channels), block_2=blocks[1]))


class Level(nn.Module):
    """Residual blocks of one resolution, optionally with attention after each and a resampling to the next level."""

    def __init__(
        self,
        widths: Sequence[int],
        shape: tuple[Size, Margins],
        attends: bool,
        down: Size | None = None,
        up: Size | None = None,
    ) -> None:
        super().__init__()
        self.block = nn.ModuleList(ResidualBlock(*pair, shape) for pair in pairwise(widths))
        self.attn = nn.ModuleList(Attention(width) if attends else nn.Identity() for width in widths[1:])
        last = widths[-1]
        self.downsample = self.upsample = nn.Sequential()
        if down is not None:
            self.downsample = nn.Sequential(OrderedDict(conv=CircularConv2d(last, last, *DOWN[down], stride=down)))
        if up is not None:
            enlarge = nn.Upsample(scale_factor=up, mode="bilinear", align_corners=True)
            self.upsample = nn.Sequential(OrderedDict(enlarge=enlarge, conv=CircularConv2d(last, last, *UP[up])))

    def forward(self, x: Tensor) -> Tensor:
        for block, attention in zip(self.block, self.attn, strict=True):
            x = attention(block(x))
        return self.upsample(self.downsample(x))


class Encoder(nn.Module):
    """Images (B, channels, H, W) to (B, out_channels, H / rows, W / columns), with the product of all strides."""

    def __init__(
        self,
        channels: int,
        out_channels: int,
        widths: Sequence[int],
        strides: Sequence[Size],
        blocks: int,
        attends: Sequence[int],
    ) -> None:
        super().__init__()
        self.conv_in = CircularConv2d(channels, widths[0])
        in_widths = [widths[0], *widths]
        self.down = nn.ModuleList(
            Level([in_widths[i], *[width] * blocks], SQUARE, i in attends, down=stride)
            for i, (width, stride) in enumerate(zip(widths, [*strides, None], strict=True))
        )
        self.mid = _middle(widths[-1])
        self.norm_out = GroupNorm(widths[-1], GROUPS)
        self.conv_out = CircularConv2d(widths[-1], out_channels)

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv_in(x)
        for level in self.down:
            x = level(x)
        return self.conv_out(F.silu(self.norm_out(self.mid(x))))


class Decoder(nn.Module):
    """Latents to images, with one more block per level than the encoder; kernels follow the level's stride."""

    def __init__(
        self,
        channels: int,
        out_channels: int,
        widths: Sequence[int],
        strides: Sequence[Size],
        blocks: int,
        attends: Sequence[int],
    ) -> None:
        super().__init__()
        self.conv_in = CircularConv2d(channels, widths[-1])
        self.mid = _middle(widths[-1])
        in_widths = [*widths[1:], widths[-1]]
        self.up = nn.ModuleList(
            Level(
                [in_widths[i], *[width] * (blocks + 1)],
                FLAT if stride is None else BLOCK[stride],
                i in attends,
                up=stride,
            )
            for i, (width, stride) in enumerate(zip(widths, [None, *strides], strict=True))
        )
        self.norm_out = GroupNorm(widths[0], GROUPS)
        self.conv_out = CircularConv2d(widths[0], out_channels, *FLAT)

    def forward(self, z: Tensor) -> Tensor:
        x = self.mid(self.conv_in(z))
        for level in reversed(self.up):
            x = level(x)
        return self.conv_out(F.silu(self.norm_out(x)))


class Autoencoder(nn.Module):
    """Images (B, C, H, W) to latents (B, code_channels, h, w), quantisation, and back.

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
        multipliers: Sequence[int] = (1, 2, 2, 4),
        strides: Sequence[Sequence[int]] = ((1, 2), (2, 2), (2, 2)),
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
        given = [tuple(stride) for stride in strides]
        self.strides = [(int(rows), int(columns)) for rows, columns in (s for s in given if s in DOWN)]
        levels = max(len(multipliers), 1)
        if self.strides != given or len(given) != levels - 1:
            raise InputError(
                f"an autoencoder of {levels} levels needs {levels - 1} strides, each [1, 2] or [2, 2]; found "
                f"{[list(stride) for stride in given]}."
            )
        widths = [width * multiplier for multiplier in integers("multipliers", multipliers, len(multipliers))]
        self.mask, self.code_channels = mask, code_channels
        shared = widths, self.strides, blocks, attention
        self.encoder = Encoder(channels, latent_channels, *shared)
        self.decoder = Decoder(latent_channels, channels + mask, *shared)
        self.quantize = Quantiser(codes, code_channels, beta, legacy)
        self.quant_conv = nn.Conv2d(latent_channels, code_channels, 1)
        self.post_quant_conv = nn.Conv2d(code_channels, latent_channels, 1)

    def latent_shape(self, rows: int, columns: int) -> tuple[int, int, int]:
        """Shape (code_channels, h, w) of the latents of an image."""
        high, wide = (math.prod(stride[axis] for stride in self.strides) for axis in (0, 1))
        if rows % high or columns % wide:
            raise InputError(
                f"the autoencoder makes one latent of {high} x {wide} pixels, which do not divide {rows} x {columns}."
            )
        return self.code_channels, rows // high, columns // wide

    def encode(self, x: Tensor) -> Tensor:
        """Latents before quantisation."""
        return self.quant_conv(self.encoder(x))

    def decode(self, z: Tensor, quantise: bool = True) -> Tensor:
        """Decode latents, by default after quantisation; rays dropped by the mask are -1."""
        image = self.decoder(self.post_quant_conv(self.quantize(z).codes if quantise else z))
        return torch.where(image[:, -1:] < 0, -1.0, image[:, :-1]) if self.mask else image

    def forward(self, x: Tensor) -> tuple[Tensor, Quantised]:
        """Reconstruction, including the mask channel, and output of the quantiser."""
        quantised = self.quantize(self.encode(x))
        return self.decoder(self.post_quant_conv(quantised.codes)), quantised
