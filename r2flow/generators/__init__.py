"""Registry of generators: models that turn noise, and optionally a condition, into a scan."""

from collections.abc import Mapping
from typing import Any

import torch

from r2flow.base.registry import Registry, lazy
from r2flow.generators.answers import Answers
from r2flow.generators.base import Condition, Generated, Generator, Sampler, condition_of
from r2flow.generators.flow import USUAL, Flow, FlowMap, RectifiedFlow, as_flow
from r2flow.generators.transfer import TransferFlow
from r2flow.lidar.encoding import build_space

__all__ = [
    "GENERATORS",
    "USUAL",
    "Answers",
    "Condition",
    "Flow",
    "FlowMap",
    "Generated",
    "Generator",
    "RectifiedFlow",
    "Sampler",
    "TransferFlow",
    "as_flow",
    "build_generator",
    "condition_of",
]

GENERATORS: Registry[type[Generator]] = Registry(
    "generator",
    rectified_flow=RectifiedFlow,
    flow_map=FlowMap,
    transfer_flow=TransferFlow,
    diffusion=lazy("r2flow.systems.diffusion.generator:Diffusion"),
    vanilla_gan=lazy("r2flow.systems.gan.dcgan:VanillaGan"),
    dusty1=lazy("r2flow.systems.gan.dcgan:DustyV1"),
    dusty2=lazy("r2flow.systems.gan.style_gan:DustyV2"),
    score=lazy("r2flow.systems.score.generator:ScoreModel"),
    vq_autoencoder=lazy("r2flow.systems.latent.generator:VQAutoencoder"),
    latent_diffusion=lazy("r2flow.systems.latent.generator:LatentDiffusion"),
)


def build_generator(config: Mapping[str, Any]) -> Generator:
    """Build the generator of a config with the keys `sensor`, `encoding`, `backbone`, `generator`.

    Without the last it is a rectified flow.
    """
    with torch.device("cpu"):  # geometry needs real values, even for weights on the meta device
        space = build_space(config)
    options = config.get("generator") or {"name": "rectified_flow"}
    return GENERATORS.build(options, space, config["backbone"])
