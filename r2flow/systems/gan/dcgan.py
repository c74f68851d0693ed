"""Convolutional GANs (Radford et al. 2016): the vanilla GAN and DUSty v1.

Nakashima and Kurazume 2021, as the baselines in the code of DUSty v2.
"""

from itertools import pairwise

from torch import nn

from r2flow.backbones.layers import halved
from r2flow.base.registry import Count, Options, Positive, Size
from r2flow.lidar.encoding import ModelSpace
from r2flow.systems.gan.generator import Gan
from r2flow.systems.gan.layers import (
    IMAGE,
    LOGIT,
    BiasedLeakyReLU,
    BlurBoth,
    Equalised,
    Heads,
    LatentGenerator,
    Pad,
    RayDrop,
)


def _doubling(channels: int, out_channels: int, bias: bool = False) -> nn.Sequential:
    return nn.Sequential(
        Pad("reflect"),
        Equalised(nn.ConvTranspose2d(channels, out_channels, 4, stride=2, padding=3, bias=bias)),
    )


class VanillaGan(Gan):
    """A convolutional GAN whose image encodes dropped rays; the code w is z.

    z is projected to a small map, which 4 x 4 transposed convolutions upsample to the image.

    Args:
        latent: Width of z.
        base_channels: Width of the outermost map; it doubles inwards.
        doublings: From the first map to the image; 4 as published.
        tanh: Whether the image ends in tanh; the published weights of v2 alone do.
        temperature: Temperature of the relaxed mask of `DustyV1`.
    """

    drops = False

    def __init__(
        self,
        space: ModelSpace,
        backbone: Options | None = None,
        latent: Count = 512,
        base_channels: Count = 64,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = False,
        temperature: Positive = 1.0,
    ) -> None:
        channels, *shape = space.shape
        first = halved("this GAN", shape, doublings, least=2)
        widths = [min(base_channels << i, max_channels) for i in reversed(range(doublings))]
        projection = nn.Sequential(
            nn.Unflatten(1, (latent, 1, 1)),
            Equalised(nn.ConvTranspose2d(latent, widths[0], first, bias=False)),
            BiasedLeakyReLU(widths[0]),
        )
        synthesis = nn.Sequential(projection)
        for wide, narrow in pairwise(widths):
            synthesis.append(_doubling(wide, narrow).append(BiasedLeakyReLU(narrow)))
        heads = {IMAGE: _doubling(widths[-1], channels, bias=True)}
        if self.drops:
            heads[LOGIT] = _doubling(widths[-1], 1, bias=True)
        synthesis.append(Heads(heads))
        mask = RayDrop(temperature) if self.drops else None
        network = LatentGenerator(latent, latent, nn.Identity(), synthesis, mask, tanh)
        super().__init__(space, network)


class DustyV1(VanillaGan):
    """`VanillaGan` with a second output, the logits of a mask of returns."""

    drops = True


class Discriminator(nn.Sequential):
    """Scores (B, 1, 1, 1) of images (B, C, H, W): blur, strided convolutions and a linear layer.

    Args:
        shape: Rows and columns of the image.
        base_channels: Width of the first layer; each further layer doubles it.
        halvings: Number of strided convolutions; published: 4.
    """

    def __init__(
        self,
        shape: Size,
        channels: int = 1,
        base_channels: Count = 64,
        max_channels: Count = 512,
        halvings: Count = 4,
    ) -> None:
        last = halved("this discriminator", shape, halvings, least=2)
        super().__init__(BlurBoth())
        narrow = 2 * channels
        for i in range(halvings):
            wide = min(base_channels << i, max_channels)
            self.append(
                nn.Sequential(
                    Pad("reflect"),
                    Equalised(nn.Conv2d(narrow, wide, 4, stride=2, bias=False)),
                    BiasedLeakyReLU(wide),
                )
            )
            narrow = wide
        self.append(Equalised(nn.Conv2d(narrow, 1, last), exact=True))
