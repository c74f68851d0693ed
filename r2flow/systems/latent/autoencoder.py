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


class Quantiser(nn.Module):
    """q(z), the code e_k nearest to each vector z, and the mean over all elements of the loss

        |q - sg z|^2 + beta |sg q - z|^2

    with sg the stop-gradient (van den Oord et al. 2017, eq. 3). The first term moves codes, the second (commitment)
    vectors. `legacy` applies beta to the first term instead, as in the published code of LiDM.
    """

    def __init__(self, codes: int, channels: int, beta: float = 0.25, legacy: bool = False) -> None:
        super().__init__()
        self.beta, self.legacy = beta, legacy
        self.embedding = nn.Embedding(codes, channels)
        nn.init.uniform_(self.embedding.weight, -1 / codes, 1 / codes)

    def forward(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """The codes nearest to z, (B, C, H, W), with straight-through gradient, and the loss, ()."""
        vectors = z.movedim(1, -1)
        q = self.embedding(self.nearest(vectors))
        codebook, commitment = (q - vectors.detach()).square().mean(), (q.detach() - vectors).square().mean()
        loss = self.beta * codebook + commitment if self.legacy else codebook + self.beta * commitment
        through = vectors + (q - vectors).detach()
        return through.movedim(-1, 1), loss

    @torch.no_grad()
    def nearest(self, vectors: Tensor) -> Tensor:
        """Index of the code nearest to each vector, (..., C) to (...)."""
        codes = self.embedding.weight.float()
        lengths = codes.square().sum(1)
        with torch.autocast(vectors.device.type, enabled=False):  # full precision, for differences of large numbers
            parts = [
                torch.addmm(lengths, part, codes.T, alpha=-2).argmin(1)  # |part|^2 is common to all codes
                for part in vectors.flatten(0, -2).float().split(4096)  # not all distances at once
            ]
        return torch.cat(parts).view(vectors.shape[:-1])


GROUPS = 32
Size = tuple[int, int]

SQUARE: Size = (3, 3)
FLAT: Size = (1, 4)
BLOCK = {(1, 2): FLAT, (2, 2): SQUARE}  # stride (rows, columns) -> kernel of decoder blocks
UP = {(1, 2): (1, 5), (2, 2): SQUARE}  # of upsampling


class CircularConv2d(nn.Conv2d):
    """A convolution with given margins: circular left and right, zeros at the top and bottom.

    By default, the margins (left, right, top, bottom) keep the size at stride 1.
    """

    def __init__(
        self,
        channels: int,
        out_channels: int,
        kernel: Size = SQUARE,
        stride: Size | int = 1,
        margins: tuple[int, int, int, int] | None = None,
    ) -> None:
        super().__init__(channels, out_channels, kernel, stride)
        rows, columns = kernel
        self.margins = margins or ((columns - 1) // 2, columns // 2, (rows - 1) // 2, rows // 2)

    def forward(self, x: Tensor) -> Tensor:
        left, right, top, bottom = self.margins
        x = wrapped(x, left, right) if left or right else x
        return super().forward(F.pad(x, (0, 0, top, bottom)) if top or bottom else x)


class ResidualBlock(nn.Module):
    """shortcut(x) + conv silu norm conv silu norm (x)."""

    def __init__(self, channels: int, out_channels: int, kernel: Size = SQUARE) -> None:
        super().__init__()
        self.norm1 = GroupNorm(channels, GROUPS)
        self.conv1 = CircularConv2d(channels, out_channels, kernel)
        self.norm2 = GroupNorm(out_channels, GROUPS)
        self.conv2 = CircularConv2d(out_channels, out_channels, kernel)
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
        kernel: Size,
        attends: bool,
        down: Size | None = None,
        up: Size | None = None,
    ) -> None:
        super().__init__()
        self.block = nn.ModuleList(ResidualBlock(*pair, kernel) for pair in pairwise(widths))
        self.attn = nn.ModuleList(Attention(width) if attends else nn.Identity() for width in widths[1:])
        last = widths[-1]
        self.downsample = self.upsample = nn.Sequential()
        if down is not None:
            convolution = CircularConv2d(last, last, stride=down, margins=(0, 1, 2 - down[0], 1))
            self.downsample = nn.Sequential(OrderedDict(conv=convolution))
        if up is not None:
            enlarge = nn.Upsample(scale_factor=up, mode="bilinear", align_corners=True)
            self.upsample = nn.Sequential(OrderedDict(enlarge=enlarge, conv=CircularConv2d(last, last, UP[up])))

    def forward(self, x: Tensor) -> Tensor:
        for block, attention in zip(self.block, self.attn, strict=True):
            x = attention(block(x))
        return self.upsample(self.downsample(x))


class FromCoarse(nn.Sequential):
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
        self.strides = [(int(rows), int(columns)) for rows, columns in (s for s in given if s in UP)]
        levels = max(len(multipliers), 1)
        if self.strides != given or len(given) != levels - 1:
            raise InputError(
                f"an autoencoder of {levels} levels needs {levels - 1} strides, each [1, 2] or [2, 2]; found "
                f"{[list(stride) for stride in given]}."
            )
        widths = [width * multiplier for multiplier in integers("multipliers", multipliers, len(multipliers))]
        self.mask, self.code_channels = mask, code_channels
        finest, coarsest = widths[0], widths[-1]
        downwards = zip([width, *widths[:-1]], widths, [*self.strides, None], strict=True)
        upwards = zip([*widths[1:], coarsest], widths, [None, *self.strides], strict=True)
        down = (
            Level([before, *[after] * blocks], SQUARE, i in attention, down=stride)
            for i, (before, after, stride) in enumerate(downwards)
        )
        up = (
            Level([before, *[after] * (blocks + 1)], BLOCK[stride or (1, 2)], i in attention, up=stride)
            for i, (before, after, stride) in enumerate(upwards)
        )
        self.encoder = nn.Sequential(OrderedDict(
            conv_in=CircularConv2d(channels, width), down=nn.Sequential(*down), mid=_middle(coarsest),
            norm_out=GroupNorm(coarsest, GROUPS), silu=nn.SiLU(), conv_out=CircularConv2d(coarsest, latent_channels),
        ))  # fmt: skip
        self.decoder = nn.Sequential(OrderedDict(
            conv_in=CircularConv2d(latent_channels, coarsest), mid=_middle(coarsest), up=FromCoarse(*up),
            norm_out=GroupNorm(finest, GROUPS), silu=nn.SiLU(),
            conv_out=CircularConv2d(finest, channels + mask, FLAT),
        ))  # fmt: skip
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
        image = self.decoder(self.post_quant_conv(self.quantize(z)[0] if quantise else z))
        return torch.where(image[:, -1:] < 0, -1.0, image[:, :-1]) if self.mask else image

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Reconstruction, including the mask channel, and the quantiser's loss."""
        codes, loss = self.quantize(self.encode(x))
        return self.decoder(self.post_quant_conv(codes)), loss
