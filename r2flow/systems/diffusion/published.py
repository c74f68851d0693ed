"""The published R2DM checkpoints.

A dict of cfg, weights, ema_weights, optimizer, lr_scheduler and global_step.
"""

from pathlib import Path
from typing import Any

from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options
from r2flow.model.published import BACKBONE, Format, Published, has_keys, rings_of
from r2flow.model.published import published_config as flow_config

_RANGES = {"log_depth": "logscale", "inverse_depth": "inverse", "depth": "metric"}
_PREDICTIONS = {"eps": "eps", "v": "v", "x_0": "x"}
_NETWORK = "model."  # prefix of the network's weights in the file; other entries are empty


def _read_r2dm(content: Any, path: Path, averaged: bool = True) -> Published:
    """Load a published diffusion, sampled by 256 ancestral steps as in its scripts."""
    config = _published_config(content["cfg"])
    weights = {}
    for name, value in content["ema_weights" if averaged else "weights"].items():
        if name.startswith(_NETWORK):
            weights[BACKBONE + name.removeprefix(_NETWORK)] = value
    step = int(content.get("global_step", 0))
    rings = rings_of(config, weights)
    return Published(config, weights, step, {"name": "ddpm", "steps": 256}, rings)


def _published_config(cfg: Options) -> Config:
    """Convert a published checkpoint's `cfg` (data, model, diffusion, training) to our config."""
    diffusion = cfg["diffusion"]
    # The limits are class attributes in the published code, not saved.
    data = {"min_depth": 1.45, "max_depth": 80.0, **cfg["data"]}
    if diffusion["timestep_type"] != "continuous" or not data["train_depth"]:
        raise InputError(
            "only diffusions of range in continuous time are read, which its config does not "
            "describe."
        )
    data["data_format"] = _RANGES[data["depth_format"]]
    config = flow_config({**cfg, "data": data})
    config["encoding"]["limits"] = "open"
    config["generator"] = {
        "name": "diffusion",
        "prediction": _PREDICTIONS[diffusion["prediction_type"]],
        "schedule": {"name": diffusion["noise_schedule"]},
    }
    return {**config, "published": dict(cfg)}


FORMAT = Format("R2DM", has_keys("cfg", "weights", "ema_weights"), _read_r2dm)
