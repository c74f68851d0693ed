"""Registry of generators: models that turn noise, and optionally a condition, into a scan."""

from collections.abc import Mapping
from typing import Any

import torch

from r2flow.errors import check
from r2flow.generators.base import Condition, Generated, Generator, Sampler, condition_of
from r2flow.generators.flow import USUAL, Flow, FlowMap, RectifiedFlow, as_flow
from r2flow.generators.transfer import TransferFlow
from r2flow.lidar.encoding import build_space
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
    vanilla_gan=lazy("r2flow.systems.gan.dcgan:VanillaGan"),
    dusty1=lazy("r2flow.systems.gan.dcgan:DustyV1"),
    dusty2=lazy("r2flow.systems.gan.style_gan:DustyV2"),
    score=lazy("r2flow.systems.score.generator:ScoreModel"),
    vq_autoencoder=lazy("r2flow.systems.latent.generator:VQAutoencoder"),
    latent_diffusion=lazy("r2flow.systems.latent.generator:LatentDiffusion"),
)


def build_generator(config: Mapping[str, Any]) -> Generator:
    """Build the generator of a config: keys `sensor`, `encoding`, `backbone`, `generator` (default: rectified flow)."""
    with torch.device("cpu"):  # geometry needs real values, even if the weights are on the meta device
        space = build_space(config)
    check("backbone" in config, "the config has no 'backbone'.")
    return GENERATORS.build(config.get("generator") or {"name": "rectified_flow"}, space, config["backbone"])
