"""Small backbones of every kind, whose weights are not zero."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from r2flow.backbones import BACKBONES, Backbone
from r2flow.backbones.layers import ExactLinear
from r2flow.lidar.sensors import build_sensor
from tests.conftest import tiny_options

NAMES = [*BACKBONES._entries, "plain"]  # `Plain`, in the table by conftest
PUBLISHED = ["hdit", "adm_unet", "efficient_unet"]  # with position, ring and dropout
TWO_TIMES = [name for name, kind in BACKBONES._entries.items() if kind.takes_second_time]
ROWS, COLUMNS = 16, 64


def rays(rows: int = ROWS, columns: int = COLUMNS) -> torch.Tensor:
    return build_sensor("hdl64e", rows, columns).rays()


def untrained(
    name: str,
    in_channels: int = 2,
    out_channels: int | None = None,
    second_time: bool = False,
    **options: Any,
) -> Backbone:
    times = {"second_time": True} if second_time else {}
    common = {"in_channels": in_channels, "out_channels": out_channels, **times}
    return BACKBONES.build({**tiny_options(name), **options}, rays(), **common)


def tiny(name: str, *channels: int | None, **options: Any) -> Backbone:
    model = untrained(name, *channels, **options)
    for parameter in model.parameters():
        if not parameter.any():  # zero at the start: nothing would be seen behind it
            torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def image(batch: int = 2, channels: int = 2) -> torch.Tensor:
    return torch.randn(batch, channels, ROWS, COLUMNS)


class Plain(Backbone):
    """Two convolutions, the first one shifted by a linear function of t.

    It states nothing about itself: what any new backbone may be.
    """

    def __init__(self, rays: Tensor, base_channels: int = 8, **common: Any) -> None:
        super().__init__(rays, **common)
        self.first = nn.Conv2d(self.in_channels, base_channels, 3, padding=1)
        self.time = ExactLinear(1, base_channels)
        self.last = nn.Conv2d(base_channels, self.out_channels, 3, padding=1)

    def velocity(self, t: Tensor, x: Tensor, s: Tensor | None = None) -> Tensor:
        return self.last(F.silu(self.first(x) + self.time(t[:, None])[:, :, None, None]))
