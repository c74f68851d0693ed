"""NCSNv2's RefineNet as in LiDARGen: the score of noised range images.

Song and Ermon 2020; Zyrianov et al. 2022. Most convolutions are circular in azimuth and elevation,
as in the published weights, whose parameter names are kept.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32
from r2flow.base.registry import Count


def _convolution(
    channels: int, out_channels: int, dilation: int = 1, bias: bool = True
) -> nn.Conv2d:
    """A 3 x 3 convolution with circular padding in both directions."""
    return nn.Conv2d(
        channels, out_channels, 3, 1, dilation, dilation, bias=bias, padding_mode="circular"
    )


class _InstanceNormPlus(nn.Module):
    """gamma (instance_norm(x) + alpha m) + beta, with standardised means m of the channels.

    m, with the unbiased standard deviation, restores the means that the norm removes (Song and
    Ermon 2019, appendix A).
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.alpha = nn.Parameter(1 + 0.02 * torch.randn(channels))
        self.gamma = nn.Parameter(1 + 0.02 * torch.randn(channels))
        self.beta = nn.Parameter(torch.zeros(channels))

    def forward(self, x: Tensor) -> Tensor:
        wide = at_least_float32(x)
        means = wide.mean((2, 3), keepdim=True)
        deviation = (means.var(1, keepdim=True) + 1e-5).sqrt()
        centred = (means - means.mean(1, keepdim=True)) / deviation
        normed = F.instance_norm(wide) + self.alpha[:, None, None] * centred
        return (self.gamma[:, None, None] * normed + self.beta[:, None, None]).to(x.dtype)


