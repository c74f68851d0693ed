"""Convolutional GANs (Radford et al. 2016): the vanilla GAN and DUSty v1 (Nakashima and Kurazume
2021, in the form that DUSty v2's authors compare with)."""

from itertools import pairwise

from torch import Tensor, nn

from r2flow.backbones.layers import at_least_float32
from r2flow.errors import InputError
from r2flow.registry import Count
from r2flow.systems.gan.layers import (
    IMAGE,
    BiasedLeakyReLU,
    BlurBoth,
    Equalised,
    LatentGenerator,
    Pad,
    RayDrop,
    check_shape,
    outputs,
)


def _first_map(what: str, shape: tuple[int, int], doublings: int) -> tuple[int, int]:
    """Rows and columns of the smallest map."""
    check_shape(what, shape, 2**doublings)
    rows, columns = shape[0] >> doublings, shape[1] >> doublings
    if min(rows, columns) < 2:
        raise InputError(f"{what} has {doublings} doublings, too many for {shape[0]} x {shape[1]}: give fewer.")
    return rows, columns


class Projection(nn.Sequential):
    """w (B, D) to a map (B, C, h, w) by a transposed convolution of the whole map."""

    def __init__(self, in_channels: int, out_channels: int, shape: tuple[int, int]) -> None:
        super().__init__(
            nn.Unflatten(1, (in_channels, 1, 1)),
            Equalised(nn.ConvTranspose2d(in_channels, out_channels, shape, bias=False)),
            BiasedLeakyReLU(out_channels),
        )


def _doubling(in_channels: int, out_channels: int, ring: bool, bias: bool) -> list[nn.Module]:
    layer = nn.ConvTranspose2d(in_channels, out_channels, 4, stride=2, padding=3, bias=bias)
    return [Pad(ring, "reflect"), Equalised(layer)]


class Heads(nn.Module):
    """One last doubling for each output."""

    def __init__(self, in_channels: int, made: dict[str, int], ring: bool, tanh: bool) -> None:
        super().__init__()
        last = {name: nn.Tanh() if tanh and name == IMAGE else nn.Identity() for name in made}
        self.heads = nn.ModuleDict(
            {name: nn.Sequential(*_doubling(in_channels, n, ring, True), last[name]) for name, n in made.items()}
        )

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        return {name: at_least_float32(head(x)) for name, head in self.heads.items()}


class Generator(LatentGenerator):
    """z, projected to a small map, doubled by 4 x 4 transposed convolutions to the image; w is z.

    Args:
        shape: Rows and columns of the image.
        channels: Of the image.
        drops: Whether a second head says which rays return (DUSty v1); else the vanilla GAN.
        latent: Width of z.
        base_channels: Width of the outermost map; it doubles inwards.
        max_channels: Widest.
        doublings: From the first map to the image; 4 as published.
        tanh: Whether the image ends in tanh; the published weights have none.
        ring: Whether the columns are a full turn.
        dropped: The image's value at a dropped ray.
        temperature: Of the relaxed mask.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int = 1,
        drops: bool = False,
        latent: Count = 512,
        base_channels: Count = 64,
        max_channels: Count = 512,
        doublings: Count = 4,
        tanh: bool = False,
        ring: bool = True,
        dropped: float = -1.0,
        temperature: float = 1.0,
    ) -> None:
        first = _first_map("this GAN", shape, doublings)
        widths = [min(base_channels << i, max_channels) for i in reversed(range(doublings))]
        synthesis = nn.Sequential(
            Projection(latent, widths[0], first),
            *(
                nn.Sequential(*_doubling(wide, narrow, ring, False), BiasedLeakyReLU(narrow))
                for wide, narrow in pairwise(widths)
            ),
            Heads(widths[-1], outputs(channels, drops), ring, tanh),
        )
        super().__init__(latent, latent, nn.Identity(), synthesis, RayDrop(dropped, temperature) if drops else None)


class Discriminator(nn.Sequential):
    """x (B, C, H, W) to scores (B, 1, 1, 1): blurred, halved by 4 x 4 convolutions, then one number.

    Args:
        shape: Rows and columns of the image.
        channels: Of the image.
        base_channels: Width of the first map; it doubles inwards.
        max_channels: Widest.
        halvings: From the image to the last map; 4 as published.
        ring: Whether the columns are a full turn.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        channels: int = 1,
        base_channels: Count = 64,
        max_channels: Count = 512,
        halvings: Count = 4,
        ring: bool = True,
    ) -> None:
        last = _first_map("this discriminator", shape, halvings)
        widths = [2 * channels, *(min(base_channels << i, max_channels) for i in range(halvings))]
        super().__init__(
            BlurBoth(ring),
            *(
                nn.Sequential(
                    Pad(ring, "reflect"),
                    Equalised(nn.Conv2d(narrow, wide, 4, stride=2, bias=False)),
                    BiasedLeakyReLU(wide),
                )
                for narrow, wide in pairwise(widths)
            ),
            Equalised(nn.Conv2d(widths[-1], 1, last), exact=True),
        )
