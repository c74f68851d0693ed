"""A small convolutional network at full resolution, for tasks that need a ray's neighbours only."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone
from r2flow.backbones.convolutions import TimeChannels, time_embedding
from r2flow.backbones.layers import wrapped, zero_initialised
from r2flow.base.registry import Counts


class Local(Backbone):
    """Residual 3 x 3 convolutions, dilated along the rows, on images of any size.

    Padding is circular in azimuth for `ring`, also of crops in training, else zero.

    Args:
        channels: Width of the hidden layers.
        dilations: Columns between the taps of each block's two convolutions.
        ring: Whether the columns are a full turn.
    """

    any_size = True

    def __init__(
        self,
        rays: Tensor,
        channels: TimeChannels = 48,
        dilations: Counts = (1, 2, 4, 8, 1),
        ring: bool = True,
        **common: Any,
    ) -> None:
        super().__init__(rays, (1, 1), **common)
        self.radius = 2 + 2 * len(dilations)
        # That of the columns.
        self.margin = 2 + 2 * sum(dilations) if ring else 0
        self.time = time_embedding(channels, channels)
        self.image = nn.Conv2d(self.in_channels, channels, 3, padding=1)
        self.blocks = nn.ModuleList(_Block(channels, width) for width in dilations)
        self.answer = zero_initialised(nn.Conv2d(channels, self.out_channels, 3, padding=1))

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        columns = x.shape[3]
        margin = self.margin
        if torch.is_autocast_enabled(x.device.type):
            x = x.to(torch.get_autocast_dtype(x.device.type))  # before the copies that follow
        if margin:
            # An odd width: channels at multiples of 4 kB would share a few lines of the cache.
            x = wrapped(x, margin, margin + 1 - columns % 2)
        # In channels_last: up to twice as fast on a CPU; `contiguous` takes twice as long.
        x = x.flatten(2).mT.contiguous().unflatten(1, x.shape[2:]).movedim(3, 1)
        x = self.image(x)  # frees its input
        x += self.time(t)[:, :, None, None].to(x.dtype)
        for block in self.blocks:
            x = block(x)
        return self.answer(F.silu(x))[..., margin : margin + columns].contiguous()


class _Block(nn.Module):
    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        options: Any = {"padding": (1, width), "dilation": (1, width)}
        self.first = nn.Conv2d(channels, channels, 3, **options)
        self.second = zero_initialised(nn.Conv2d(channels, channels, 3, **options))

    def forward(self, x: Tensor) -> Tensor:
        # In place: new memory costs a CPU as much as the sum.
        return self.second(F.silu(self.first(F.silu(x)), inplace=True)).add_(x)
