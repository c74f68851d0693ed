"""LiDM's published checkpoints: Lightning files of a latent diffusion, or of its autoencoder.

Image size and width of attention heads are read from the published `config.yaml` next to a file;
without it they are 64 x 1024 and 32, as in all published files.
"""

import logging
from collections.abc import Mapping
from itertools import count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.files import parse_yaml, reading_errors
from r2flow.base.registry import Config, Options
from r2flow.lidar.range_formats import ShiftedLog
from r2flow.lidar.sensors import build_sensor
from r2flow.model.published import Format, Published
from r2flow.systems.latent.autoencoder import UP

_log = logging.getLogger(__name__)

_UNET = "model.diffusion_model."
_AUTOENCODER = "first_stage_model."
_AVERAGE = "model_ema."
_FIRST = "encoder.conv_in.weight"
_CODES = "quantize.embedding.weight"
_STRIDES = {kernel: list(stride) for stride, kernel in UP.items()}
_HEAD = 32
# Options of config.yaml that would change the images, but no weight's shape; published files have
# these.
_FORM = {
    "lib_name": "lidm",
    "num_heads": -1,
    "use_new_attention_order": False,
    "parameterization": "eps",
    "beta_schedule": "linear",
    "scale_factor": 1.0,
    "scale_by_std": False,
}
_IMAGES: Config = {
    "size": [64, 1024],
    "depth_range": [1.0, 56.0],
    "log_scale": True,
}


def _state(content: Any, averaged: bool = False) -> dict[str, Tensor]:
    """Weights, or their averages where a file has them; names of averages have no dots."""
    state = content.get("state_dict", {}) if isinstance(content, Mapping) else {}
    weights = dict(state)
    for name in state if averaged else ():
        average = _AVERAGE + name.removeprefix("model.").replace(".", "")
        weights[name] = state.get(average, state[name])
    return weights


def _holds_diffusion(content: Any) -> bool:
    return {_UNET + "time_embed.0.weight", _AUTOENCODER + _FIRST} <= _state(content).keys()


def _holds_autoencoder(content: Any) -> bool:
    return {_FIRST, _CODES} <= _state(content).keys()


