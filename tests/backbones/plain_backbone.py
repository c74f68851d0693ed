"""A backbone that states nothing about itself: what any new one may be, run through every contract."""

from typing import Unpack

import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones.base import Backbone, CommonOptions
from r2flow.backbones.layers import ExactLinear


class Plain(Backbone):
    """Two convolutions, the first one shifted by a linear function of t."""

    def __init__(self, rays: Tensor, base_channels: int = 8, **common: Unpack[CommonOptions]) -> None:
        super().__init__(rays, **common)
        self.first = nn.Conv2d(self.in_channels, base_channels, 3, padding=1)
        self.time = ExactLinear(1, base_channels)
        self.last = nn.Conv2d(base_channels, self.out_channels, 3, padding=1)

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        return self.last(F.silu(self.first(x) + self.time(t[:, None])[:, :, None, None]))
