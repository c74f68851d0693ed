"""Lineage: what a stage takes from the trained model that it starts from."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import nn

from r2flow.backbones import BACKBONES
from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Options, options_of
from r2flow.data.options import PAIRS, ParentRecord, ReadingOptions
from r2flow.data.pairs import default_folder
from r2flow.data.reading import AUTO
from r2flow.generators import GENERATORS
from r2flow.lidar.encoding import encoding_options
from r2flow.lidar.sensors import sensor_options
from r2flow.model.checkpoint import Checkpoint, load_checkpoint
from r2flow.model.config import ModelConfig
from r2flow.model.saving import weights_hash
from r2flow.model.shipped import name_of

# The default of each group, and the function that completes its options.
_GROUPS: dict[str, tuple[str, Callable[[Any], Config]]] = {
    "backbone": ("hdit_tiny", BACKBONES.options),
    "sensor": ("hdl64e", sensor_options),
    "encoding": ("logscale", encoding_options),
}


@dataclass(frozen=True)
class Parent:
    """The model that a stage starts from, or only its config if it has not been trained yet."""

    config: ModelConfig
    path: Path
    step: int = 0
    checkpoint: Checkpoint | None = None

    @property
    def reading(self) -> ReadingOptions | None:
        """How the scans that the model learned from became images, if it was from scans."""
        return self.config.data.reading

    @property
    def unfolded(self) -> bool:
        """Whether it is published, and was trained on unfolded scans."""
        published = self.checkpoint is not None and self.checkpoint.format == "published"
        return published and self.reading is not None and self.reading.projection == "unfolding"

    def record(self) -> ParentRecord:
        """What the checkpoints of its children say of it."""
        data = self.config.data
        return ParentRecord(
            path=str(self.path),
            weights=weights_hash(self.checkpoint) if self.checkpoint else None,
            step=self.step,
            stage=self.config.stage.name or "rectify",
            first_pair=(data.pairs.first or 0) + data.pairs.num if data.name == PAIRS else 0,
            pairs=str(default_folder(self.path)),
        )


def find_parent(name: "str | Path | Parent", backbone: Any = None) -> Parent:
    """The parent of a name. A run folder must be finished, a checkpoint may be of any step.

    A `backbone` that is a module of one's own is the parent's, too.
    """
    if isinstance(name, Parent):
        return name
    network = backbone if isinstance(backbone, nn.Module) else None
    checkpoint = load_checkpoint(str(name), backbone=network)
    total = checkpoint.config.steps
    is_run = Path(str(name)).expanduser().is_dir() and name_of(checkpoint.path) is None
    if is_run and checkpoint.step < total:
        raise InputError(
            f"{name} has stopped at step {checkpoint.step} of {total}: finish it, or name the "
            "checkpoint to start "
            f"from, {checkpoint.path}."
        )
    return Parent(checkpoint.config, checkpoint.path, checkpoint.step, checkpoint)


def model_options(
    given: Options,
    parent: Parent | None,
    generator_name: str | None,
    on_pairs: bool = False,
) -> Config:
    """Complete options of a model: `backbone`, `sensor`, `encoding` and `generator`, as plain
    values.

    What is not given comes from the parent, else it is the default. A model with the weights of a
    parent has its encoding and backbone, and on pairs, which are images of the parent, its sensor.

    Args:
        given: Names, options or objects; None: not given. Options of a backbone without a name
            change the parent's.
        generator_name: Generator of the stage; None: the parent's, or a rectified flow.

    Raises:
        InputError: an unknown name or option, or one that contradicts the parent.
    """
    theirs = parent.config.model if parent else {}
    if parent and parent.unfolded:
        raise InputError(
            f"{parent.path} was trained on unfolded scans, whose rings a new run's sensor does not "
            "have; "
            "start from a flow trained on spherical images."
        )
    of_parent = parent.config.generator if parent else None
    generator = _generator(given.get("generator"), of_parent, generator_name)
    options: Config = {}
    for group, (default, complete) in _GROUPS.items():
        ours = given.get(group)
        if parent is None:
            options[group] = complete(ours or default)
        else:
            options[group] = _changed(theirs[group], ours, complete)
    encoding = options["encoding"]
    if encoding["reflectance"] == AUTO:
        encoding["reflectance"] = parent is None or parent.config.encoding["reflectance"]
    if parent is not None:
        # But for options that weights do not depend on.
        _refuse_other("backbone", options, parent, {"attention", "dropout"})
        _refuse_other("encoding", options, parent, {"levels"})
        if on_pairs:
            _refuse_other("sensor", options, parent, {"reflectance_scale"})
    return {**options, "generator": generator}


def _changed(
    theirs: Options | None, given: Any, complete: Callable[[Any], Config]
) -> Config | None:
    """The parent's options of a group with those given; a name stands for all options."""
    if given is None:
        return None if theirs is None else dict(theirs)
    if isinstance(given, Mapping) and "name" not in given and theirs:
        return {**theirs, **given}
    return complete(given)


def _refuse_other(group: str, options: Options, parent: Parent, free: set[str]) -> None:
    """Refuse options that differ from those of the weights; keys that only one side has are equal
    to the default.
    """
    ours = options[group] or {}
    theirs = parent.config.model[group] or {}
    for key in ours.keys() & theirs.keys() - free:
        if plain(ours[key]) != plain(theirs[key]):
            raise InputError(
                f"{group}.{key} is {ours[key]} here, but {theirs[key]} in {parent.path}, whose "
                f"weights this run starts from. Leave it out: the {group} is the parent's."
            )


def _generator(given: str | Options | None, theirs: Options | None, of_stage: str | None) -> Config:
    """The generator given, else the stage's, else the parent's, or what the parent's is fine-tuned
    as.

    One that is not given has the parent's options as far as they apply.
    """
    if given:
        return GENERATORS.options(given)
    parental = theirs or {"name": "rectified_flow"}
    name = of_stage or GENERATORS[parental["name"]].finetuned_as or parental["name"]
    shared = options_of(GENERATORS[name], given=2)
    return {"name": name} | {key: parental[key] for key in parental if key in shared}


def plain(value: Any) -> Any:
    """A value with its sequences as lists, its mappings as dicts, and a module as its class."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, nn.Module):
        return type(value).__name__
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value
