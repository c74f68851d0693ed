"""Networks v(t, x) and u(x, t, s) by name, and their configurations in conf/backbone."""

from typing import Any

from torch import Tensor

from r2flow.backbones.adm_unet import ADMUNet
from r2flow.backbones.base import Backbone
from r2flow.backbones.efficient_unet import EfficientUNet
from r2flow.backbones.hdit import HDiT
from r2flow.backbones.local import Local
from r2flow.backbones.vit import ViT
from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options, Registry, presets
from r2flow.lidar.sensors import SENSORS


class _Backbones(Registry[type[Backbone]]):
    def build(  # type: ignore[override]
        self,
        options: str | Options,
        rays: Tensor | None = None,
        *,
        shape: tuple[int, int, int] | None = None,
        **given: Any,
    ) -> Backbone:
        """Build a backbone by name or options, as in conf/backbone, for images of some rays.

        Args:
            rays: Elevation and azimuth in radians, (2, H, W).
            shape: Instead of rays: (C, H, W) of images of an HDL-64E.
            given: Further options of `Backbone`, such as in_channels.
        """
        if shape is not None:
            rays = SENSORS["hdl64e"].resized(*shape[1:]).rays()
            given["in_channels"] = shape[0]
        return super().build({**self.options(options), **given}, rays)


BACKBONES = _Backbones(
    "backbone", hdit=HDiT, adm_unet=ADMUNet, efficient_unet=EfficientUNet, vit=ViT, local=Local
)


def build_backbone(
    options: Options | None,
    rays: Tensor,
    in_channels: int,
    out_channels: int | None = None,
    second_time: bool = False,
) -> Backbone:
    """Build the backbone `options["name"]`, as in conf/backbone.

    Args:
        rays: Elevation and azimuth of every pixel in radians, (2, H, W).
        in_channels: Channels of the image and of a condition.
        out_channels: None means as many.
    """
    if options is None:
        raise InputError(
            "stage.parent names a run without a backbone: leave it out, or name a flow."
        )
    given: Config = {
        "in_channels": in_channels,
        "out_channels": out_channels or in_channels,
    }
    if second_time:  # a plug-in may have one time only
        given["second_time"] = True
    return BACKBONES.build(options, rays, **given)


def configurations() -> Registry[Config]:
    """Options for `build_backbone`: conf/backbone/*.yaml, and the defaults of backbones without a
    file.
    """
    defaults = {name: {"name": name} for name in BACKBONES}
    return Registry("backbone configuration", **{**defaults, **presets("backbone")})
