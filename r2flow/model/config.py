"""The config of a run: one tree of typed values, whose annotations are the rules of its keys."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from r2flow.base.config import (
    Found,
    Free,
    Rule,
    differences,
    is_groups,
    key_of,
    rules_in,
    rules_of,
)
from r2flow.base.errors import InputError
from r2flow.base.registry import (
    Bound,
    Config,
    Count,
    Integer,
    Natural,
    NonNegative,
    Number,
    Options,
    Seed,
    Share,
    construct,
    strict,
)
from r2flow.data.options import (
    DataOptions,
    PairOptions,
    ParentRecord,
    ReadingOptions,
    ValidationOptions,
)
from r2flow.model.parts import MODEL

_Named = Annotated[Options, Bound("a group with a name", lambda group: "name" in group)]
_InRuns = Annotated[
    str, Bound("a folder in runs", lambda name: name.strip("./") and ".." not in Path(name).parts)
]
_End = Annotated[Integer, Bound("-1 or above 0", lambda end: end == -1 or end > 0)]
_Batches = Count | Annotated[Number, Field(gt=0, le=1)]  # a number of them, or a share
_Time = str | Mapping[str, Natural]
_Devices = Annotated[_End, Field(le=10**4)]
_OwnOfALink = Rule(free=True, links="none")
_OfScans = Rule(links="scans")


@strict
@dataclass(frozen=True)
class TrainerOptions:
    """Arguments of Lightning's Trainer for training; their defaults are in conf/trainer."""

    accelerator: Free[str]
    strategy: Free[str]
    devices: Free[_Devices | str | Sequence[Natural]]
    num_nodes: Free[Annotated[Count, Field(le=10**4)]]
    precision: Free[Integer | str]
    fast_dev_run: bool | Natural
    max_epochs: _End | None
    min_epochs: Count | None
    max_steps: _End
    min_steps: Count | None
    max_time: Free[_Time | None]
    limit_train_batches: _Batches | None
    limit_val_batches: Natural | Share | None
    overfit_batches: Natural | Share
    val_check_interval: Free[Natural | Share | _Time | None]
    check_val_every_n_epoch: Count | None
    num_sanity_val_steps: Annotated[Integer, Field(ge=-1)]
    log_every_n_steps: Free[Natural]
    enable_checkpointing: bool
    enable_progress_bar: Free[bool]
    enable_model_summary: bool
    accumulate_grad_batches: Free[Count]
    gradient_clip_val: NonNegative | None
    gradient_clip_algorithm: Literal["norm", "value"] | None
    deterministic: bool | Literal["warn"] | None
    benchmark: bool | None
    inference_mode: bool
    use_distributed_sampler: bool
    profiler: Free[str | None]
    detect_anomaly: bool
    barebones: bool
    sync_batchnorm: bool
    reload_dataloaders_every_n_epochs: Natural
    default_root_dir: Free[str | None]
    enable_autolog_hparams: bool


@strict
@dataclass(frozen=True)
class SampleOptions:
    """Samples drawn at the end of a run."""

    num: Natural = 4


@dataclass(frozen=True)
class _StageKeys:
    parent: Found[ParentRecord]


@dataclass(frozen=True)
class _EncodingKeys:
    reflectance: Found[Any]
    levels: Found[Any]


@dataclass(frozen=True)
class _CallbackKeys:
    """Callbacks that do not change the weights."""

    reflow_pairs: Free[Any]
    pictures: Free[Any]
    curvature: Free[Any]
    guard: Free[Any]
    requeue: Free[Any]
    checkpoint: Free[Any]
    progress: Free[Any]


@dataclass(frozen=True)
class StageRecord:
    """How a model is trained."""

    name: str = ""  # of a stage in `STAGES`; empty: unknown
    parent: ParentRecord | None = None  # the model that it starts from; before a run its path alone
    options: Options = field(default_factory=dict)  # the stage's others

    @classmethod
    def of(cls, group: Options) -> "StageRecord":
        """The record of a config's group `stage`."""
        options = dict(group)
        name = options.pop("name", None)
        parent = options.pop("parent", None)
        if parent is not None:
            known = parent if isinstance(parent, Mapping) else {"path": str(parent)}
            parent = construct("stage.parent", ParentRecord, known)
        return cls(name or "", parent, options)

    @property
    def steps(self) -> int | None:
        """Sampling steps of a distilled model, else None."""
        return self.options.get("steps")


@dataclass(frozen=True)
class Length:
    """How long a run is to train."""

    max_steps: int = 0  # 0: unknown
    max_epochs: int | None = None


