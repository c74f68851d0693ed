"""Encodings of ray directions: harmonics of the ray angles, for attention and as inputs.

Rays are elevation e and azimuth a in radians, (1, 2, H, W). All is computed in float32 or better.
"""

import math

import torch
from torch import Tensor, nn

from r2flow.backbones.layers import ExactBuffers
from r2flow.base.registry import Registry, Size


class Rotary(ExactBuffers):
    """Rotary embedding by ray angles, theta = (e f_h, a f_w), with integer harmonics f.

    For integers, azimuth +pi and -pi are the same rotation (paper, section III-C). N heads of D
    channels, a multiple of 4, take in turn from the frequencies round(exp(linspace(0, ln M, N D /
    4))) of an axis, with M its highest harmonic.
    """

    def __init__(self, heads: int, head_channels: int, highest: Size) -> None:
        super().__init__()

        def frequencies(top: int) -> nn.Buffer:
            ladder = torch.linspace(0, math.log(top), heads * head_channels // 4).exp().round()
            return nn.Buffer(ladder.view(-1, heads).T.contiguous())

        self.freqs_h = frequencies(highest[0])
        self.freqs_w = frequencies(highest[1])

    def table(self, rays: Tensor) -> Tensor:
        """cos theta twice, then -sin theta and sin theta, (2, H, W, 1, N, D), for rays (1, 2, H,
        W).
        """
        e, a = rays[0, :, :, :, None, None]
        theta = torch.cat([e * self.freqs_h, a * self.freqs_w], dim=-1)
        cos = theta.cos()
        sin = theta.sin()
        return torch.stack([torch.cat([cos, cos], -1), torch.cat([-sin, sin], -1)]).unsqueeze(-3)


def rotate(x: Tensor, table: Tensor) -> Tensor:
    """Rotate each pair (x_i, x_{i + D/2}) by theta_i; x (..., N, D), table of `Rotary`."""
    cos, sin = table
    return torch.addcmul(x * cos, x.roll(x.shape[-1] // 2, -1), sin)


class RayEncoding(ExactBuffers):
    """Features of rays, (1, 2, H, W) to (1, `channels`, H, W), for images of one shape (H, W)."""

    channels: int

    def __init__(self, shape: Size) -> None:
        super().__init__()


class FourierFeatures(RayEncoding):
    """sin and cos of 2^k e and 2^k a, for k = 0 .. ceil(log2 n) - 1 on an axis of n pixels."""

    def __init__(self, shape: Size) -> None:
        super().__init__(shape)
        ladders = (2.0 ** torch.arange(math.ceil(math.log2(size)))[:, None] for size in shape)
        freqs = torch.block_diag(*ladders)
        self.freqs = nn.Buffer(freqs[:, :, None, None])
        self.phase = nn.Buffer(torch.zeros(len(freqs)))  # the published weights have one
        self.channels = 2 * len(freqs)

    def forward(self, rays: Tensor) -> Tensor:
        theta = (rays * self.freqs).sum(dim=1)[None] + self.phase[:, None, None]
        return torch.cat([theta.sin(), theta.cos()], dim=1)


class _Polar(RayEncoding):
    """The two angles, unchanged."""

    channels = 2

    def forward(self, rays: Tensor) -> Tensor:
        return rays


class SphericalHarmonics(RayEncoding):
    """The 25 real spherical harmonics of degree 0 to 4, ordered by degree l, then order m = -l ..
    l.

    Y_lm = N_lm P_l^|m|(sin e) times sqrt(2) cos(m b), 1 or sqrt(2) sin(|m| b) for m > 0, = 0, < 0,
    without the Condon-Shortley phase. b = -a: the published models use the opposite sign of
    azimuth.
    """

    channels = 25

    def forward(self, rays: Tensor) -> Tensor:
        e, a = rays.double().unbind(1)
        harmonics = []
        for l in range(5):  # noqa: E741
            for m in range(-l, l + 1):
                order = abs(m)
                scale = (2 * l + 1) / (4 * math.pi) / math.perm(l + order, 2 * order)
                harmonic = math.sqrt(scale) * _legendre(l, order, e)
                if m:
                    phase = -order * a
                    harmonic = harmonic * math.sqrt(2) * (phase.cos() if m > 0 else phase.sin())
                harmonics.append(harmonic)
        return torch.stack(harmonics, dim=1).to(rays.dtype)


def _legendre(l: int, m: int, e: Tensor) -> Tensor:  # noqa: E741
    """P_l^m(sin e) for 0 <= m <= l, by recursion in l."""
    if l < m:
        return torch.zeros_like(e)
    if l == m:
        return math.prod(range(1, 2 * m, 2)) * e.cos() ** m
    one_less = (2 * l - 1) * e.sin() * _legendre(l - 1, m, e)
    return (one_less - (l + m - 1) * _legendre(l - 2, m, e)) / (l - m)


ENCODINGS: Registry[type[RayEncoding]] = Registry(
    "position",
    fourier_features=FourierFeatures,
    polar=_Polar,
    spherical_harmonics=SphericalHarmonics,
)


def position_name(position: str | None, *special: str) -> str:
    """The name of a position option; accepts the names of published configs, too."""
    published = {"learnable_embedding": "learnable", "polar_coordinates": "polar"}
    name = published.get(str(position), str(position).lower())
    Registry("position", **dict.fromkeys(special), **ENCODINGS)[name]
    return name
