"""Convolutional GANs (Radford et al. 2016): the vanilla GAN and DUSty v1 (Nakashima and Kurazume 2021), as the
baselines in the code of DUSty v2."""

from itertools import pairwise

from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32, halved
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
)


def _doubling(in_channels: int, out_channels: int, ring: bool, bias: bool) -> list[nn.Module]:
    layer = nn.ConvTranspose2d(in_channels, out_channels, 4, stride=2, padding=3, bias=bias)
    return [Pad(ring, "reflect"), Equalised(layer)]


class Heads(nn.Module):
    """A final upsampling layer per output."""

    def __init__(self, in_channels: int, made: dict[str, int], ring: bool) -> None:
        super().__init__()
        self.heads = nn.ModuleDict(
            {name: nn.Sequential(*_doubling(in_channels, n, ring, True)) for name, n in made.items()}
        )

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        return {name: at_least_float32(head(x)) for name, head in self.heads.items()}


class Generator(LatentGenerator):
    """Projection of z to a small map, upsampled to the image by 4 x 4 transposed convolutions; w is z.

    Args:
        shape: Rows and columns of the image.
        channels: Image channels.
        drops: Whether a second head predicts ray-drop (DUSty v1); else the vanilla GAN.

    See `r2flow.systems.gan.generator.VanillaGan` for other arguments.
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
    """Scores (B, 1, 1, 1) of images (B, C, H, W): blur, strided 4 x 4 convolutions and a linear layer.

    Args:
        shape: Rows and columns of the image.
        channels: Image channels.
        base_channels: Width of the first layer; each further layer doubles it.
        max_channels: Maximum width.
        halvings: Number of strided convolutions; published: 4.
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
