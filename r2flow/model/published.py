"""Published checkpoints: the registry `FORMATS` of readers, and the reader of R2Flow's files.

An R2Flow file is a dict of cfg, weights, optimizer, lr_scheduler and num_images.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from r2flow.base.registry import Config, Options, Registry, lazy
from r2flow.model.config import ModelConfig

BACKBONE = "backbone."  # prefix of a flow's network in the generator


@dataclass(frozen=True)
class Scans:
    """The group `data` of a published config."""

    dataset: str
    projection: str
    resolution: Sequence[int]
    data_format: str
    train_reflectance: bool
    min_depth: float
    max_depth: float

    @classmethod
    def of(cls, group: Options) -> "Scans":
        """The keys of a published config that r2flow has, too."""
        return cls(**{one.name: group[one.name] for one in fields(cls)})


@dataclass(frozen=True)
class Published:
    """A generator of a published file, converted to r2flow's names."""

    # config for `r2flow.generators.build_generator`; the file's config is under `published`
    config: dict[str, Any]
    weights: dict[str, Tensor]  # the generator's weights by r2flow's names
    step: int = 0  # optimiser steps taken
    # published sampler, name and fields; None: the generator's default
    sampler: Options | None = None
    # of the rows of unfolded scans in radians, (H,); None: the sensor's
    elevations: Tensor | None = None
    fixed: bool = False  # whether it is distilled for this sampler alone


class Format(NamedTuple):
    """A published layout of checkpoint files."""

    system: str  # name of the system
    holds: Callable[[Any], bool]  # whether the content of a torch file has this format
    # convert the content, with averaged or raw weights
    read: Callable[[Any, Path, bool], Published]


def has_keys(*keys: str, but: str | None = None) -> Callable[[Any], bool]:
    """Whether the content of a file is a dict with these keys, without another."""
    return lambda content: (
        isinstance(content, Mapping) and {*keys} <= content.keys() and but not in content
    )


def read(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read a published R2Flow checkpoint, which has averaged weights only; a k-TD draws in its k
    Euler steps.
    """
    cfg = content["cfg"]
    config = published_config(cfg)
    k = ModelConfig(config).stage.steps  # None: not distilled
    weights = {BACKBONE + name: value for name, value in content["weights"].items()}
    training = cfg.get("training", {})
    batch_size = int(training.get("batch_size", 1))
    step = int(content.get("num_images", 0)) // max(batch_size, 1)
    sampler = {"name": "euler", "steps": k}
    return Published(config, weights, step, sampler, rings_of(config, weights), k is not None)


def sensor_of(name: str, resolution: Sequence[int], limits: Options) -> Config:
    """Sensor config from the published image size and range limits in metres."""
    rows, columns = (int(n) for n in resolution)
    near, far = (float(limits[name]) for name in ("min_depth", "max_depth"))
    return {"name": name, "rows": rows, "columns": columns, "min_range": near, "max_range": far}


def published_config(cfg: Options) -> Config:
    """Convert a published checkpoint's `cfg` (data, model, flow, training, finetuning) to an r2flow
    config.
    """
    scans = Scans.of(cfg["data"])
    tuning = cfg.get("finetuning")
    stage = {}  # of an older file, which does not say it
    if tuning:
        stage = {"name": "reflow" if tuning.get("init_ckpt") else "rectify"}
        if k := tuning.get("k_distil"):
            stage = {"name": "distill", "steps": k}
    return {
        "stage": stage,
        "sensor": {**sensor_of("hdl64e", scans.resolution, vars(scans)), "rays": "reference"},
        "encoding": {"format": scans.data_format, "reflectance": bool(scans.train_reflectance)},
        "backbone": _backbone_of(cfg["model"]),
        "data": {
            "name": scans.dataset,
            "reading": {
                "projection": str(scans.projection).split("-")[0],
                "convention": "reference",
            },
        },
        "published": dict(cfg),
    }


def _backbone_of(model: Options) -> Config:
    """Backbone options from a published config's `model`."""
    heads = model["attn_num_heads"]
    blocks = model["num_residual_blocks"]
    common = {
        "name": str(model["architecture"]).removeprefix("nat_"),
        "base_channels": model["base_channels"],
        "time_channels": model["temb_channels"],
        "position": model["coords_encoding"],
        "dropout": model.get("dropout", 0.0),
    }
    if common["name"] == "hdit":
        return {**common, "depths": list(blocks), "num_heads": list(heads)}
    # The reference has one config class for all three architectures: a U-Net has a single number of
    # heads.
    return {
        **common,
        "num_residual_blocks": blocks if isinstance(blocks, int) else list(blocks),
        "channel_multiplier": list(model["channel_multiplier"]),
        "groups": model.get("gn_num_groups", 8),
        "eps": model.get("gn_eps", 1e-6),
        "num_heads": heads if isinstance(heads, int) else list(heads)[-1],
    }


def rings_of(config: Options, weights: Mapping[str, Tensor]) -> Tensor | None:
    """The elevations of the rows of unfolded scans, from the weights' `coords`, (1, 2, H, W)."""
    reading = ModelConfig(config).data.reading
    unfolded = reading is not None and reading.projection == "unfolding"
    return weights[BACKBONE + "coords"][0, 0, :, 0] if unfolded else None


class _Inert:
    """Placeholder for unpickled objects: keeps the pickled state without running code."""

    def __init__(self, *arguments: Any) -> None:
        """Ignore the arguments."""


# Classes in a pickled DictConfig and in Lightning 1.4's callback states. `weights_only` refuses all
# others.
NAMES = (
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    *(f"omegaconf.base.{name}" for name in ("Metadata", "ContainerMetadata")),
    *(f"omegaconf.nodes.{name}Node" for name in ("Any", "Boolean", "Float", "Integer", "String")),
    "typing.Any",
    "collections.defaultdict",
    *(f"builtins.{name}" for name in ("bool", "dict", "float", "int", "list", "str")),
    "pytorch_lightning.callbacks.model_checkpoint.ModelCheckpoint",
)


def inert() -> Any:
    """Context in which `torch.load(weights_only=True)` reads the classes in `NAMES` as `_Inert`."""
    return torch.serialization.safe_globals([(_Inert, name) for name in NAMES])


def plain(value: Any) -> Any:
    """Convert an `_Inert` config or node to a plain value; other values are returned unchanged."""
    if not isinstance(value, _Inert):
        return value
    content = vars(value).get("_val", vars(value).get("_content"))
    if isinstance(content, dict):
        return {key: plain(node) for key, node in content.items()}
    return [plain(node) for node in content] if isinstance(content, list) else content


FORMATS: Registry[Format] = Registry(
    "published format",
    r2flow=Format("R2Flow", has_keys("cfg", "weights", but="ema_weights"), read),
    r2dm=lazy("r2flow.systems.diffusion.published:FORMAT"),
    dusty=lazy("r2flow.systems.gan.published:FORMAT"),
    lidargen=lazy("r2flow.systems.score.published:FORMAT"),
    lidm=lazy("r2flow.systems.latent.published:DIFFUSION"),
    lidm_autoencoder=lazy("r2flow.systems.latent.published:FIRST_STAGE"),
)
