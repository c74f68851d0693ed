"""Velocity estimators v(t, x), by name: forward(t, x) -> v and nothing else."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from r2flow.backbones.adm_unet import ADMUNet
from r2flow.backbones.base import Backbone
from r2flow.backbones.efficient_unet import EfficientUNet
from r2flow.backbones.hdit import HDiT
from r2flow.registry import Registry

BACKBONES: Registry[type[Backbone]] = Registry("backbone", hdit=HDiT, adm_unet=ADMUNet, efficient_unet=EfficientUNet)


def build_backbone(options: Mapping[str, Any], rays: Tensor, channels: int) -> Backbone:
    """The backbone `options["name"]` for images of `channels` channels seen along `rays` (2, H, W).

    Args:
        options: `name` and keyword options of the constructor, as in conf/backbone/*.yaml.
        rays: Elevation and azimuth of every pixel in radians.
        channels: Channels of the image.

    Raises:
        InputError: an unknown name or option, or a shape that the backbone cannot take.
    """
    return BACKBONES.build({**options, "in_channels": channels}, rays)