@strict
@dataclass(frozen=True)
class RunConfig:
    """All keys of a run. Options of a registry's class are checked by that class."""

    stage: Annotated[_Named, _StageKeys]  # class of `STAGES`, with its options
    backbone: Annotated[Options | None, _OfScans]  # the following four: as in `Stage`
    sensor: Annotated[Options, _OfScans]
    encoding: Annotated[Options, _EncodingKeys, _OfScans]
    data: Annotated[DataOptions, _OfScans]
    trainer: TrainerOptions
    callbacks: Annotated[Mapping[str, Options | None], _CallbackKeys]  # classes of `CALLBACKS`
    samples: Free[SampleOptions]
    run_dir: Annotated[str, Bound("a folder", lambda name: name.strip("/ ")), _OwnOfALink]
    seed: Seed
    name: Annotated[_InRuns | int | float, _OwnOfALink] = "run"
    experiment: Annotated[str | Sequence[str] | None, _OwnOfALink] = None
    generator: Annotated[Options | str | None, _OfScans] = None
    sampler: Free[Options | None] = None
    few: Free[Options | None] = None
    chain: Annotated[Mapping[Any, Any] | None, _OwnOfALink] = None  # links by name
    preview: Annotated[str | None, _OwnOfALink] = None
    metric: Annotated[str, _OwnOfALink] = "val/loss"  # of a sweep's job, for its sweeper
    loggers: Free[Sequence[str] | None] = None
    plugins: Free[Sequence[str]] = ()
    scans: Found[Any] = None  # identity of the scans

    @classmethod
    def of(cls, config: Options) -> "RunConfig":
        """The config of composed keys.

        Raises:
            InputError: an unknown key, a missing one, or a value out of its bounds.
        """
        groups = {"trainer": TrainerOptions, "data": DataOptions}
        data = config.get("data")
        if isinstance(data, Mapping) and "name" not in data:
            raise InputError(f"data: must be a group with a name, found {data!r}.")
        typed = {
            key: construct(key, kind, config[key])
            for key, kind in groups.items()
            if isinstance(config.get(key), Mapping)
        }
        return construct("the config", cls, {**config, **typed})

    @cached_property
    def recipe(self) -> StageRecord:
        """The stage, with its options."""
        return StageRecord.of(self.stage)

    def plain(self) -> Config:
        """The config as nested dictionaries, as in its file."""
        return asdict(self)

    def model_config(self) -> "ModelConfig":
        """The config that a checkpoint of the run has."""
        return ModelConfig(self.plain())


@dataclass(frozen=True)
class ModelConfig:
    """The config that a model was trained with, as far as its file keeps it, with typed groups."""

    stored: Options

    @property
    def model(self) -> Config:
        """The groups that `build_generator` takes."""
        return {group: self.stored.get(group) for group in MODEL}

    @property
    def backbone(self) -> str | None:
        """Name of the backbone; None: the generator has its own network."""
        return (self.stored.get("backbone") or {}).get("name")

    @property
    def encoding(self) -> Config:
        """Options of the encoding."""
        return self.stored.get("encoding") or {}

    @property
    def generator(self) -> Config:
        """Name and options of the generator."""
        return self.stored.get("generator") or {"name": "rectified_flow"}

    @cached_property
    def stage(self) -> StageRecord:
        """The stage that trained it."""
        return StageRecord.of(self.stored.get("stage") or {})

    @cached_property
    def data(self) -> DataOptions:
        """The scans that it was trained on; the file may have keys of other versions."""
        options = _known(DataOptions, self.stored.get("data") or {})
        for group, kind in _GROUPS_OF_DATA.items():
            if isinstance(options.get(group), Mapping):
                options[group] = _known(kind, options[group])
        return construct("data", DataOptions, options)

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.stored.get("seed") or 0

    @property
    def steps(self) -> int:
        """Optimiser steps of the whole training; 0: unknown."""
        return self.length.max_steps

    @cached_property
    def length(self) -> Length:
        """How long it was to be trained."""
        return Length(**_known(Length, self.stored.get("trainer") or {}))

    @property
    def plugins(self) -> Sequence[str]:
        """Plug-ins that it was trained with."""
        return self.stored.get("plugins") or ()


_GROUPS_OF_DATA = {
    "reading": ReadingOptions,
    "validation": ValidationOptions,
    "pairs": PairOptions,
}


def _known(kind: Any, options: Options) -> Config:
    """The options that a dataclass has, without those that are None."""
    names = [one.name for one in fields(kind)]
    return {name: options[name] for name in names if options.get(name) is not None}


def is_free(key: str) -> bool:
    """Whether a key may differ on resumption."""
    return any(rule.free for rule in rules_of(RunConfig, key))


def is_found(key: str) -> bool:
    """Whether a run fills a key in."""
    return any(rule.found for rule in rules_of(RunConfig, key))


def links_of_key(override: str) -> str:
    """The links of a chain that take an override from its command line: see `Rule.links`."""
    key = key_of(override)
    if key.partition(".")[0] not in rules_in(RunConfig):  # a choice of the command, as `size`
        return "none"
    return next((rule.links for rule in rules_of(RunConfig, key) if rule.links), "all")


def contradictions(old: Options, new: Options) -> dict[str, str]:
    """Keys in which a run and another config that would resume it differ, with both values."""
    return {key: text for key, text in differences(old, new).items() if not is_free(key)}


def learned(config: Options, prefix: str = "") -> Config:
    """A config without its free keys: the settings that affect the result."""
    fixed: Config = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            if inner := learned(value, f"{prefix}{key}."):
                fixed[key] = inner
        elif not is_free(f"{prefix}{key}"):
            fixed[key] = value
            if is_groups(value):
                fixed[key] = [learned(group, f"{prefix}{key}.") for group in value]
    return fixed
