"""Published files of the vanilla GAN, DUSty v1 and v2 by the authors of DUSty v2.

They have the entries cfg, step, angle, G, G_ema, D, ...
"""

from pathlib import Path
from typing import Any

from r2flow.base.registry import Config, Options
from r2flow.model.published import Format, Published, has_keys, sensor_of
from r2flow.systems.gan.layers import DROPPED

_GENERATORS = {"vanilla": "vanilla_gan", "dusty_v1": "dusty1", "dusty_v2": "dusty2"}
_TANH = {None: False, "nn.Tanh": True}
# Options that would change images, but no weight's shape; the published files have these.
_FORM = {
    "output_scale": 0.25,
    "use_noise": False,
    "pe_type": "random",
    "ring": True,
    "raydrop_const": DROPPED,
}


def _read_gan(content: Any, path: Path, averaged: bool = True) -> Published:
    """Read the generator of a published GAN, with averaged or raw weights."""
    cfg = content["cfg"]
    angle = content["angle"]
    dataset = cfg["dataset"]
    model = cfg["model"]["generator"]
    synthesis = model["synthesis_kwargs"]
    shape = synthesis["resolution"]
    if [*angle.shape] != [1, 2, *shape]:
        raise ValueError(f"the angles, which are {tuple(angle.shape)}, of images of {shape}")
    image = next(output for output in synthesis["out_ch"] if output["name"] == "image")
    generator = _generator(model)
    generator["tanh"] = _TANH[image.get("act")]
    weights = content["G_ema" if averaged else "G"]
    weights = {f"network.{key}": value for key, value in weights.items()}
    if generator["name"] == "dusty2":
        weights["angle"] = angle
    config = {
        "sensor": sensor_of("hdl64e_rings", shape, dataset),
        "encoding": {"format": "inverse_depth", "reflectance": image["ch"] == 2},
        "generator": generator,
        "backbone": None,
        "data": {
            "name": dataset["name"],
            "reading": {"projection": "unfolding", "convention": "reference"},
        },
        "published": cfg,
    }
    training = cfg["training"]
    step = int(content["step"]) // max(int(training["batch_size"]), 1)
    return Published(config, weights, step, elevations=angle[0, 0].double().mean(1))


def _generator(model: Options) -> Config:
    name = _GENERATORS[model["arch"]]
    mapping = model["mapping_kwargs"]
    synthesis = model["synthesis_kwargs"]
    options = {
        "name": name,
        "latent": mapping["in_ch"],
        "base_channels": synthesis["ch_base"],
        "max_channels": synthesis["ch_max"],
    }
    if name != "vanilla_gan":
        measurement = model["measurement_kwargs"]
        options["temperature"] = measurement["gumbel_temperature"]
        synthesis = {**synthesis, **measurement}
    if name == "dusty2":
        options["code"] = mapping["out_ch"]
        options["depth"] = mapping["depth"]
        options["doublings"] = len(synthesis["layers"])
    for key, value in _FORM.items():
        if synthesis.get(key, value) != value:
            raise ValueError(f"{key} of {synthesis[key]!r}; published files have {value!r}")
    return options


FORMAT = Format("DUSty", has_keys("cfg", "angle", "G", "G_ema", "D"), _read_gan)
