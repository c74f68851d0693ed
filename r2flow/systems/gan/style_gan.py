"""A style-based GAN on rays (DUSty v2: Nakashima, Iwashita and Kurazume 2023, "Generative range imaging for learning
scene priors of 3D LiDAR data"): 1 x 1 convolutions, modulated by a code, map the angles of each pixel to its value.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from r2flow.backbones.convolutions import Resample
from r2flow.backbones.layers import ExactBuffers, at_least_float32, halved
from r2flow.generators.base import Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.processes import averaged
from r2flow.registry import Count, Positive
from r2flow.systems.gan.generator import Gan
from r2flow.systems.gan.layers import (
    IMAGE,
    LOGIT,
    BiasedLeakyReLU,
    BlurBoth,
    Equalised,
    Filter,
    Heads,
    LatentGenerator,
    Pad,
    RayDrop,
)

WINDOW = (1.0, 3.0, 3.0, 1.0)
FREQUENCIES = 256


class RandomFrequencies(ExactBuffers):
    """sin and cos of f_e e + f_a a + phase for 256 fixed random frequencies: 512 features per ray.

    f_e is uniform within +-2^(ceil(log2 H) + 2); f_a is 0 or +-2^k for k < ceil(log2 W) - 1, so that features are
    periodic in azimuth. The level has H rows and W columns.
    """

    freqs: Tensor
    phase: Tensor

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__()
        octaves_e, octaves_a = (math.ceil(math.log2(size)) for size in shape)
        elevation = (2 * torch.rand(FREQUENCIES) - 1) * 2.0 ** (octaves_e + 2)
        harmonics = 2.0 ** torch.arange(max(octaves_a - 1, 0))
        choices = torch.cat([-harmonics, torch.zeros(1), harmonics])
        azimuth = choices[torch.randint(len(choices), (FREQUENCIES,))]
        self.register_buffer("freqs", torch.stack([elevation, azimuth], 1)[:, :, None, None])
        self.register_buffer("phase", 2 * math.pi * torch.rand(FREQUENCIES))

    def forward(self, angle: Tensor) -> Tensor:
        e, a = angle[:, :1], angle[:, 1:]  # elementwise, since autocast would round a matrix product
        theta = self.freqs[:, 0] * e + self.freqs[:, 1] * a + self.phase[:, None, None]
        return torch.cat([theta.sin(), theta.cos()], dim=1)


class ModulatedConv(nn.Module):
    """A 1 x 1 convolution with weights modulated by a code (Karras et al. 2020, StyleGAN2, section 2.2).

    W'_oi = W_oi (s_i + 1) with s = A w + b, where W and s are divided by their largest magnitudes and W'_o is scaled to
    norm 1, then divided by the root of a running mean of the input's square (Karras et al. 2021, StyleGAN3, appendix
    C). Weights are float32 also under autocast. Without `norm`, W is divided by sqrt(in_channels) instead.
    """

    ema_var: Tensor
    decay = 0.9989  # of the mean square, per batch: a half-life of 20,000 images at batch size 32

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
            batch_mean = averaged(at_least_float32(x.detach()).square().mean())
            mean_square = mean_square.lerp(batch_mean, 1 - self.decay)
            self.ema_var.copy_(mean_square)
        weight = weight / (mean_square.sqrt() + 1e-8)
        made = torch.bmm(weight.to(x.dtype), x.flatten(2)).unflatten(2, x.shape[2:])
        return made if self.bias is None else made + self.bias.to(made.dtype)


class Level(nn.Module):
    """Upsampled features concatenated with ray features, and their contribution to each output."""

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
        self.head = Heads({name: ModulatedConv(channels, n, code, norm=False) for name, n in made.items()})

    def coarser(self, angle: Tensor) -> Tensor:
        """Angles of the previous level, from filtered sines and cosines to avoid the discontinuity at +-pi."""
        return torch.atan2(self.downsample(angle.sin()), self.downsample(angle.cos()))

    def forward(
        self, x: Tensor | None, so_far: dict[str, Tensor], w: Tensor, angle: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        rays = self.pe(angle).expand(len(w), -1, -1, -1)
        x = rays if x is None else torch.cat([self.resample(x), rays.to(x.dtype)], dim=1)
        x = self.bias_act1(self.conv1(x, w))
        if not self.first:
            x = self.bias_act2(self.conv2(x, w))
        return x, {name: o + self.resample(so_far[name]) if so_far else o for name, o in self.head(x, w).items()}


class Synthesis(nn.Module):
    """Levels from coarse to fine, each doubling the size; outputs are summed over levels and divided by 4."""

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
        for level, level_angle in zip(self.layers, angles, strict=True):
            x, made = level(x, made, w, level_angle)
        if shift is not None:
            made = {name: turned_back(o, shift) for name, o in made.items()}
        return {name: o / 4 for name, o in made.items()}


def turned_back(x: Tensor, shift: Tensor) -> Tensor:
    """Rotate x (B, C, H, W) left by `shift` turns, (B,), with linear interpolation of columns."""
    width = x.shape[-1]
    place = torch.arange(width, device=x.device) + shift.double()[:, None] * width
    first = place.floor()
    share = (place - first).to(x.dtype)[:, None, None]
    left, right = (((first.long() + n) % width)[:, None, None].expand(x.shape) for n in (0, 1))
    return x.gather(3, left) * (1 - share) + x.gather(3, right) * share


class DustyV2(Gan):
    """A style-based GAN that generates each pixel from its ray's angles: z to a code w, and w with angles to the image.

    Training rotates the angles at random and rotates the image back, so that all azimuths are alike.

    Args:
        code: Width of w; null for `latent`.
        depth: Layers from z to w.
        temperature: Temperature of the relaxed mask.

    See `r2flow.systems.gan.dcgan.VanillaGan` for the others.
    """

    def __init__(
        self,
        space: ModelSpace,
        backbone: Mapping[str, Any] | None = None,
        latent: Count = 512,
        code: Count | None = None,
        depth: Count = 2,
        base_channels: Count = 32,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = True,
        ring: bool = True,
        temperature: Positive = 1.0,
    ) -> None:
        channels, rows, columns = space.shape
        code = code or latent
        halved("this GAN", (rows, columns), doublings)
        mapping = nn.Sequential(
            nn.RMSNorm(latent, eps=1e-8, elementwise_affine=False),
            *(
                nn.Sequential(Equalised(nn.Linear(before, code), math.sqrt(2), 0.01, exact=True), nn.LeakyReLU(0.2))
                for before in [latent, *[code] * (depth - 1)]
            ),
        )
        widths = [min(base_channels << i, max_channels) for i in reversed(range(doublings + 1))]
        synthesis = Synthesis((rows, columns), {IMAGE: channels, LOGIT: 1}, code, widths, ring)
        styles = 2 * (doublings + 1)
        super().__init__(space, LatentGenerator(latent, code, mapping, synthesis, RayDrop(), tanh, styles))
        self.network.temperature = temperature
        self.angle = space.rays[None].clone()

    def start_from(self, parent: Generator) -> None:
        """Load a trained generator's weights; keep these angles."""
        self._take(parent, {**parent.state_dict(), "angle": self.angle})  # type: ignore[dict-item]


