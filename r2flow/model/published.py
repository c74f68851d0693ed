"""Published checkpoints, read as ours are: a reader for each system, found in `FORMATS`, and that of R2Flow itself.

R2Flow's files are a dict of cfg, weights, optimizer, lr_scheduler and num_images.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators import Generator
from r2flow.registry import Registry, did_you_mean, lazy

ARCHITECTURES = {"nat_hdit": "hdit"} | {name: name for name in ("hdit", "adm_unet", "efficient_unet")}
BACKBONE = "backbone."  # of a flow's network in the generator


@dataclass(frozen=True)
class Published:
    """A generator of a published file in our terms."""

    config: dict[str, Any]  # `r2flow.generators.build_generator` makes it; the file's own config is under `published`
    weights: dict[str, Tensor]  # of that generator, by our names
    step: int = 0  # optimiser steps taken
    sampler: Mapping[str, Any] | None = None  # name and fields, as published; None for the generator's own
    finish: Callable[[Generator, Mapping[str, Any]], None] | None = None  # called with generator, weights in it, config


class Format(NamedTuple):
    """A published layout of checkpoint files."""

    system: str  # whose it is
    holds: Callable[[Any], bool]  # whether the content of a torch file is of this format
    read: Callable[[Any, Path, bool], Published]  # the generator in it, with averaged or raw weights


@contextmanager
def garbled(path: Path) -> Iterator[None]:
    """Raises `InputError` where the content of a published file lacks a part or has one of another form."""
    try:
        yield
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(f"{path}: the published checkpoint lacks or garbles {error}.") from None


def holds(content: Any) -> bool:
    return isinstance(content, Mapping) and {"cfg", "weights"} <= content.keys() and "ema_weights" not in content


def read(content: Any, path: Path, averaged: bool = True) -> Published:
    """A published flow; the file holds its averaged weights alone."""
    weights = {BACKBONE + name: value for name, value in content["weights"].items()}
    batch = content["cfg"].get("training", {}).get("batch_size", 1)
    step = int(content.get("num_images", 0)) // max(int(batch), 1)
    return Published(published_config(content["cfg"], path), weights, step, {"name": "euler"}, follow_rings)


def sensor_of(name: str, resolution: Sequence[int], limits: Mapping[str, Any]) -> dict[str, Any]:
    """The config of a sensor by the published names of its image's size and of its range limits in metres."""
    rows, columns = (int(n) for n in resolution)
    near, far = (float(limits[name]) for name in ("min_depth", "max_depth"))
    return {"name": name, "rows": rows, "columns": columns, "min_range": near, "max_range": far}


def published_config(cfg: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Our config of a published checkpoint's `cfg`, which holds data, model, flow, training and finetuning."""
    data, model = cfg["data"], cfg["model"]
    return {
        "sensor": {**sensor_of("hdl64e", data["resolution"], data), "rays": "reference"},
        "encoding": {"format": data["data_format"], "reflectance": bool(data["train_reflectance"])},
        "backbone": backbone_of(model, path),
        "data": {
            "name": data["dataset"],
            "reading": {"projection": str(data["projection"]).split("-")[0], "convention": "reference"},
        },
        "published": dict(cfg),
    }


def backbone_of(model: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Our backbone's options of a published config's `model`."""
    architecture = str(model["architecture"])
    if architecture not in ARCHITECTURES:
        raise InputError(
            f"{path}: no backbone for the published architecture {architecture!r}; known: "
            f"{', '.join(ARCHITECTURES)}.{did_you_mean(architecture, ARCHITECTURES)}"
        )
    heads, blocks = model["attn_num_heads"], model["num_residual_blocks"]
    common = {
        "name": ARCHITECTURES[architecture],
        "base_channels": model["base_channels"],
        "time_channels": model["temb_channels"],
        "position": model["coords_encoding"],
        "dropout": model.get("dropout", 0.0),
    }
    if common["name"] == "hdit":
        return {**common, "depths": list(blocks), "num_heads": list(heads)}
    # One config class serves all three in the reference: a U-Net has one number of heads.
    return {
        **common,
        "num_residual_blocks": blocks if isinstance(blocks, int) else list(blocks),
        "channel_multiplier": list(model["channel_multiplier"]),
        "groups": model.get("gn_num_groups", 8),
        "eps": model.get("gn_eps", 1e-6),
        "num_heads": heads if isinstance(heads, int) else list(heads)[-1],
    }


def follow_rings(generator: Generator, config: Mapping[str, Any]) -> None:
    """Let the sensor of unfolded scans look along the rings that the weights carry in `coords`, (1, 2, H, W)."""
    if config["data"]["reading"]["projection"] == "unfolding":
        rings = torch.rad2deg(generator.state_dict()[BACKBONE + "coords"][0, 0, :, 0].double())
        sensor = replace(generator.space.sensor, elevations=tuple(rings.tolist()))
        generator.space = replace(generator.space, sensor=sensor)


class Inert:
    """What stands for an object of a class that is only looked at: it keeps what the pickle says of it."""

    def __init__(self, *arguments: Any) -> None:
        """Nothing is done with the arguments."""


# The classes that a pickled DictConfig names, and the keys of Lightning 1.4's callback states. `weights_only` refuses
# every other.
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
CONTENT, VALUE = "_content", "_val"


def inert() -> Any:
    """While it is entered, `torch.load(weights_only=True)` takes the classes in `NAMES`, each as `Inert`."""
    return torch.serialization.safe_globals([(Inert, name) for name in NAMES])


def plain(value: Any) -> Any:
    """The plain value of an `Inert` config or of one of its nodes; anything else as it is."""
    if not isinstance(value, Inert):
        return value
    kept = vars(value)
    if VALUE in kept:
        return kept[VALUE]
    content = kept.get(CONTENT)
    if isinstance(content, dict):
        return {key: plain(one) for key, one in content.items()}
    return [plain(one) for one in content] if isinstance(content, list) else content


FORMAT = Format("R2Flow", holds, read)

FORMATS: Registry[Format] = Registry(
    "published format",
    r2flow=FORMAT,
    r2dm=lazy("r2flow.systems.diffusion.published:FORMAT"),
    dusty=lazy("r2flow.systems.gan.published:FORMAT"),
    lidargen=lazy("r2flow.systems.score.published:FORMAT"),
    lidm=lazy("r2flow.systems.latent.published:DIFFUSION"),
    lidm_autoencoder=lazy("r2flow.systems.latent.published:FIRST_STAGE"),
)


def format_of(content: Any) -> Format | None:
    """The published format of a torch file's content; None for another one."""
    return next((one for _, one in FORMATS.items() if one.holds(content)), None)
