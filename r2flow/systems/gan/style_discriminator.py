"""StyleGAN2's discriminator on a ring (Karras et al. 2020), as in DUSty v2."""

import math

import torch
from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32, halved
from r2flow.base.registry import Count, Size
from r2flow.systems.gan.layers import BiasedLeakyReLU, BlurBoth, Equalised, Filter, Pad


class _ResidualBlock(nn.Module):
    """(f(x) + g(x)) / sqrt 2 at half the size, strided after a filter.

    f are two 3 x 3 convolutions, g is a 1 x 1 convolution: the residual block of StyleGAN2's
    discriminator (Karras et al. 2020, figure 7c).
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv1 = _convolution(in_channels, in_channels)
        self.bias_act1 = BiasedLeakyReLU(in_channels)
        self.resample = Filter((1.0, 3.0, 3.0, 1.0))
        self.conv2 = _convolution(in_channels, out_channels, stride=2)
        self.bias_act2 = BiasedLeakyReLU(out_channels)
        self.skip = nn.Sequential(
            Equalised(nn.Conv2d(in_channels, out_channels, 1, stride=2, bias=False))
        )

    def forward(self, x: Tensor) -> Tensor:
        h = self.conv2(self.resample(self.bias_act1(self.conv1(x))))
        return (self.bias_act2(h) + self.skip(self.resample(x))) / math.sqrt(2)


def _convolution(in_channels: int, out_channels: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        Pad("replicate"),
        Equalised(nn.Conv2d(in_channels, out_channels, 3, stride=stride, bias=False)),
    )


class _MinibatchDeviation(nn.Module):
    """Append a channel: the standard deviation over a group of images, averaged over all features.

    A group has G images b, b + B / G, ..., with the largest divisor G <= 4 of a device's batch B
    (Karras et al. 2018, section 3).
    """

    def forward(self, x: Tensor) -> Tensor:
        group = max(n for n in range(1, 5) if len(x) % n == 0)
        grouped = at_least_float32(x).unflatten(0, (group, -1))
        deviation = (grouped.var(0, unbiased=False) + 1e-8).sqrt().mean((1, 2, 3), keepdim=True)
        return torch.cat([x, deviation.repeat(group, 1, *x.shape[2:]).to(x.dtype)], dim=1)


class Discriminator(nn.Module):
    """Scores (B, 1) of images (B, C, H, W): blur, residual blocks, deviation and linear layers.

    Args:
        shape: Rows and columns of the image.
        base_channels: Width of the first layer; each block doubles it.
        halvings: Number of blocks; None: as many as leave at least 4 rows and columns.
    """

    def __init__(
        self,
        shape: Size,
        channels: int = 1,
        base_channels: Count = 32,
        max_channels: Count = 512,
        halvings: Count | None = None,
    ) -> None:
        super().__init__()
        halvings = halvings or max(int(math.log2(min(shape) / 4)), 0)
        rows, columns = halved("this discriminator", shape, halvings)
        widths = [min(base_channels << i, max_channels) for i in range(halvings + 1)]
        first = nn.Conv2d(2 * channels, widths[0], 1, bias=False)
        self.layers = nn.Sequential(
            BlurBoth(),
            nn.Sequential(Equalised(first)),
            BiasedLeakyReLU(widths[0]),
            *map(_ResidualBlock, widths, widths[1:]),
        )
        last = widths[-1]
        self.epilogue = nn.Sequential(
            _MinibatchDeviation(),
            _convolution(last + 1, last),
            BiasedLeakyReLU(last),
            nn.Flatten(),
            Equalised(nn.Linear(last * rows * columns, last, bias=False), exact=True),
            BiasedLeakyReLU(last),
            Equalised(nn.Linear(last, 1), exact=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.epilogue(self.layers(x))
