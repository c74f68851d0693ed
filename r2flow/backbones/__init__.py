"""Networks v(t, x) and u(x, t, s) by name, and their configurations in conf/backbone."""

from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import yaml
from torch import Tensor

from r2flow.backbones.adm_unet import ADMUNet
from r2flow.backbones.base import Backbone
from r2flow.backbones.efficient_unet import EfficientUNet
from r2flow.backbones.hdit import HDiT
from r2flow.backbones.local import Local
from r2flow.errors import check
from r2flow.registry import Registry

BACKBONES: Registry[type[Backbone]] = Registry(
    "backbone", hdit=HDiT, adm_unet=ADMUNet, efficient_unet=EfficientUNet, local=Local
)


def build_backbone(
    options: Mapping[str, Any],
    rays: Tensor,
    in_channels: int,
    out_channels: int | None = None,
    second_time: bool = False,
) -> Backbone:
    """Build the backbone `options["name"]`, as in conf/backbone, along rays (elevation, azimuth) in radians, (2, H, W).

    `in_channels` includes the channels of a condition; `out_channels` None means as many.
    """
    check(options is not None, "stage.init names a run without a backbone: leave it out, or name a flow.")
    wanted = {"in_channels": in_channels, "out_channels": out_channels, "second_time": second_time or None}
    given = {name: value for name, value in wanted.items() if value is not None}  # a plug-in may not know the others
    built: Backbone = BACKBONES.build({**options, **given}, rays)
    check(any(True for _ in built.parameters()), f"a {type(built).__name__} has no weights to learn.")
    return built


def configurations() -> Registry[dict[str, Any]]:
    """Options for `build_backbone`: conf/backbone/*.yaml, and the defaults of backbones without a file."""
    folder = files("r2flow") / "conf" / "backbone"
    written = sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))

    def read(name: str) -> dict[str, Any]:
        options = yaml.safe_load((folder / f"{name}.yaml").read_text())
        bases = [read(base) for base in options.pop("defaults", []) if base != "_self_"]
        return {key: value for part in (*bases, options) for key, value in part.items()}

    defaults = {name: {"name": name} for name in BACKBONES}
    return Registry("backbone configuration", **{**defaults, **{name: read(name) for name in written}})
