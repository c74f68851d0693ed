"""What turns noise, and perhaps a condition, into a scan; by name."""

from collections.abc import Mapping
from typing import Any

import torch

from r2flow.errors import InputError
from r2flow.generators.base import Condition, Generated, Generator, Sampler
from r2flow.generators.condition import condition_of
from r2flow.generators.flow import USUAL, Flow, RectifiedFlow, as_flow
from r2flow.generators.flow_map import FlowMap
from r2flow.generators.transfer import TransferFlow
from r2flow.lidar.space import build_space
from r2flow.registry import Registry, lazy

__all__ = [
    "GENERATORS", "USUAL", "Condition", "Flow", "FlowMap", "Generated", "Generator", "RectifiedFlow",
    "Sampler", "TransferFlow", "as_flow", "build_generator", "condition_of",
]  # fmt: skip

GENERATORS: Registry[type[Generator]] = Registry(
    "generator",
    rectified_flow=RectifiedFlow,
    flow_map=FlowMap,
    transfer_flow=TransferFlow,
    diffusion=lazy("r2flow.systems.diffusion.generator:Diffusion"),
    vanilla_gan=lazy("r2flow.systems.gan.generator:VanillaGan"),
    dusty1=lazy("r2flow.systems.gan.generator:DustyV1"),
    dusty2=lazy("r2flow.systems.gan.generator:DustyV2"),
    score=lazy("r2flow.systems.score.generator:ScoreModel"),
    vq_autoencoder=lazy("r2flow.systems.latent.generator:VQAutoencoder"),
    latent_diffusion=lazy("r2flow.systems.latent.generator:LatentDiffusion"),
)


def build_generator(config: Mapping[str, Any]) -> Generator:
    """The generator of a config with the keys `sensor`, `encoding`, `backbone` and, where it is no rectified flow,
    `generator`.

    Raises:
        InputError: a key is missing, a name is unknown, an option is, or the sizes do not fit together.
    """
    with torch.device("cpu"):  # geometry needs its numbers, also where the weights are made on the meta device
        space = build_space(config)
    if "backbone" not in config:
        raise InputError("the config has no 'backbone'.")
    generator: Generator = GENERATORS.build(
        config.get("generator") or {"name": "rectified_flow"}, space, config["backbone"]
    )
    return generator
