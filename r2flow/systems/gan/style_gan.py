"""A style-based GAN on rays (DUSty v2: Nakashima, Iwashita and Kurazume 2023, "Generative range imaging for learning
scene priors of 3D LiDAR data"): every pixel is made from its own angles, by a code that modulates 1 x 1 convolutions.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from r2flow.backbones.convolutions import Resample
from r2flow.backbones.layers import ExactBuffers, at_least_float32
from r2flow.processes import averaged
from r2flow.registry import Count
from r2flow.systems.gan.layers import (
    IMAGE,
    LOGIT,
    BiasedLeakyReLU,
    BlurBoth,
    Equalised,
    Filter,
    LatentGenerator,
    Pad,
    RayDrop,
    halved,
)

WINDOW = (1.0, 3.0, 3.0, 1.0)
FREQUENCIES = 256


class RandomFrequencies(ExactBuffers):
    """sin and cos of f_e e + f_a a + phase for 256 fixed random frequencies: 512 features of each ray.

    f_e is uniform within 2^(ceil(log2 H) + 2); f_a is 0 or +-2^k for k < ceil(log2 W) - 1, so that the features close
    around the turn of a level of H rows and W columns.
    """

    freqs: Tensor
    phase: Tensor

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__()
        octaves_e, octaves_a = (math.ceil(math.log2(size)) for size in shape)
        elevation = (2 * torch.rand(FREQUENCIES) - 1) * 2.0 ** (octaves_e + 2)
        harmonics = 2.0 ** torch.arange(max(octaves_a - 1, 0))
        ladder = torch.cat([-harmonics, torch.zeros(1), harmonics])
        azimuth = ladder[torch.randint(len(ladder), (FREQUENCIES,))]
        self.register_buffer("freqs", torch.stack([elevation, azimuth], 1)[:, :, None, None])
        self.register_buffer("phase", 2 * math.pi * torch.rand(FREQUENCIES))

    def forward(self, angle: Tensor) -> Tensor:
        e, a = angle[:, :1], angle[:, 1:]  # elementwise: a matrix product would be rounded by autocast
        theta = self.freqs[:, 0] * e + self.freqs[:, 1] * a + self.phase[:, None, None]
        return torch.cat([theta.sin(), theta.cos()], dim=1)


class ModulatedConv(nn.Module):
    """A 1 x 1 convolution whose weights a code scales (Karras et al. 2020, StyleGAN2, section 2.2).

    With s = A w + b over its largest magnitude and W over its own, W'_oi = W_oi (s_i + 1), each output's weights then
    at norm 1; and all of it over the root of a running mean of the input's square (Karras et al. 2021, StyleGAN3,
    appendix C). Weights are float32 whatever autocast does. The last layers' weights are not normed, but over
    sqrt(in_channels).
    """

    ema_var: Tensor
    decay = 0.9989  # of the mean square, for each batch: half of it from the last 20,000 images, 32 at a time

    def __init__(self, in_channels: int, out_channels: int, code: int, norm: bool = True) -> None:
        super().__init__()
        self.norm, self.scale = norm, 1 / math.sqrt(in_channels)
        self.weight = nn.Parameter(torch.randn(1, out_channels, in_channels, 1, 1))
        self.bias = None if norm else nn.Parameter(torch.zeros(1, out_channels, 1, 1))
        self.mod = Equalised(nn.Linear(code, in_channels), exact=True)
        self.register_buffer("ema_var", torch.tensor(1.0))

    def forward(self, x: Tensor, w: Tensor) -> Tensor:
        style, weight = self.mod(w), self.weight[..., 0, 0]
        if self.norm:
            weight = weight / weight.abs().amax(dim=(1, 2), keepdim=True)
            style = style / style.abs().amax(dim=1, keepdim=True)
        else:
            weight = weight * self.scale
        weight = weight * (style + 1)[:, None]
        if self.norm:
            weight = weight * torch.rsqrt(weight.square().sum(2, keepdim=True) + 1e-8)
        mean_square = self.ema_var
        if self.training:
            found = averaged(at_least_float32(x.detach()).square().mean())
            mean_square = mean_square.lerp(found, 1 - self.decay)
            self.ema_var.copy_(mean_square)
        weight = weight / (mean_square.sqrt() + 1e-8)
        made = torch.bmm(weight.to(x.dtype), x.flatten(2)).unflatten(2, x.shape[2:])
        return made if self.bias is None else made + self.bias.to(made.dtype)


class Heads(nn.Module):
    """One modulated layer for each output."""

    def __init__(self, in_channels: int, made: dict[str, int], code: int) -> None:
        super().__init__()
        self.heads = nn.ModuleDict({name: ModulatedConv(in_channels, n, code, norm=False) for name, n in made.items()})

    def forward(self, x: Tensor, w: Tensor) -> dict[str, Tensor]:
        return {name: at_least_float32(head(x, w)) for name, head in self.heads.items()}


class Level(nn.Module):
    """Features at twice the size of the last level's, beside those of the rays, and what they add to each output."""

    def __init__(
        self, in_channels: int, channels: int, made: dict[str, int], code: int, shape: tuple[int, int], ring: bool
    ) -> None:
        super().__init__()
        self.first = in_channels == 0
        if not self.first:
            self.resample = Resample(WINDOW, up=True, ring=ring, repeat=True)
            self.downsample = Resample(WINDOW, up=False, ring=ring, repeat=True)
        self.pe = RandomFrequencies(shape)
        self.conv1 = ModulatedConv(in_channels + 2 * FREQUENCIES, channels, code)
        self.bias_act1 = BiasedLeakyReLU(channels)
        if not self.first:
            self.conv2 = ModulatedConv(channels, channels, code)
            self.bias_act2 = BiasedLeakyReLU(channels)
        self.head = Heads(channels, made, code)

    def coarser(self, angle: Tensor) -> Tensor:
        """The angles of the level before: of the filtered sines and cosines, for a mean angle would break at +-pi."""
        return torch.atan2(self.downsample(angle.sin()), self.downsample(angle.cos()))

    def forward(
        self, x: Tensor | None, so_far: dict[str, Tensor], w: Tensor, angle: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        rays = self.pe(angle).expand(len(w), -1, -1, -1)
        x = rays if x is None else torch.cat([self.resample(x), rays.to(x.dtype)], dim=1)
        x = self.bias_act1(self.conv1(x, w))
        if not self.first:
            x = self.bias_act2(self.conv2(x, w))
        made = self.head(x, w)
        return x, {name: o + self.resample(so_far[name]) if so_far else o for name, o in made.items()}


class Synthesis(nn.Module):
    """Levels from coarse to fine, each twice the size of the last; outputs are summed over them and divided by 4."""

    def __init__(
        self,
        shape: tuple[int, int],
        made: dict[str, int],
        code: int,
        widths: Sequence[int],
        ring: bool,
    ) -> None:
        super().__init__()
        shapes = [(shape[0] >> i, shape[1] >> i) for i in reversed(range(len(widths)))]
        self.layers = nn.ModuleList(
            Level(before, after, made, code, size, ring)
            for (before, after), size in zip(pairwise([0, *widths]), shapes, strict=True)
        )

    def forward(self, w: Tensor, angle: Tensor, shift: Tensor | None) -> dict[str, Tensor]:
        if shift is not None:
            turn = torch.stack([torch.zeros_like(shift), 2 * math.pi * shift], 1)
            angle = angle + turn[:, :, None, None]
        angles = [angle]
        for level in list(self.layers)[:0:-1]:
            angles.insert(0, level.coarser(angles[0]))  # type: ignore[operator]
        x: Tensor | None = None
        made: dict[str, Tensor] = {}
        for level, seen in zip(self.layers, angles, strict=True):
            x, made = level(x, made, w, seen)
        if shift is not None:
            made = {name: turned_back(o, shift) for name, o in made.items()}
        return {name: o / 4 for name, o in made.items()}


def turned_back(x: Tensor, shift: Tensor) -> Tensor:
    """x (B, C, H, W) read `shift` of a turn further to the right, (B,), linearly between two columns of the ring."""
    width = x.shape[-1]
    place = torch.arange(width, device=x.device) + shift.double()[:, None] * width
    first = place.floor()
    share = (place - first).to(x.dtype)[:, None, None]
    left, right = (((first.long() + n) % width)[:, None, None].expand(x.shape) for n in (0, 1))
    return x.gather(3, left) * (1 - share) + x.gather(3, right) * share


class Generator(LatentGenerator):
    """z to a code w by two layers, and w with the rays' angles to an image and its mask.

    In training each scan is made as seen by a sensor turned at random and turned back, so that no azimuth is special.

    Args:
        shape: Rows and columns of the image.
        channels: Of the image.

    See `r2flow.systems.gan.generator.DustyV2` for the others.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int = 1,
        latent: int = 512,
        code: int | None = None,
        depth: int = 2,
        base_channels: int = 32,
        max_channels: int = 512,
        doublings: int = 4,
        tanh: bool = True,
        ring: bool = True,
    ) -> None:
        code = code or latent
        halved("this GAN", shape, doublings)
        mapping = nn.Sequential(
            nn.RMSNorm(latent, eps=1e-8, elementwise_affine=False),
            *(
                nn.Sequential(Equalised(nn.Linear(before, code), math.sqrt(2), 0.01, exact=True), nn.LeakyReLU(0.2))
                for before in [latent, *[code] * (depth - 1)]
            ),
        )
        widths = [min(base_channels << i, max_channels) for i in reversed(range(doublings + 1))]
        synthesis = Synthesis(shape, {IMAGE: channels, LOGIT: 1}, code, widths, ring)
        super().__init__(latent, code, mapping, synthesis, RayDrop(), tanh, 2 * (doublings + 1))


class ResidualBlock(nn.Module):
    """(f(x) + g(x)) / sqrt 2 at half the size: f two 3 x 3 convolutions, g one of 1 x 1, both halving what is filtered.

    The residual network of StyleGAN2's discriminator (Karras et al. 2020, figure 7c).
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv1 = _convolution(in_channels, in_channels)
        self.bias_act1 = BiasedLeakyReLU(in_channels)
        self.resample = Filter(WINDOW)
        self.conv2 = _convolution(in_channels, out_channels, stride=2)
        self.bias_act2 = BiasedLeakyReLU(out_channels)
        self.skip = nn.Sequential(Equalised(nn.Conv2d(in_channels, out_channels, 1, stride=2, bias=False)))

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv2(self.resample(self.bias_act1(self.conv1(x))))
        return (self.bias_act2(h) + self.skip(self.resample(x))) / math.sqrt(2)


def _convolution(in_channels: int, out_channels: int, stride: int = 1) -> nn.Sequential:
    layer = nn.Conv2d(in_channels, out_channels, 3, stride=stride, bias=False)
    return nn.Sequential(Pad(True, "replicate"), Equalised(layer))


class MinibatchDeviation(nn.Module):
    """How much images differ, as one channel more: the mean deviation of all features over groups of images.

    Of a batch of B in groups of G, images b, b + B / G, ... belong together (Karras et al. 2018, section 3). G is the
    largest number up to 4 that divides B.
    """

    def forward(self, x: Tensor) -> Tensor:
        group = max(n for n in range(1, 5) if len(x) % n == 0)
        grouped = at_least_float32(x).unflatten(0, (group, -1))
        deviation = (grouped.var(0, unbiased=False) + 1e-8).sqrt().mean((1, 2, 3))[:, None]
        said = deviation.repeat(group, 1)[:, :, None, None].expand(-1, -1, *x.shape[2:])
        return torch.cat([x, said.to(x.dtype)], dim=1)


class Discriminator(nn.Module):
    """x (B, C, H, W) to scores (B, 1): blurred, halved by residual blocks, compared with the others of its batch.

    Args:
        shape: Rows and columns of the image.
        channels: Of the image.
        base_channels: Width of the first map; it doubles inwards.
        max_channels: Widest.
        halvings: From the image to the last map; None for as many as leave 4 rows or columns.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int = 1,
        base_channels: Count = 32,
        max_channels: Count = 512,
        halvings: Count | None = None,
    ) -> None:
        super().__init__()
        halvings = halvings or max(int(math.log2(min(shape) / 4)), 0)
        rows, columns = halved("this discriminator", shape, halvings)
        widths = [min(base_channels << i, max_channels) for i in range(halvings + 1)]
        self.layers = nn.Sequential(
            BlurBoth(),
            nn.Sequential(Equalised(nn.Conv2d(2 * channels, widths[0], 1, bias=False))),
            BiasedLeakyReLU(widths[0]),
            *(ResidualBlock(narrow, wide) for narrow, wide in pairwise(widths)),
        )
        last = widths[-1]
        self.epilogue = nn.Sequential(
            MinibatchDeviation(),
            _convolution(last + 1, last),
            BiasedLeakyReLU(last),
            nn.Flatten(),
            Equalised(nn.Linear(last * rows * columns, last, bias=False), exact=True),
            BiasedLeakyReLU(last),
            Equalised(nn.Linear(last, 1), exact=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        scores: Tensor = self.epilogue(self.layers(x))
        return scores
