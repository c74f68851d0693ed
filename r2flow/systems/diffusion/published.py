"""The published R2DM checkpoints: a dict of cfg, weights, ema_weights, optimizer, lr_scheduler and global_step."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from r2flow.errors import InputError
from r2flow.model.published import BACKBONE, Format, Published, backbone_of, follow_rings

RANGES = {"log_depth": "logscale", "inverse_depth": "inverse", "depth": "metric"}
PREDICTIONS = {"eps": "eps", "v": "v", "x_0": "x"}
NETWORK = "model."  # of the network's weights in the file; what lies beside it is empty
MIN_RANGE, MAX_RANGE = 1.45, 80.0  # metres; the published code has them as class attributes and does not save them


def holds(content: Any) -> bool:
    return isinstance(content, Mapping) and {"cfg", "weights", "ema_weights"} <= content.keys()


def read(content: Any, path: Path, averaged: bool = True) -> Published:
    """A published diffusion, sampled by 256 ancestral steps, as its scripts do."""
    config = published_config(content["cfg"], path)
    state = content["ema_weights" if averaged else "weights"]
    weights = {
        BACKBONE + name.removeprefix(NETWORK): value for name, value in state.items() if name.startswith(NETWORK)
    }
    sampler = {"name": "ddpm", "steps": 256}
    return Published(config, weights, int(content.get("global_step", 0)), sampler, follow_rings)


def published_config(cfg: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Our config of a published checkpoint's `cfg`, which holds data, model, diffusion and training."""
    try:
        data, model, diffusion = cfg["data"], cfg["model"], cfg["diffusion"]
        rows, columns = (int(n) for n in data["resolution"])
        if diffusion["timestep_type"] != "continuous":
            raise InputError(f"{path}: its diffusion is of discrete steps; only those of continuous time are read.")
        if not data["train_depth"]:
            raise InputError(f"{path}: it makes reflectance without range, of which no scan can be made.")
        return {
            "sensor": {
                "name": "hdl64e",
                "rows": rows,
                "columns": columns,
                "min_range": float(data.get("min_depth", MIN_RANGE)),
                "max_range": float(data.get("max_depth", MAX_RANGE)),
                "rays": "reference",
            },
            "encoding": {
                "format": RANGES[data["depth_format"]],
                "reflectance": bool(data["train_reflectance"]),
                "limits": "open",
            },
            "backbone": backbone_of(model, path),
            "generator": {
                "name": "diffusion",
                "prediction": PREDICTIONS[diffusion["prediction_type"]],
                "schedule": {"name": diffusion["noise_schedule"]},
            },
            "data": {
                "name": data["dataset"],
                "reading": {"projection": str(data["projection"]).split("-")[0], "convention": "reference"},
            },
            "published": dict(cfg),
        }
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: the published config lacks or garbles {error}.") from None


FORMAT = Format("R2DM", holds, read)
