"""A backbone of three circular convolutions."""

from itertools import pairwise

import torch
from torch import nn

from r2flow.backbones import BACKBONES, Backbone


class ToyBackbone(Backbone):
    def __init__(self, rays, base_channels: int = 16, **common):
        super().__init__(rays, **common)
        self.shift = nn.Linear(2, base_channels)
        sizes = [self.in_channels, base_channels, base_channels, self.out_channels]
        self.layers = nn.ModuleList(
            nn.Conv2d(before, after, 3, padding=1, padding_mode="circular")
            for before, after in pairwise(sizes)
        )

    def velocity(self, t, x, s=None):
        shift = self.shift(torch.stack([t, t * t], dim=1).to(x))[:, :, None, None]
        for layer in self.layers[:-1]:
            x = torch.nn.functional.silu(layer(x) + shift)
        return self.layers[-1](x)


BACKBONES.add("toy_backbone", ToyBackbone)
