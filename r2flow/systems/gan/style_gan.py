"""A style-based GAN on rays: 1 x 1 convolutions, modulated by a code, map angles to pixels.

DUSty v2: Nakashima, Iwashita and Kurazume 2023, "Generative range imaging for learning scene priors
of 3D LiDAR data".
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn

from r2flow.backbones.convolutions import Resample
from r2flow.backbones.layers import ExactBuffers, at_least_float32, halved
from r2flow.base.processes import mean_over_processes
from r2flow.base.registry import Count, Options, Positive, Size
from r2flow.generators.base import Generator
from r2flow.lidar.encoding import ModelSpace
from r2flow.systems.gan.generator import Gan
from r2flow.systems.gan.layers import (
    IMAGE,
    LOGIT,
    BiasedLeakyReLU,
    Equalised,
    Heads,
    LatentGenerator,
    Outputs,
    RayDrop,
)

_WINDOW = (1.0, 3.0, 3.0, 1.0)
_FREQUENCIES = 256


class _RandomFrequencies(ExactBuffers):
    """sin and cos of f_e e + f_a a + phase for 256 fixed random frequencies: 512 features per ray.

    f_e is uniform within +-2^(ceil(log2 H) + 2); f_a is 0 or +-2^k for k < ceil(log2 W) - 1, so
    that features are periodic in azimuth. The level has H rows and W columns.
    """

    def __init__(self, shape: Size) -> None:
        super().__init__()
        octaves_e, octaves_a = (math.ceil(math.log2(size)) for size in shape)
        elevation = (2 * torch.rand(_FREQUENCIES) - 1) * 2.0 ** (octaves_e + 2)
        harmonics = 2.0 ** torch.arange(max(octaves_a - 1, 0))
        choices = torch.cat([-harmonics, torch.zeros(1), harmonics])
        azimuth = choices[torch.randint(len(choices), (_FREQUENCIES,))]
        self.freqs = nn.Buffer(torch.stack([elevation, azimuth], 1)[:, :, None, None])
        self.phase = nn.Buffer(2 * math.pi * torch.rand(_FREQUENCIES))

    def forward(self, angle: Tensor) -> Tensor:
        # Elementwise, since autocast would round a matrix product.
        theta = self.freqs[:, 0] * angle[:, :1] + self.freqs[:, 1] * angle[:, 1:]
        theta = theta + self.phase[:, None, None]
        return torch.cat([theta.sin(), theta.cos()], dim=1)


class _ModulatedConv(nn.Module):
    """A 1 x 1 convolution with weights modulated by a code (StyleGAN2, Karras et al. 2020, 2.2).

    W'_oi = W_oi (s_i + 1) with s = A w + b, where W and s are divided by their largest magnitudes
    and W'_o is scaled to norm 1, then divided by the root of a running mean of the input's square
    (Karras et al. 2021, StyleGAN3, appendix C). Weights are float32 also under autocast. Without
    `norm`, W is divided by sqrt(in_channels) instead, and there is a bias.
    """

    decay = 0.9989  # of the mean square: a half-life of 20,000 images at batch size 32

    def __init__(self, in_channels: int, out_channels: int, code: int, norm: bool = True) -> None:
        super().__init__()
        self.norm = norm
        self.weight = nn.Parameter(torch.randn(1, out_channels, in_channels, 1, 1))
        self.bias = None if norm else nn.Parameter(torch.zeros(1, out_channels, 1, 1))
        self.mod = Equalised(nn.Linear(code, in_channels), exact=True)
        self.ema_var = nn.Buffer(torch.tensor(1.0))

    def forward(self, x: Tensor, w: Tensor) -> Tensor:
        style = self.mod(w)
        weight = self.weight[..., 0, 0]
        if self.norm:
            weight = weight / weight.abs().amax(dim=(1, 2), keepdim=True)
            style = style / style.abs().amax(dim=1, keepdim=True)
            weight = weight * (style + 1)[:, None]
            weight = weight * torch.rsqrt(weight.square().sum(2, keepdim=True) + 1e-8)
        else:
            weight = weight * (1 / math.sqrt(x.shape[1])) * (style + 1)[:, None]
        mean_square: Tensor = self.ema_var
        if self.training:
            batch_mean = mean_over_processes(at_least_float32(x.detach()).square().mean())
            mean_square = mean_square.lerp(batch_mean, 1 - self.decay)
            self.ema_var.copy_(mean_square)
        weight = weight / (mean_square.sqrt() + 1e-8)
        made = torch.bmm(weight.to(x.dtype), x.flatten(2)).unflatten(2, x.shape[2:])
        return made if self.bias is None else made + self.bias.to(made.dtype)


class _Level(nn.Module):
    """Upsampled features with ray features, and their contribution to each output."""

    def __init__(
        self,
        in_channels: int,
        channels: int,
        made: dict[str, int],
        code: int,
        shape: Size,
    ) -> None:
        super().__init__()
        self.first = in_channels == 0
        if not self.first:
            self.resample = Resample(_WINDOW, up=True, ring=True, repeat=True)
            self.downsample = Resample(_WINDOW, up=False, ring=True, repeat=True)
        self.pe = _RandomFrequencies(shape)
        self.conv1 = _ModulatedConv(in_channels + 2 * _FREQUENCIES, channels, code)
        self.bias_act1 = BiasedLeakyReLU(channels)
        if not self.first:
            self.conv2 = _ModulatedConv(channels, channels, code)
            self.bias_act2 = BiasedLeakyReLU(channels)
        heads = {name: _ModulatedConv(channels, n, code, norm=False) for name, n in made.items()}
        self.head = Heads(heads)

    def coarser(self, angle: Tensor) -> Tensor:
        """Angles of the previous level, by sines and cosines, which have no jump at +-pi."""
        return torch.atan2(self.downsample(angle.sin()), self.downsample(angle.cos()))

    def forward(
        self, x: Tensor | None, so_far: Outputs, w: Tensor, angle: Tensor
    ) -> tuple[Tensor, Outputs]:
        rays = self.pe(angle).expand(len(w), -1, -1, -1)
        if x is None:
            x = self.bias_act1(self.conv1(rays, w))
            return x, self.head(x, w)
        x = torch.cat([self.resample(x), rays.to(x.dtype)], dim=1)
        x = self.bias_act1(self.conv1(x, w))
        x = self.bias_act2(self.conv2(x, w))
        return x, {name: o + self.resample(so_far[name]) for name, o in self.head(x, w).items()}


class _Synthesis(nn.Module):
    """Levels from coarse to fine, each doubling the size; outputs are summed and divided by 4."""

    def __init__(
        self,
        shape: Sequence[int],
        made: dict[str, int],
        code: int,
        widths: Sequence[int],
    ) -> None:
        super().__init__()
        self.layers = nn.ModuleList()
        for i, (before, after) in enumerate(pairwise([0, *widths]), start=1):
            times = len(widths) - i
            size = (shape[0] >> times, shape[1] >> times)
            self.layers.append(_Level(before, after, made, code, size))

    def forward(self, w: Tensor, angle: Tensor, shift: Tensor | None) -> Outputs:
        if shift is not None:
            turn = torch.stack([torch.zeros_like(shift), 2 * math.pi * shift], 1)
            angle = angle + turn[:, :, None, None]
        angles = [angle]
        for level in self.layers[:0:-1]:
            angles.append(level.coarser(angles[-1]))  # type: ignore[operator]
        x: Tensor | None = None
        made: Outputs = {}
        for level in self.layers:
            x, made = level(x, made, w, angles.pop())
        if shift is not None:
            made = {name: _turned_back(o, shift) for name, o in made.items()}
        return {name: o / 4 for name, o in made.items()}


def _turned_back(x: Tensor, shift: Tensor) -> Tensor:
    """Rotate x (B, C, H, W) left by `shift` turns, (B,), with linear interpolation of columns."""
    width = x.shape[-1]
    place = torch.arange(width, device=x.device) + shift.double()[:, None] * width
    first = place.floor().long()
    share = (place - first).to(x.dtype)[:, None, None]
    index = (first % width)[:, None, None].expand(x.shape)
    return x.gather(3, index).lerp(x.gather(3, (index + 1) % width), share)


class DustyV2(Gan):
    """A style-based GAN: z to a code w, and w with each ray's angles to its pixel.

    Training rotates the angles at random and rotates the image back, so that all azimuths are
    alike.

    Args:
        code: Width of w; null for `latent`.
        depth: Layers from z to w.
        temperature: Temperature of the relaxed mask.

    See `r2flow.systems.gan.dcgan.VanillaGan` for the others.
    """

    def __init__(
        self,
        space: ModelSpace,
        backbone: Options | None = None,
        latent: Count = 512,
        code: Count | None = None,
        depth: Count = 2,
        base_channels: Count = 32,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = True,
        temperature: Positive = 1.0,
    ) -> None:
        channels, *shape = space.shape
        code = code or latent
        halved("this GAN", shape, doublings)
        mapping = nn.Sequential(nn.RMSNorm(latent, eps=1e-8, elementwise_affine=False))
        for before in (latent, *[code] * (depth - 1)):
            mapping.append(
                nn.Sequential(
                    Equalised(nn.Linear(before, code), math.sqrt(2), 0.01, exact=True),
                    nn.LeakyReLU(0.2),
                )
            )
        widths = [min(base_channels << i, max_channels) for i in reversed(range(doublings + 1))]
        synthesis = _Synthesis(shape, {IMAGE: channels, LOGIT: 1}, code, widths)
        network = LatentGenerator(
            latent, code, mapping, synthesis, RayDrop(temperature), tanh, 2 * len(widths)
        )
        super().__init__(space, network)
        self.angle = space.rays[None].clone()

    def start_from(self, parent: Generator) -> None:
        """Load a trained generator's weights; keep these angles."""
        self._take(parent, {**parent.state_dict(), "angle": self.angle})  # type: ignore[dict-item]
