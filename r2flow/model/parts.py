"""Parts of a checkpoint: their keys, and the config in its hyper-parameters."""

from r2flow.base.registry import Config, Options

PREFIX = "generator."  # of the generator's weights in a LightningModule
COMPILED = "_orig_mod."  # in the names of the weights after torch.compile
HYPER = "hyper_parameters"  # Lightning's key of a module's options
# key of our notes in a checkpoint of Lightning, and of the JSON metadata in a .safetensors
NOTES = "r2flow"
# Hyper-parameters of the model; the others are the stage's.
MODEL = ("backbone", "sensor", "encoding", "generator")


def config_of(stage: Options, data: Options, name: str | None) -> Config:
    """The config of a model by the hyper-parameters of its stage, of this name, and of its data.

    Its keys are the hyper-parameters of `MODEL`, `sampler`, `few` and `seed`, `stage` with the
    others, and `data`.
    """
    options = dict(stage)
    config: Config = {key: options.pop(key) for key in (*MODEL, "sampler", "few", "seed")}
    config["stage"] = {"name": name, **options}
    config["data"] = {key: data[key] for key in data if key not in ("sensor", "encoding", "seed")}
    return config
