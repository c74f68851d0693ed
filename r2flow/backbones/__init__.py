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

# The configurations of conf/backbone, as differences from the constructors' defaults: the paper's five and ours.
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "hdit": {"name": "hdit"},
    "hdit_small": {
        "name": "hdit",
        "base_channels": 64,
        "depths": (1, 1, 2, 2),
        "num_heads": (1, 2, 4, 8),
        "patch": (2, 4),
    },
    "hdit_tiny": {
        "name": "hdit",
        "base_channels": 48,
        "depths": (1, 1, 2),
        "num_heads": (2, 4, 8),
        "time_channels": 128,
        "patch": (2, 4),
    },
    "efficient_unet": {"name": "efficient_unet", "time_channels": 256},
    "efficient_unet_large": {
        "name": "efficient_unet",
        "base_channels": 128,
        "num_residual_blocks": (2, 4, 8, 8),
        "time_channels": 512,
    },
    "adm_unet": {"name": "adm_unet", "time_channels": 256},
    "adm_unet_large": {
        "name": "adm_unet",
        "base_channels": 128,
        "channel_multiplier": (1, 2, 3, 4),
        "time_channels": 512,
    },
}


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
