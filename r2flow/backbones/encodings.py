"""Encodings of ray directions: harmonics of the ray angles, for attention and as inputs.

Rays are elevation e and azimuth a in radians, shape (1, 2, H, W). All computations are in float32 or better.
"""

import math

import torch
from torch import Tensor

from r2flow.backbones.layers import ExactBuffers
from r2flow.registry import Registry


class Rotary(ExactBuffers):
    """Rotary embedding by ray angles, theta = (e f_h, a f_w), with integer harmonics f.

    For integers, azimuth +pi and -pi are the same rotation (paper, section III-C). N heads of D channels, a multiple of
    4, take in turn from the frequencies round(exp(linspace(0, ln M, N D / 4))) of an axis, with M its highest harmonic.
    """

    freqs_h: Tensor
    freqs_w: Tensor

    def __init__(self, heads: int, head_channels: int, highest: tuple[int, int]) -> None:
        super().__init__()
        for name, top in zip(("freqs_h", "freqs_w"), highest, strict=True):
            ladder = torch.linspace(0, math.log(top), heads * head_channels // 4).exp().round()
            self.register_buffer(name, ladder.view(-1, heads).T.contiguous())

    def table(self, rays: Tensor) -> Tensor:
        """cos theta and sin theta, (2, H, W, 1, N, D / 2), for rays (1, 2, H, W)."""
        e, a = rays[0, :, :, :, None, None]
        theta = torch.cat([e * self.freqs_h, a * self.freqs_w], dim=-1)
        return torch.stack([theta.cos(), theta.sin()]).unsqueeze(-3)


def rotate(x: Tensor, table: Tensor) -> Tensor:
    """Rotate each pair (x_i, x_{i + D/2}) by theta_i; x (..., N, D), table of `Rotary`."""
    cos, sin = table
    first, second = x.chunk(2, dim=-1)
    turned = torch.addcmul(first * cos, second, sin, value=-1), torch.addcmul(second * cos, first, sin)
    return torch.cat(turned, dim=-1)


class RayEncoding(ExactBuffers):
    """Features of rays, (1, 2, H, W) to (1, `channels`, H, W), for images of one shape (H, W)."""

    channels: int

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__()


class FourierFeatures(RayEncoding):
    """sin and cos of 2^k e and 2^k a, for k = 0 .. ceil(log2 n) - 1 on an axis of n pixels."""

    freqs: Tensor
    phase: Tensor

    def __init__(self, shape: tuple[int, int]) -> None:
        super().__init__(shape)
        octaves = [math.ceil(math.log2(size)) for size in shape]
        ladders = [2.0 ** torch.arange(count) for count in octaves]
        freqs = torch.block_diag(*(ladder[:, None] for ladder in ladders))
        self.register_buffer("freqs", freqs[:, :, None, None])
        self.register_buffer("phase", torch.zeros(len(freqs)))  # the published weights have one
        self.channels = 2 * len(freqs)

    def forward(self, rays: Tensor) -> Tensor:
        theta = (rays * self.freqs).sum(dim=1)[None] + self.phase[:, None, None]
        return torch.cat([theta.sin(), theta.cos()], dim=1)


class Polar(RayEncoding):
    """The two angles, unchanged."""

    channels = 2

    def forward(self, rays: Tensor) -> Tensor:
        return rays


class SphericalHarmonics(RayEncoding):
    """The 25 real spherical harmonics of degree 0 to 4, ordered by degree l, then order m = -l .. l.

    Y_lm = N_lm P_l^|m|(sin e) times sqrt(2) cos(m b), 1 or sqrt(2) sin(|m| b) for m > 0, = 0, < 0, without
    the Condon-Shortley phase. b = -a: the published models use the opposite sign of azimuth here.
    """

    degrees = 5
    channels = degrees**2

    def forward(self, rays: Tensor) -> Tensor:
        e, b = rays[:, 0].double(), -rays[:, 1].double()
        harmonics = []
        legendre = self._legendre(e)
        for l in range(self.degrees):  # noqa: E741
            for m in range(-l, l + 1):
                order = abs(m)
                norm = math.sqrt((2 * l + 1) / (4 * math.pi) / math.perm(l + order, 2 * order))
                turn = 1.0 if m == 0 else math.sqrt(2) * ((m * b).cos() if m > 0 else (order * b).sin())
                harmonics.append(norm * legendre[l, order] * turn)
        return torch.stack(harmonics, dim=1).to(rays.dtype)

    def _legendre(self, e: Tensor) -> dict[tuple[int, int], Tensor]:
        """P_l^m(sin e) for 0 <= m <= l, by recursion in l."""
        z, table = e.sin(), {}
        for m in range(self.degrees):
            previous, current = torch.zeros_like(z), math.prod(range(1, 2 * m, 2)) * e.cos() ** m
            for l in range(m, self.degrees):  # noqa: E741
                table[l, m] = current
                previous, current = current, ((2 * l + 1) * z * current - (l + m) * previous) / (l - m + 1)
        return table


ENCODINGS: Registry[type[RayEncoding]] = Registry(
    "position", fourier_features=FourierFeatures, polar=Polar, spherical_harmonics=SphericalHarmonics
)


def position_name(position: str | None, *special: str) -> str:
    """The name of a position option; accepts the names of published configs, too."""
    published = {"learnable_embedding": "learnable", "polar_coordinates": "polar"}
    name = published.get(str(position), str(position).lower())
    Registry("position", **dict.fromkeys(special), **ENCODINGS)[name]
    return name
