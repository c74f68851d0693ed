"""Checkpoints: written whole, read without running code, and turned into models."""

import hashlib
import json
import os
import pickle
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from torch import Tensor, nn

from r2flow.data.augment import upgraded
from r2flow.errors import InputError
from r2flow.files import atomic_write
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.published import published_cfg, published_config, published_rings, published_step
from r2flow.stages import build_parts

FOLDER = "checkpoints"
PREFIX = "velocity."  # of the backbone's weights in a LightningModule


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

    @property
    def distilled_steps(self) -> int | None:
        """k of a k-TD flow, which takes k steps; None of the others."""
        stage = self.config.get("stage") or {}
        return int(stage["steps"]) if stage.get("name") == "distill" else None


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoints, flushed to the disk beside the old one before they take its place."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: Any | None = None
    ) -> None:
        """Write a checkpoint whole; whatever happens, the ones before it stay.

        Raises:
            InputError: the disk is full, the folder cannot be written, ...
        """
        try:
            with atomic_write(Path(path)) as file:
                torch.save(checkpoint, file)
        except (OSError, RuntimeError) as error:
            # torch's writer ends in a RuntimeError of its own when the file's write fails.
            cause = error.__context__ if isinstance(error, RuntimeError) else error
            if not isinstance(cause, OSError):
                raise
            raise InputError(
                f"{path} cannot be written: {cause.strerror or cause}. The checkpoints before it are whole; "
                "mend that and give the same command again."
            ) from None

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
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}.") from None
    except Exception:  # torch's reader raises nearly anything on bytes that are none of its own
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
    content = read_safetensors(path) if path.suffix == ".safetensors" else read_checkpoint(path)
    if "cfg" in content and "weights" in content:
        config, weights = published_config(content["cfg"], path), content["weights"]
        step, kind = published_step(content), "published"
    elif "config" in content and "state_dict" in content:
        config, step, kind = dict(content["config"]), int(content.get("global_step", 0)), "r2flow"
        if "data" in config:
            config["data"] = upgraded(config["data"])
        state = content["state_dict"] if averaged else content.get("current_model_state", content["state_dict"])
        weights = {name.removeprefix(PREFIX): value for name, value in state.items() if name.startswith(PREFIX)}
    else:
        raise InputError(
            f"{path} is a torch file but not a checkpoint of a flow: it has neither 'config' and 'state_dict' (ours) "
            f"nor 'cfg' and 'weights' (published); found {', '.join(map(repr, list(content)[:6]))}."
        )
    parts = build_parts(config)
    load_weights(parts.backbone, weights, path)
    model = parts.backbone.eval().requires_grad_(False).to(device)
    sensor = parts.sensor
    if "published" in config and config["data"]["projection"] == "unfolding":
        sensor = published_rings(sensor, weights["coords"])
    return Checkpoint(model, sensor, parts.encoding, config, step, path, kind)


def weights_hash(checkpoint: Checkpoint) -> str:
    """What a flow is, in 16 hex digits: its averaged weights and what its images mean, whatever file they came from."""
    meaning = {key: checkpoint.config[key] for key in ("sensor", "encoding")}
    digest = hashlib.sha256(json.dumps(meaning, sort_keys=True).encode())
    for name, value in sorted(checkpoint.model.state_dict().items()):
        digest.update(f"{name} {tuple(value.shape)} {value.dtype}".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()[:16]


def read_safetensors(path: Path) -> dict[str, Any]:
    """Weights and config of a `.safetensors` of ours, in the shape of our other checkpoints.

    Raises:
        InputError: not a safetensors file, or one without our config.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            notes = file.metadata() or {}
            weights = {f"{PREFIX}{name}": file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        return {"config": json.loads(notes["config"]), "global_step": int(notes["step"]), "state_dict": weights}
    except (SafetensorError, OSError, ValueError) as error:
        raise InputError(f"{path} is not a safetensors file, or a damaged one: {error}.") from None
    except KeyError as error:
        raise InputError(f"{path} holds weights but no r2flow config (no {error} in its metadata).") from None


def save_checkpoint(checkpoint: Checkpoint, path: str | Path) -> None:
    """Write a model with its config: `.safetensors` in our format, `.pth` in the published one, weights bit-equal.

    Raises:
        InputError: another ending, or a config that the published format cannot say.
    """
    path = Path(path)
    weights = {name: value.detach().cpu().contiguous() for name, value in checkpoint.model.state_dict().items()}
    if path.suffix == ".safetensors":
        from safetensors.torch import save

        notes = {"format": "r2flow", "config": json.dumps(checkpoint.config), "step": str(checkpoint.step)}
        data = save(weights, metadata=notes)
        with atomic_write(path) as file:
            file.write(data)
    elif path.suffix == ".pth":
        cfg = published_cfg(checkpoint.config)
        images = checkpoint.step * int(cfg.get("training", {}).get("batch_size", 1))
        content = {"cfg": cfg, "weights": weights, "optimizer": {}, "lr_scheduler": {}, "num_images": images}
        with atomic_write(path) as file:
            torch.save(content, file)
    else:
        raise InputError(f"{path}: give .safetensors for our format or .pth for the published one.")


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
