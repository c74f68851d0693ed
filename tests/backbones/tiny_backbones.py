"""Small backbones of every kind, whose weights are not zero."""

from typing import Any

import torch

from r2flow.backbones import BACKBONES, Backbone, build_backbone
from r2flow.lidar.sensors import build_sensor
from tests.conftest import tiny_options

NAMES = [*BACKBONES, "plain"]  # `plain` states nothing about itself (conftest)
PUBLISHED = ["hdit", "adm_unet", "efficient_unet"]  # with position, ring and dropout
TWO_TIMES = [name for name, kind in BACKBONES.items() if kind.takes_second_time]
ROWS, COLUMNS = 16, 64


def rays(rows: int = ROWS, columns: int = COLUMNS) -> torch.Tensor:
    return build_sensor("hdl64e", rows, columns).rays()


def untrained(
    name: str, in_channels: int = 2, out_channels: int | None = None, second_time: bool = False, **options: Any
) -> Backbone:
    options = {**tiny_options(name), **options}
    return build_backbone(options, rays(), in_channels, out_channels, second_time)


def tiny(name: str, *channels: int | None, **options: Any) -> Backbone:
    model = untrained(name, *channels, **options)
    for parameter in model.parameters():
        if not parameter.any():  # zero at the start: nothing would be seen behind it
            torch.nn.init.normal_(parameter, std=0.1)
    return model.eval()


def image(batch: int = 2, channels: int = 2) -> torch.Tensor:
    return torch.randn(batch, channels, ROWS, COLUMNS)
