"""Convolutional GANs (Radford et al. 2016): the vanilla GAN and DUSty v1 (Nakashima and Kurazume
2021, in the form that DUSty v2's authors compare with)."""

from itertools import pairwise

from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32
from r2flow.registry import Count
from r2flow.systems.gan.layers import (
    IMAGE,
    LOGIT,
    BiasedLeakyReLU,
    BlurBoth,
    Equalised,
    LatentGenerator,
    Pad,
    RayDrop,
    halved,
)


def _doubling(in_channels: int, out_channels: int, ring: bool, bias: bool) -> list[nn.Module]:
    layer = nn.ConvTranspose2d(in_channels, out_channels, 4, stride=2, padding=3, bias=bias)
    return [Pad(ring, "reflect"), Equalised(layer)]


class Heads(nn.Module):
    """One last doubling for each output."""

    def __init__(self, in_channels: int, made: dict[str, int], ring: bool) -> None:
        super().__init__()
        self.heads = nn.ModuleDict(
            {name: nn.Sequential(*_doubling(in_channels, n, ring, True)) for name, n in made.items()}
        )

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        return {name: at_least_float32(head(x)) for name, head in self.heads.items()}


class Generator(LatentGenerator):
    """z, projected to a small map, doubled by 4 x 4 transposed convolutions to the image; w is z.

    Args:
        shape: Rows and columns of the image.
        channels: Of the image.
        drops: Whether a second head says which rays return (DUSty v1); else the vanilla GAN.

    See `r2flow.systems.gan.generator.VanillaGan` for the others.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int = 1,
        drops: bool = False,
        latent: int = 512,
        base_channels: int = 64,
        max_channels: int = 512,
        doublings: int = 4,
        tanh: bool = False,
        ring: bool = True,
    ) -> None:
        first = halved("this GAN", shape, doublings, least=2)
        widths = [min(base_channels << i, max_channels) for i in reversed(range(doublings))]
        projection = nn.Sequential(
            nn.Unflatten(1, (latent, 1, 1)),
            Equalised(nn.ConvTranspose2d(latent, widths[0], first, bias=False)),
            BiasedLeakyReLU(widths[0]),
        )
        synthesis = nn.Sequential(
            projection,
            *(
                nn.Sequential(*_doubling(wide, narrow, ring, False), BiasedLeakyReLU(narrow))
                for wide, narrow in pairwise(widths)
            ),
            Heads(widths[-1], {IMAGE: channels, LOGIT: 1} if drops else {IMAGE: channels}, ring),
        )
        super().__init__(latent, latent, nn.Identity(), synthesis, RayDrop() if drops else None, tanh)


class Discriminator(nn.Sequential):
    """x (B, C, H, W) to scores (B, 1, 1, 1): blurred, halved by 4 x 4 convolutions, then one number.

    Args:
        shape: Rows and columns of the image.
        channels: Of the image.
        base_channels: Width of the first map; it doubles inwards.
        max_channels: Widest.
        halvings: From the image to the last map; 4 as published.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int = 1,
        base_channels: Count = 64,
        max_channels: Count = 512,
        halvings: Count = 4,
    ) -> None:
        last = halved("this discriminator", shape, halvings, least=2)
        widths = [2 * channels, *(min(base_channels << i, max_channels) for i in range(halvings))]
        super().__init__(
            BlurBoth(),
            *(
                nn.Sequential(
                    Pad(True, "reflect"),
                    Equalised(nn.Conv2d(narrow, wide, 4, stride=2, bias=False)),
                    BiasedLeakyReLU(wide),
                )
                for narrow, wide in pairwise(widths)
            ),
            Equalised(nn.Conv2d(widths[-1], 1, last), exact=True),
        )
