"""LightningModules: how a generator is learned."""

from collections.abc import Mapping
from typing import Any

from r2flow.data.augment import Augmentation
from r2flow.errors import InputError
from r2flow.generators import Generator
from r2flow.registry import Registry, lazy
from r2flow.samplers import build_sampler
from r2flow.stages.base import Stage
from r2flow.stages.flow_map import LearnFlowMap
from r2flow.stages.rectify import Rectify
from r2flow.stages.reflow import Distill, Reflow
from r2flow.stages.transfer import Transfer

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


def check_roll(augment: Augmentation, generator: Generator) -> None:
    """Refuse turned scans for a generator that learns a vector for each direction."""
    if augment.roll and generator.learns_directions:
        raise InputError(
            "data.augment.roll makes all directions alike, and backbone.position=learnable (the paper's APE) learns a "
            "vector of its own for each; give backbone.position=none, whose attention knows differences in azimuth "
            "alone, or leave roll out."
        )


def build_stage(config: Mapping[str, Any], generator: Generator) -> Stage:
    """The LightningModule of a config's `stage`, around a generator; it carries the config into its checkpoints.

    The config's `sampler`, where it has one, becomes the generator's.
    """
    of_run = {"batch_size": config["data"]["batch_size"], "seed": config["seed"]}
    for name, where in (("batch_size", "data.batch_size"), ("seed", "seed")):
        if name in config["stage"]:
            raise InputError(f"stage.{name} is the run's: leave it out, and give {where}.")
    options = {**config["stage"], **of_run}
    options.pop("init", None)  # the generator has its weights already
    stage: Stage = STAGES.build(options, generator)
    stage.config = dict(config)
    stage.check_data(options["name"], config["data"])
    _choose(generator, config)
    return stage


def _choose(generator: Generator, config: Mapping[str, Any]) -> None:
    """Give a generator the samplers of a config's `sampler` and `few`."""
    own, asked = generator.sampler, dict(config.get("sampler") or {})
    sampler, few = generator.choose(**asked), config.get("few")
    if generator.fixed and sampler != own:
        raise InputError(
            f"this stage trains for one sampler alone, {own}: leave sampler.* out; in a chain give it to one link, as "
            "chain.rf1.sampler.steps=32."
        )
    if sampler.completes:
        raise InputError(f"sampler.name={sampler.name} completes scans: give it to r2flow complete by --sampler.")
    if few is not None:
        generator.few = build_sampler(few)
        generator.few.check(generator)
    generator.run_by(sampler, generator.few, generator.fixed)