def _read_diffusion(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read a published latent diffusion."""
    state = _state(content, averaged)
    if _within(state, "cond_stage_model."):
        raise InputError(f"{path} is conditional: only LiDM's unconditional models are read.")
    notes = _notes(path)
    params = (notes.get("model") or {}).get("params") or {}
    unet = params.get("unet_config", {}).get("params", {})
    options = {**_FORM, **params, **unet}
    if unet and "lib_name" not in unet:  # without circular convolutions
        options["lib_name"] = "ldm"
    _refuse_other(path, _FORM, options)
    betas = state["betas"].float()
    steps = state["betas"].double().sqrt().diff()
    if not torch.allclose(steps, steps.mean(), rtol=1e-2):
        raise InputError(
            f"{path}: the square roots of its betas are not evenly spaced, as LiDM's are."
        )
    first, last = betas[[0, -1]].numpy()
    generator: Config = {
        "name": "latent_diffusion",
        "autoencoder": _autoencoder(_within(state, _AUTOENCODER)),
        "unet": _unet(_within(state, _UNET)),
        "schedule": {
            "name": "square_root_linear",
            "first": float(str(first)),  # the shortest decimal that is the same float32
            "last": float(str(last)),
            "steps": len(betas),
        },
    }
    generator["unet"]["head_channels"] = unet.get("num_head_channels", _HEAD)
    weights = {name: state[name] for name in state if name.startswith((_UNET, _AUTOENCODER))}
    return Published(_config(generator, path, notes), weights, int(content.get("global_step", 0)))


def _read_autoencoder(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read a published autoencoder, without its discriminator."""
    state = _state(content, averaged)
    generator = {"name": "vq_autoencoder", "autoencoder": _autoencoder(state)}
    config = _config(generator, path, _notes(path))
    weights = {
        _AUTOENCODER + name: value
        for name, value in state.items()
        if not name.startswith(("loss.", _AVERAGE))
    }
    return Published(config, weights, int(content.get("global_step", 0)))


def _refuse_other(path: Path, form: Options, options: Options) -> None:
    other = {name: options[name] for name in form if options[name] != form[name]}
    if other:
        raise InputError(f"{path}: its config.yaml has {other}, and only LiDM's own form is read.")


def _within(state: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    names = (name for name in state if name.startswith(prefix))
    return {name.removeprefix(prefix): state[name] for name in names}


def _counted(names: Mapping[str, Tensor], form: str) -> int:
    """Count the consecutive names form.format(0), form.format(1), ..."""
    return next(number for number in count() if form.format(number) not in names)


def _autoencoder(state: Mapping[str, Tensor]) -> Config:
    """Options of `Autoencoder` from the shapes of its weights."""
    convolution = "encoder.down.{}.block.0.conv1.weight"
    levels = range(_counted(state, convolution))
    width, channels = state[_FIRST].shape[:2]
    codes, code_channels = state[_CODES].shape
    kernels = [state[f"decoder.up.{i}.upsample.conv.weight"].shape[2:] for i in levels[1:]]
    return {
        "width": width,
        "multipliers": [len(state[convolution.format(i)]) // width for i in levels],
        "strides": [_STRIDES[rows, columns] for rows, columns in kernels],
        "blocks": _counted(state, "encoder.down.0.block.{}.conv1.weight"),
        "attention": [i for i in levels if f"encoder.down.{i}.attn.0.q.weight" in state],
        "latent_channels": len(state["encoder.conv_out.weight"]),
        "code_channels": code_channels,
        "codes": codes,
        "legacy": True,
        "mask": len(state["decoder.conv_out.weight"]) > channels,
    }


def _unet(state: Mapping[str, Tensor]) -> Config:
    """Options of `LatentUNet` from the names and shapes of its weights."""
    width = len(state["input_blocks.0.0.weight"])
    widths: list[list[int]] = [[]]  # of the residual blocks of each level
    attention = set()
    for block in range(1, _counted(state, "output_blocks.{}.0.in_layers.0.weight")):
        convolution = state.get(f"input_blocks.{block}.0.in_layers.2.weight")
        if convolution is None:  # downsampling
            widths.append([])
            continue
        widths[-1].append(len(convolution))
        if f"input_blocks.{block}.1.qkv.weight" in state:
            attention.add(2 ** (len(widths) - 1))
    return {
        "width": width,
        "multipliers": [level[0] // width for level in widths],
        "blocks": len(widths[0]),
        "attention": sorted(attention),
    }


def _notes(path: Path) -> Options:
    """Read the published `config.yaml` next to a file; empty if missing."""
    file = path.with_name("config.yaml")
    with reading_errors(file):
        content = parse_yaml(file.read_text(), most_aliases=8) if file.is_file() else {}
    return content if isinstance(content, Mapping) else {}


def _config(generator: Config, path: Path, notes: Options) -> Config:
    if not notes:
        _log.warning(
            "%s has no config.yaml: assumed images of %d x %d, ranges of %g to %g m on a "
            "logarithmic scale, attention heads of %d channels.",
            path,
            *_IMAGES["size"],
            *_IMAGES["depth_range"],
            _HEAD,
        )
    found = ((notes.get("data") or {}).get("params") or {}).get("dataset") or {}
    images: Config = {**_IMAGES, **found}
    rows, columns = images["size"]
    nearest, farthest = images["depth_range"]
    sensor = {
        "name": "hdl64e",
        "rows": rows,
        "columns": columns,
        "min_range": nearest,
        "max_range": farthest,
    }
    scale = farthest
    if images["log_scale"]:
        scale = ShiftedLog(build_sensor(**sensor)).scale
    form = {"fov": [3, -25], "depth_scale": scale}
    _refuse_other(path, form, {**form, **found})
    return {
        "sensor": sensor,
        "encoding": {
            "format": "shifted_log" if images["log_scale"] else "metric",
            "reflectance": False,
            "limits": "open",
        },
        "backbone": {"name": "latent_unet"},
        "generator": generator,
        "data": {
            "name": "kitti_360",
            "reading": {"projection": "spherical", "convention": "lidm"},
        },
        "published": {"system": "LiDM"},
    }


DIFFUSION = Format("LiDM", _holds_diffusion, _read_diffusion)
FIRST_STAGE = Format("LiDM's autoencoder", _holds_autoencoder, _read_autoencoder)