class _PooledConv2d(nn.Module):
    """A convolution with zero padding, then 2 x 2 average pooling."""

    def __init__(self, channels: int, out_channels: int, size: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out_channels, size, padding=size // 2)

    def forward(self, x: Tensor) -> Tensor:
        # Sums columns first, as published: another rounding changes which pixel is the largest in
        # `_PoolChain`.
        return F.avg_pool2d(self.conv(x).mT, 2).mT.contiguous()


class _ScoreBlock(nn.Module):
    """shortcut(x) + conv elu norm conv elu norm (x).

    With `changes`, the shortcut is learned, and without dilation the image is halved.
    """

    def __init__(
        self, channels: int, out_channels: int, changes: bool = False, dilation: int = 1
    ) -> None:
        super().__init__()
        middle = channels if changes else out_channels
        self.conv1 = _convolution(channels, middle, dilation)
        self.normalize2 = _InstanceNormPlus(middle)
        self.normalize1 = _InstanceNormPlus(channels)
        self.shortcut: nn.Module = nn.Identity()
        self.conv2: nn.Module
        if changes and dilation == 1:
            self.conv2 = _PooledConv2d(channels, out_channels, 3)
            self.shortcut = _PooledConv2d(channels, out_channels, 1)
            return
        self.conv2 = _convolution(out_channels, out_channels, dilation)
        if changes:
            self.shortcut = _convolution(channels, out_channels, dilation)

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv1(F.elu(self.normalize1(x)))
        return self.shortcut(x) + self.conv2(F.elu(self.normalize2(h)))


class _ResidualUnits(nn.ModuleDict):
    """x <- x + conv elu conv elu (x), repeated."""

    def __init__(self, channels: int, count: int) -> None:
        super().__init__()
        self.count = count
        for unit in range(1, count + 1):
            for layer in (1, 2):
                self[f"{unit}_{layer}_conv"] = _convolution(channels, channels, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        for unit in range(1, self.count + 1):
            h = self[f"{unit}_1_conv"](F.elu(x))
            x = x + self[f"{unit}_2_conv"](F.elu(h))
        return x


class _Fusion(nn.Module):
    """Sum of several maps after a convolution and upsampling of each."""

    def __init__(self, channels: Sequence[int], out_channels: int) -> None:
        super().__init__()
        self.convs = nn.ModuleList(_convolution(width, out_channels) for width in channels)

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        total = self.convs[0](maps[0])
        for conv, x in zip(self.convs[1:], maps[1:], strict=True):
            total = total + F.interpolate(
                conv(x), total.shape[2:], mode="bilinear", align_corners=True
            )
        return total


class _PoolChain(nn.Module):
    """x + p_1 + p_2 with p_i = conv maxpool p_{i-1} and p_0 = x = elu(input)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        layers = (_convolution(channels, channels, bias=False) for _ in range(2))
        self.convs = nn.ModuleList(layers)

    def forward(self, x: Tensor) -> Tensor:
        x = path = F.elu(x)
        for conv in self.convs:
            path = conv(F.max_pool2d(path, 5, stride=1, padding=2))
            x = x + path
        return x


class _RefineBlock(nn.Module):
    """Fusion of maps of several sizes at the size of the first (Lin et al. 2017, "RefineNet")."""

    def __init__(self, channels: Sequence[int], out_channels: int, units: int = 1) -> None:
        super().__init__()
        self.adapt_convs = nn.ModuleList(_ResidualUnits(width, 2) for width in channels)
        if len(channels) > 1:
            self.msf = _Fusion(channels, out_channels)
        self.crp = _PoolChain(out_channels)
        self.output_convs = _ResidualUnits(out_channels, units)

    def forward(self, *maps: Tensor) -> Tensor:
        adapted = [adapt(x) for adapt, x in zip(self.adapt_convs, maps, strict=True)]
        return self.output_convs(self.crp(self.msf(adapted) if len(adapted) > 1 else adapted[0]))


class RefineNet(nn.Module):
    """s(x, i) = F(2 x - 1, column, row) / sigma_i for images x of [0, 1].

    Of four levels, the second halves the image, and the third and fourth use dilation.

    Args:
        sigmas: Noise levels, (L,).
        width: Width of the first level; the others are twice as wide.
    """

    def __init__(self, sigmas: Tensor, channels: Count = 2, width: Count = 128) -> None:
        super().__init__()
        self.sigmas = nn.Buffer(sigmas)
        wide = 2 * width
        self.begin_conv = nn.Conv2d(channels + 2, width, 3, padding=1)
        self.normalizer = _InstanceNormPlus(width)
        self.end_conv = nn.Conv2d(width, channels, 3, padding=1)
        self.res1 = nn.Sequential(_ScoreBlock(width, width), _ScoreBlock(width, width))
        self.res2 = _level(width, wide)
        self.res3 = _level(wide, wide, dilation=2)
        self.res4 = _level(wide, wide, dilation=4)
        self.refine1 = _RefineBlock([wide], wide)
        self.refine2 = _RefineBlock([wide, wide], wide)
        self.refine3 = _RefineBlock([wide, wide], width)
        self.refine4 = _RefineBlock([width, width], width, units=3)

    def forward(self, x: Tensor, labels: Tensor) -> Tensor:
        """Score of images (B, C, H, W) at noise levels `labels`, (B,) int64; H and W are even."""
        lines = (torch.linspace(0, 1, size, device=x.device, dtype=x.dtype) for size in x.shape[2:])
        row, column = torch.meshgrid(*lines, indexing="ij")
        places = torch.stack([column, row]).expand(len(x), -1, -1, -1)
        first = self.res1(self.begin_conv(torch.cat([2 * x - 1, places], 1)))
        second = self.res2(first)
        third = self.res3(second)
        refined = self.refine2(third, self.refine1(self.res4(third)))
        refined = self.refine4(first, self.refine3(second, refined))
        score = self.end_conv(F.elu(self.normalizer(refined)))
        return score / self.sigmas[labels][:, None, None, None]


def _level(channels: int, out_channels: int, dilation: int = 1) -> nn.Sequential:
    return nn.Sequential(
        _ScoreBlock(channels, out_channels, changes=True, dilation=dilation),
        _ScoreBlock(out_channels, out_channels, dilation=dilation),
    )
