"""LiDM's published checkpoints: Lightning files of a latent diffusion with its autoencoder, or of an autoencoder.

Image size and width of attention heads are read from the published `config.yaml` next to a file; without it they are
64 x 1024 and 32, as in all published files.
"""

import logging
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from r2flow.errors import InputError, check
from r2flow.files import telling
from r2flow.lidar.encoding import ShiftedLog
from r2flow.lidar.sensors import build_sensor
from r2flow.model.published import Format, Published
from r2flow.systems.latent.autoencoder import UP

log = logging.getLogger(__name__)

UNET, AUTOENCODER, AVERAGE = "model.diffusion_model.", "first_stage_model.", "model_ema."
FIRST, CODES = "encoder.conv_in.weight", "quantize.embedding.weight"
STRIDES = {kernel: list(stride) for stride, kernel in UP.items()}
SIZE, RANGES, VIEW, HEAD = (64, 1024), (1.0, 56.0), (3, -25), 32
# Options of config.yaml that would change the images, but no weight's shape; all published files have these.
USUAL = {
    "lib_name": "lidm", "num_heads": -1, "use_new_attention_order": False, "parameterization": "eps",
    "beta_schedule": "linear", "scale_factor": 1.0, "scale_by_std": False,
}  # fmt: skip


def _state(content: Any, averaged: bool = False) -> Mapping[str, Tensor]:
    """Weights, or their averages where a file has them; names of averages have no dots."""
    found = content.get("state_dict") if isinstance(content, Mapping) else None
    state = found if isinstance(found, Mapping) else {}
    averages = {name: AVERAGE + name.removeprefix("model.").replace(".", "") for name in state if averaged}
    return {name: state.get(averages.get(name), value) for name, value in state.items()}


def holds_diffusion(content: Any) -> bool:
    state = _state(content)
    return UNET + "time_embed.0.weight" in state and AUTOENCODER + FIRST in state


def holds_autoencoder(content: Any) -> bool:
    return {FIRST, CODES} <= _state(content).keys()


