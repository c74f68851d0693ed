"""Registry of stages: LightningModules that train a generator."""

from r2flow.base.registry import Registry, lazy
from r2flow.stages.base import Stage
from r2flow.stages.flow_map import LearnFlowMap
from r2flow.stages.rectify import Distill, Rectify, Reflow
from r2flow.stages.transfer import Transfer

__all__ = ["STAGES", "Distill", "LearnFlowMap", "Rectify", "Reflow", "Stage", "Transfer"]

STAGES: Registry[type[Stage]] = Registry(
    "stage",
    rectify=Rectify,
    reflow=Reflow,
    distill=Distill,
    flow_map=LearnFlowMap,
    transfer=Transfer,
    diffusion=lazy("r2flow.systems.diffusion.stage:LearnDiffusion"),
    gan=lazy("r2flow.systems.gan.stage:LearnGan"),
    score_matching=lazy("r2flow.systems.score.stage:MatchScore"),
    autoencoder=lazy("r2flow.systems.latent.stage:LearnAutoencoder"),
    latent_diffusion=lazy("r2flow.systems.latent.stage:LearnLatentDiffusion"),
)
