"""Registry of stages: LightningModules that train a generator."""

from collections.abc import Mapping
from typing import Any

from r2flow.errors import InputError, check
from r2flow.generators import Generator
from r2flow.registry import Registry, lazy
from r2flow.samplers import build_sampler
from r2flow.stages.base import Stage
from r2flow.stages.flow_map import LearnFlowMap
from r2flow.stages.rectify import Distill, Rectify, Reflow
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


def build_stage(config: Mapping[str, Any], generator: Generator) -> Stage:
    """Build the LightningModule of a config's `stage` around a generator; its checkpoints store the config.

    The config's `sampler` and `few`, if given, become the generator's defaults.
    """
    run_options = {"batch_size": config["data"]["batch_size"], "seed": config["seed"]}
    for name, where in (("batch_size", "data.batch_size"), ("seed", "seed")):
        check(name not in config["stage"], f"stage.{name} is the run's: leave it out, and give {where}.")
    options = {**config["stage"], **run_options}
    options.pop("init", None)  # the generator has its weights already
    stage: Stage = STAGES.build(options, generator)
    stage.config = dict(config)
    if not stage.several_sensors and any(part.get("sensor") for part in config["data"].get("parts") or ()):
        raise InputError(f"stage={options['name']} learns from scans of one sensor: leave sensor out of data.parts.")
    stage.check_data(options["name"], config["data"])
    if (config["data"].get("augment") or {}).get("roll") and generator.learns_directions:
        raise InputError(
            "data.augment.roll makes all directions alike, but backbone.position=learnable (the paper's APE) learns "
            "one vector per direction; give backbone.position=none, whose attention sees only differences in azimuth, "
            "or leave roll out."
        )
    sampler, few = generator.choose(**dict(config.get("sampler") or {})), config.get("few")
    if sampler.completes:
        raise InputError(f"sampler.name={sampler.name} completes scans: give it to r2flow complete by --sampler.")
    if few is not None:
        generator.few = build_sampler(few)
        generator.few.check(generator)
    generator.run_by(sampler, generator.few, generator.fixed)
    return stage
