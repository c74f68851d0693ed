"""Published files of the vanilla GAN, DUSty v1 and v2 by the authors of DUSty v2: cfg, step, angle, G, G_ema, D, ..."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from r2flow.model.published import Format, Published, has_keys, sensor_of
from r2flow.systems.gan.layers import DROPPED

GENERATORS = {"vanilla": "vanilla_gan", "dusty_v1": "dusty1", "dusty_v2": "dusty2"}


def read(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read the generator of a published GAN, with averaged or raw weights."""
    cfg, angle = content["cfg"], content["angle"]
    model, dataset = cfg["model"]["generator"], cfg["dataset"]
    out = {str(output["name"]): output for output in model["synthesis_kwargs"]["out_ch"]}
    generator = _generator(model, out)
    rows, columns = (int(n) for n in model["synthesis_kwargs"]["resolution"])
    if tuple(angle.shape) != (1, 2, rows, columns):
        raise ValueError(f"the angles, which are {tuple(angle.shape)}, not (1, 2, {rows}, {columns})")
    config = {
        "sensor": sensor_of("hdl64e_rings", (rows, columns), dataset),
        "encoding": {"format": "inverse_depth", "reflectance": out["image"]["ch"] == 2},
        "generator": generator,
        "backbone": None,
        "data": {"name": str(dataset["name"]), "reading": {"projection": "unfolding", "convention": "reference"}},
        "published": cfg,
    }
    step = int(content["step"]) // max(int(cfg["training"]["batch_size"]), 1)
    weights = {f"network.{key}": value for key, value in content["G_ema" if averaged else "G"].items()}
    if generator["name"] == "dusty2":
        weights["angle"] = angle

    return Published(config, weights, step, elevations=angle[0, 0].double().mean(1))


def _generator(model: Mapping[str, Any], out: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    name, mapping, synthesis = GENERATORS[str(model["arch"])], model["mapping_kwargs"], model["synthesis_kwargs"]
    act = out["image"].get("act")
    if act not in (None, "nn.Tanh"):
        raise ValueError(f"the activation {act!r}")
    options: dict[str, Any] = {
        "name": name,
        "latent": int(mapping["in_ch"]),
        "base_channels": int(synthesis["ch_base"]),
        "max_channels": int(synthesis["ch_max"]),
        "tanh": act is not None,
        "ring": bool(synthesis["ring"]),
    }
    if name == "vanilla_gan":
        return options
    measurement = model["measurement_kwargs"]
    if float(measurement["raydrop_const"]) != DROPPED or out["raydrop_logit"].get("act") is not None:
        raise ValueError("a dropped ray that is not -1, or a mask of another form")
    options["temperature"] = float(measurement["gumbel_temperature"])
    if name == "dusty1":
        return options
    scaled = synthesis.get("output_scale", 0.25) != 0.25
    if scaled or synthesis["use_noise"] or synthesis["pe_type"] != "random" or set(synthesis["layers"]) != {2}:
        raise ValueError("output_scale, use_noise, pe_type or layers of a form that is not the published one")
    deeper = {"code": int(mapping["out_ch"]), "depth": int(mapping["depth"]), "doublings": len(synthesis["layers"])}
    return {**options, **deeper}


FORMAT = Format("DUSty", has_keys("cfg", "angle", "G", "G_ema", "D"), read)