class ResidualBlock(nn.Module):
    """(f(x) + g(x)) / sqrt 2 at half the size: two 3 x 3 convolutions f, a 1 x 1 convolution g, strided after a filter.

    The residual block of StyleGAN2's discriminator (Karras et al. 2020, figure 7c).
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
    """Append a channel with the standard deviation over a group of images, averaged over all features.

    A group has G images b, b + B / G, ..., with the largest divisor G <= 4 of a device's batch B (Karras et al. 2018,
    section 3).
    """

    def forward(self, x: Tensor) -> Tensor:
        group = max(n for n in range(1, 5) if len(x) % n == 0)
        grouped = at_least_float32(x).unflatten(0, (group, -1))
        deviation = (grouped.var(0, unbiased=False) + 1e-8).sqrt().mean((1, 2, 3))[:, None]
        channel = deviation.repeat(group, 1)[:, :, None, None].expand(-1, -1, *x.shape[2:])
        return torch.cat([x, channel.to(x.dtype)], dim=1)


class Discriminator(nn.Module):
    """Scores (B, 1) of images (B, C, H, W): blur, residual blocks, minibatch deviation and linear layers.

    Args:
        shape: Rows and columns of the image.
        base_channels: Width of the first layer; each block doubles it.
        halvings: Number of blocks; None: as many as leave at least 4 rows and columns.
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
        return self.epilogue(self.layers(x))