def read_diffusion(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read a published latent diffusion."""
    state, notes = _state(content, averaged), _notes(path)
    check(not _within(state, "cond_stage_model."), f"{path} is conditional: only LiDM's unconditional models are read.")
    weights = {name: value for name, value in state.items() if name.startswith((UNET, AUTOENCODER))}
    params = (notes.get("model") or {}).get("params") or {}
    unet = params.get("unet_config", {}).get("params", {})
    options = {**USUAL, **({"lib_name": "ldm"} if unet else {}), **params, **unet}  # ldm: without circular convolutions
    if other := {name: options[name] for name, usual in USUAL.items() if options[name] != usual}:
        raise InputError(f"{path}: its config.yaml has {other}, and only LiDM's own form is read.")
    betas, steps = state["betas"].float().numpy(), state["betas"].double().sqrt().diff()
    straight = torch.allclose(steps, steps.mean(), rtol=1e-2)
    check(straight, f"{path}: the square roots of its betas are not evenly spaced, as LiDM's are.")
    generator = {
        "name": "latent_diffusion",
        "autoencoder": _autoencoder(_within(weights, AUTOENCODER)),
        "unet": {**_unet(_within(weights, UNET)), "head_channels": int(unet.get("num_head_channels", HEAD))},
        "schedule": {
            "name": "square_root_linear",
            "first": float(str(betas[0])),  # the shortest decimal that is the same float32
            "last": float(str(betas[-1])),
            "steps": len(betas),
        },
    }
    return Published(_config(generator, path, notes), weights, int(content.get("global_step", 0)))


def read_autoencoder(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read a published autoencoder, without its discriminator."""
    state = _state(content, averaged)
    config = _config({"name": "vq_autoencoder", "autoencoder": _autoencoder(state)}, path, _notes(path))
    named = {AUTOENCODER + name: value for name, value in state.items() if not name.startswith(("loss.", AVERAGE))}
    return Published(config, named, int(content.get("global_step", 0)))


def _within(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}


def _counted(names: Mapping[str, Tensor], form: str) -> int:
    """Count the consecutive names form.format(0), form.format(1), ..."""
    return next(number for number in count() if form.format(number) not in names)


def _autoencoder(state: Mapping[str, Tensor]) -> dict[str, Any]:
    """Options of `Autoencoder` from the shapes of its weights."""
    levels = _counted(state, "encoder.down.{}.block.0.conv1.weight")
    width, channels = state[FIRST].shape[:2]
    codes, code_channels = state[CODES].shape
    up = [state[f"decoder.up.{level}.upsample.conv.weight"].shape[2:] for level in range(1, levels)]
    return {
        "width": width,
        "multipliers": [len(state[f"encoder.down.{level}.block.0.conv1.weight"]) // width for level in range(levels)],
        "strides": [STRIDES[rows, columns] for rows, columns in up],
        "blocks": _counted(state, "encoder.down.0.block.{}.conv1.weight"),
        "attention": [level for level in range(levels) if f"encoder.down.{level}.attn.0.q.weight" in state],
        "latent_channels": len(state["encoder.conv_out.weight"]),
        "code_channels": code_channels,
        "codes": codes,
        "legacy": True,
        "mask": len(state["decoder.conv_out.weight"]) > channels,
    }


def _unet(state: Mapping[str, Tensor]) -> dict[str, Any]:
    """Options of `LatentUNet` from the names and shapes of its weights."""
    width, block = len(state["input_blocks.0.0.weight"]), 1
    multipliers, counts, attention = [], [0], set()
    while any(name.startswith(f"input_blocks.{block}.") for name in state):
        if f"input_blocks.{block}.0.op.weight" in state:
            counts.append(0)
        else:
            counts[-1] += 1
            if counts[-1] == 1:
                multipliers.append(len(state[f"input_blocks.{block}.0.in_layers.2.weight"]) // width)
            if f"input_blocks.{block}.1.qkv.weight" in state:
                attention.add(2 ** (len(counts) - 1))
        block += 1
    return {"width": width, "multipliers": multipliers, "blocks": counts[0], "attention": sorted(attention)}


def _notes(path: Path) -> Mapping[str, Any]:
    """Read the published `config.yaml` next to a file; empty if missing."""
    file = path.with_name("config.yaml")
    with telling(file):
        content = yaml.safe_load(file.read_text()) if file.is_file() else {}
    return content if isinstance(content, Mapping) else {}


def _config(generator: dict[str, Any], path: Path, notes: Mapping[str, Any]) -> dict[str, Any]:
    if not notes:
        heads = f", attention heads of {HEAD} channels" if generator["name"] == "latent_diffusion" else ""
        log.warning(
            "%s has no config.yaml: assumed images of %d x %d, ranges of %g to %g m on a logarithmic scale%s.",
            path, *SIZE, *RANGES, heads,
        )  # fmt: skip
    images = ((notes.get("data") or {}).get("params") or {}).get("dataset") or {}
    rows, columns = (int(size) for size in images.get("size", SIZE))
    nearest, farthest = (float(limit) for limit in images.get("depth_range", RANGES))
    if tuple(images.get("fov", VIEW)) != VIEW:
        raise InputError(f"{path}: LiDM's images see from 3 to -25 degrees, its config.yaml has {images['fov']}.")
    logarithmic = bool(images.get("log_scale", True))
    sensor = {"name": "hdl64e", "rows": rows, "columns": columns, "min_range": nearest, "max_range": farthest}
    expected = ShiftedLog(build_sensor(**sensor)).scale if logarithmic else farthest  # type: ignore[arg-type]
    scale = float(images.get("depth_scale", expected))
    if abs(scale - expected) > 1e-6:
        raise InputError(f"{path}: ranges to {farthest:g} m have the scale {expected:g}, config.yaml has {scale:g}.")
    return {
        "sensor": sensor,
        "encoding": {"format": "shifted_log" if logarithmic else "metric", "reflectance": False, "limits": "open"},
        "backbone": {"name": "latent_unet"},
        "generator": generator,
        "data": {"name": "kitti_360", "reading": {"projection": "spherical", "convention": "lidm"}},
        "published": {"system": "LiDM"},
    }


DIFFUSION = Format("LiDM", holds_diffusion, read_diffusion)
FIRST_STAGE = Format("LiDM's autoencoder", holds_autoencoder, read_autoencoder)
