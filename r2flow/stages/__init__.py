"""LightningModules, one for each stage, and the one place where a config becomes one."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import nn

from r2flow.backbones import build_backbone
from r2flow.data.augment import Augmentation
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding, build_encoding
from r2flow.lidar.sensors import Convention, Sensor, build_sensor
from r2flow.registry import Registry, check_options
from r2flow.stages.rectify import RectifiedFlow
from r2flow.stages.reflow import Distill, Reflow

STAGES: Registry[type[RectifiedFlow]] = Registry("stage", rectify=RectifiedFlow, reflow=Reflow, distill=Distill)


@dataclass(frozen=True)
class Parts:
    """What a config describes of a model: its sensor, its encoding and its backbone."""

    sensor: Sensor
    encoding: Encoding
    backbone: nn.Module


def build_parts(config: Mapping[str, Any]) -> Parts:
    """Sensor, encoding and backbone of a config with the keys `sensor`, `encoding` and `backbone`.

    Raises:
        InputError: a key is missing, a name is unknown, an option is, or the sizes do not fit together.
    """
    for key in ("sensor", "encoding", "backbone"):
        if key not in config:
            raise InputError(f"the config has no '{key}'.")
    options = dict(config["sensor"])
    convention: Convention = options.pop("rays", "centre")
    check_options("sensor", build_sensor, options)
    sensor = build_sensor(**options)
    encoding = build_encoding(config["encoding"], sensor)
    rays = sensor.rays(convention)
    return Parts(sensor, encoding, build_backbone(config["backbone"], rays, encoding.channels))


def check_roll(augment: Augmentation, backbone: nn.Module) -> None:
    """Refuse to turn scans for a backbone that learns a vector for each direction.

    Raises:
        InputError: data.augment.roll with such a backbone.
    """
    if augment.roll and getattr(backbone, "learns_directions", False):
        raise InputError(
            "data.augment.roll makes all directions alike, but this backbone learns a vector for each, as "
            "backbone.position=learnable (the paper's APE) does; give backbone.position=none, which sees differences "
            "in azimuth alone, or leave roll out."
        )


def build_stage(config: Mapping[str, Any], backbone: nn.Module) -> RectifiedFlow:
    """The LightningModule of a config's `stage`, around a backbone; it carries the config into its checkpoints."""
    options = {"batch_size": config["data"]["batch_size"], "seed": config["seed"], **config["stage"]}
    options.pop("init", None)  # the backbone has its weights already
    stage = STAGES.build(options, backbone)
    on_pairs = config["data"]["name"] == "pairs"
    if stage.needs_pairs and not on_pairs:
        raise InputError(f"stage={options['name']} learns from pairs: give data=pairs, found {config['data']['name']}.")
    if on_pairs and not stage.needs_pairs:
        raise InputError(f"stage={options['name']} learns from scans, and data=pairs has none; give stage=reflow.")
    stage.config = dict(config)
    return stage
