"""The published files of DUSty v2's authors, of the vanilla GAN, DUSty v1 and v2: cfg, step, angle, G, G_ema, D, ..."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.generators import Generator
from r2flow.model.published import Format, Published, garbled
from r2flow.systems.gan.generator import DROPPED

GENERATORS = {"vanilla": "vanilla_gan", "dusty_v1": "dusty1", "dusty_v2": "dusty2"}
NETWORK = "network."  # of the network in our generator


def holds(content: Any) -> bool:
    return isinstance(content, Mapping) and {"cfg", "angle", "G", "G_ema", "D"} <= content.keys()


def read(content: Any, path: Path, averaged: bool = True) -> Published:
    """A published GAN: its generator, by the averaged weights or the raw ones."""
    cfg, angle = content["cfg"], content["angle"]
    with garbled(path):
        name, own = _generator(cfg["model"]["generator"])
        dataset, out = cfg["dataset"], cfg["model"]["generator"]["synthesis_kwargs"]
        rows, columns = (int(n) for n in out["resolution"])
        channels = _outputs(out)["image"]["ch"]
        config = {
            "sensor": {
                "name": "hdl64e_rings",
                "rows": rows,
                "columns": columns,
                "min_range": float(dataset["min_depth"]),
                "max_range": float(dataset["max_depth"]),
            },
            "encoding": {"format": "inverse_depth", "reflectance": channels == 2},
            "generator": {"name": name, **own},
            "backbone": None,
            "data": {"name": str(dataset["name"]), "reading": {"projection": "unfolding", "convention": "reference"}},
            "published": cfg,
        }
        step = int(content["step"]) // max(int(cfg["training"]["batch_size"]), 1)
        if tuple(angle.shape) != (1, 2, rows, columns):
            raise InputError(f"{path}: the angles are {tuple(angle.shape)}, not (1, 2, {rows}, {columns}).")
        weights = {NETWORK + key: value for key, value in content["G_ema" if averaged else "G"].items()}
    if name == "dusty2":
        weights["angle"] = angle

    def follow(generator: Generator, config: Mapping[str, Any]) -> None:
        _follow(generator, angle)

    return Published(config, weights, step, None, follow)


def _outputs(synthesis: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {str(one["name"]): one for one in synthesis["out_ch"]}


def _generator(model: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """The name of our generator and its options."""
    name, mapping, synthesis = GENERATORS[str(model["arch"])], model["mapping_kwargs"], model["synthesis_kwargs"]
    out = _outputs(synthesis)
    common: dict[str, Any] = {
        "latent": int(mapping["in_ch"]),
        "base_channels": int(synthesis["ch_base"]),
        "max_channels": int(synthesis["ch_max"]),
        "tanh": _ends_in_tanh(out["image"].get("act")),
        "ring": bool(synthesis["ring"]),
    }
    if name == "vanilla_gan":
        return name, common
    measurement = model["measurement_kwargs"]
    if float(measurement["raydrop_const"]) != DROPPED or out["raydrop_logit"].get("act") is not None:
        raise ValueError("a dropped ray that is not -1, or a mask of another form")
    common["temperature"] = float(measurement["gumbel_temperature"])
    if name == "dusty1":
        return name, common
    if synthesis["use_noise"] or synthesis["pe_type"] != "random" or set(synthesis["layers"]) != {2}:
        raise ValueError("use_noise, pe_type or layers of a form that is not the published one")
    deeper = {"code": int(mapping["out_ch"]), "depth": int(mapping["depth"]), "doublings": len(synthesis["layers"])}
    return name, {**common, **deeper}


def _ends_in_tanh(act: Any) -> bool:
    if act not in (None, "nn.Tanh"):
        raise ValueError(f"the activation {act!r}")
    return act is not None


def _follow(generator: Generator, angle: Tensor) -> None:
    """The sensor by the mean elevation of each row of the file's angles."""
    elevations = torch.rad2deg(angle[0, 0].double().mean(1)).tolist()
    sensor = replace(generator.space.sensor, elevations=tuple(elevations))
    generator.space = replace(generator.space, sensor=sensor, rays=sensor.rays())


FORMAT = Format("DUSty", holds, read)
