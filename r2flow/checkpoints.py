"""Checkpoints: written whole, read without running code, and turned into models."""

import io
import os
import pickle
import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor, nn

from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.stages import build_parts

FOLDER = "checkpoints"


@dataclass(frozen=True)
class Checkpoint:
    """A trained flow, ready for `model(t, x)`.

    Attributes:
        model: The backbone with its averaged weights, in eval mode.
        sensor: What its images look through.
        encoding: Between its model space and metres.
        config: The config it was trained with, as plain dicts.
        step: Optimiser steps taken.
        path: Where it was read from.
        format: `r2flow`, or `published` for the reference implementation's files.
    """

    model: nn.Module
    sensor: Sensor
    encoding: Encoding
    config: dict[str, Any]
    step: int
    path: Path
    format: str


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoints, flushed to the disk beside the old one before they take its place."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        with atomic_write(Path(path)) as file:
            torch.save(checkpoint, file)

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        return read_checkpoint(path, map_location)


def step_of(path: Path) -> int:
    """The step in a checkpoint's file name, -1 where there is none."""
    match = re.search(r"step-(\d+)", path.name)
    return int(match.group(1)) if match else -1


def checkpoints_of(run: str | Path) -> list[Path]:
    """The checkpoints of a run folder, the latest first."""
    found = [path for path in Path(run, FOLDER).glob("step-*.ckpt") if not path.is_symlink()]
    return sorted(found, key=step_of, reverse=True)


def find_checkpoint(path: str | Path) -> Path:
    """A checkpoint file, or the latest one of a run folder.

    Raises:
        InputError: nothing is there.
    """
    path = Path(path).expanduser()
    if path.is_dir():
        found = checkpoints_of(path) or sorted(path.glob("step-*.ckpt"), key=step_of, reverse=True)
        if not found:
            raise InputError(f"{path} holds no checkpoint ({FOLDER}/step-*.ckpt). Has a run been started there?")
        return found[0]
    if not path.is_file():
        raise InputError(f"no checkpoint at {path}. Give a checkpoint file or a run folder.")
    return path


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """The dict in a checkpoint file. Only tensors and plain values are read: a file cannot run code.

    Raises:
        InputError: not a checkpoint, a damaged one, or one that holds more than plain values.
    """
    try:
        content = torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:
        if "Unsupported global" in str(error) or "Unsupported class" in str(error):
            name = re.search(r"GLOBAL (\S+)", str(error))
            held = f" ({name.group(1)})" if name else ""
            raise InputError(
                f"{path} is refused: it holds objects that would run code when loaded{held}, not only tensors and "
                "plain values. Ask its author for a weights-only file."
            ) from None
        raise InputError(_not_a_checkpoint(path)) from None
    except (RuntimeError, EOFError, OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        if isinstance(error, OSError) and not isinstance(error, io.UnsupportedOperation):
            raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
        raise InputError(_not_a_checkpoint(path)) from None
    if not isinstance(content, dict):
        raise InputError(_not_a_checkpoint(path))
    return content


def _not_a_checkpoint(path: str | Path) -> str:
    size = Path(path).stat().st_size
    return f"{path} is not a checkpoint, or a damaged one ({size} bytes). Give a .ckpt of r2flow or a published .pth."


def load_checkpoint(path: str | Path, device: str | torch.device = "cpu", averaged: bool = True) -> Checkpoint:
    """A model from a checkpoint file or run folder, of ours or of the published R2Flow format.

    Args:
        averaged: Take the averaged weights, which a model is judged by; False takes the raw ones of a run
            of ours.

    Raises:
        InputError: nothing usable is there, or its weights do not fit its config.
    """
    path = find_checkpoint(path)
    content = read_checkpoint(path)
    if "cfg" in content and "weights" in content:
        config, weights, step = published_config(content["cfg"], path), content["weights"], _published_step(content)
        kind = "published"
    elif "config" in content and "state_dict" in content:
        config, step, kind = content["config"], int(content.get("global_step", 0)), "r2flow"
        state = content["state_dict"] if averaged else content.get("current_model_state", content["state_dict"])
        prefix = "velocity."
        weights = {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
    else:
        raise InputError(
            f"{path} is a torch file but not a checkpoint of a flow: it has neither 'config' and 'state_dict' (ours) "
            f"nor 'cfg' and 'weights' (published); found {', '.join(map(repr, list(content)[:6]))}."
        )
    parts = build_parts(config)
    load_weights(parts.backbone, weights, path)
    model = parts.backbone.eval().requires_grad_(False).to(device)
    return Checkpoint(model, parts.sensor, parts.encoding, config, step, path, kind)


def load_weights(model: nn.Module, weights: Mapping[str, Tensor], path: Path) -> None:
    """Fill a model, every name and shape accounted for.

    Raises:
        InputError: the first name or shape that differs.
    """
    own = model.state_dict()
    missing, surplus = sorted(own.keys() - weights.keys()), sorted(weights.keys() - own.keys())
    if missing or surplus:
        raise InputError(
            f"the weights in {path} do not fit its config: {len(missing)} names missing {missing[:2]}, "
            f"{len(surplus)} unknown {surplus[:2]}."
        )
    for name, value in own.items():
        if weights[name].shape != value.shape:
            raise InputError(
                f"the weights in {path} do not fit its config: '{name}' has shape {tuple(weights[name].shape)}, "
                f"the config makes it {tuple(value.shape)}."
            )
    model.load_state_dict(dict(weights))


PUBLISHED_POSITIONS = {
    "learnable_embedding": "learnable",
    "fourier_features": "fourier_features",
    "polar_coordinates": "polar",
    "spherical_harmonics": "spherical_harmonics",
    None: "none",
}


def published_config(cfg: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Our config of a published R2Flow checkpoint: its `cfg` of data, model, flow, training and finetuning.

    Raises:
        InputError: a part that is missing or unknown to us.
    """
    try:
        data, model = cfg["data"], cfg["model"]
        rows, columns = (int(n) for n in data["resolution"])
        projection = str(data["projection"]).split("-")[0]
        architecture = model["architecture"]
        backbone = _published_backbone(model, architecture, path)
        return {
            "sensor": {
                "name": "hdl64e",
                "rows": rows,
                "columns": columns,
                "min_range": float(data["min_depth"]),
                "max_range": float(data["max_depth"]),
                "rays": "reference",
            },
            "encoding": {"format": data["data_format"], "reflectance": bool(data["train_reflectance"])},
            "backbone": backbone,
            "data": {"name": data["dataset"], "projection": projection, "convention": "reference"},
            "published": dict(cfg),
        }
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: the published config lacks or garbles {error}.") from None


def _published_backbone(model: Mapping[str, Any], architecture: str, path: Path) -> dict[str, Any]:
    heads, blocks = model["attn_num_heads"], model["num_residual_blocks"]
    if architecture in ("nat_hdit", "hdit"):
        return {
            "name": "hdit",
            "base_channels": model["base_channels"],
            "depths": list(blocks),
            "num_heads": list(heads),
            "time_channels": model["temb_channels"],
            "position": PUBLISHED_POSITIONS[model["coords_encoding"]],
            "dropout": model.get("dropout", 0.0),
        }
    raise InputError(f"{path}: no backbone for the published architecture {architecture!r}; known: nat_hdit.")


def _published_step(content: Mapping[str, Any]) -> int:
    batch = content["cfg"].get("training", {}).get("batch_size", 1)
    return int(content.get("num_images", 0)) // max(int(batch), 1)
