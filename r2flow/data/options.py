"""Keys of a run's `data`: types, defaults and meaning."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from r2flow.errors import InputError, check
from r2flow.generators.base import Precision
from r2flow.lidar.projection import Convention, Projection
from r2flow.lidar.scan_files import check_columns
from r2flow.registry import Bound, Count, Natural, NonNegative, Portion, Positive, Seed, check_options, construct
from r2flow.samplers import build_sampler

SIMULATED, PREPARED, FOLDER = "simulated", "prepared", "folder"  # names in `r2flow.data.opening.SOURCES`
Data = dict[str, Any]  # of a config
MIXED, PAIRS = "mixed", "pairs"  # other values of `data.name`: several sets of scans, and pairs drawn by a flow
SCENES = Bound("from 1 to 10,000,000", lambda n: 1 <= n <= 10**7)  # their order takes 80 MB


@dataclass(frozen=True)
class ReadingOptions:
    """Fields of a `Reading` in a config (`data.reading`); None: from the parent run or the scans, or default."""

    projection: Projection | None = None
    convention: Convention | None = None
    reflectance_scale: Positive | None = None
    columns: list[str] | None = None
    on_bad_scan: Literal["error", "skip"] | None = None


@dataclass(frozen=True)
class SourceOptions:
    """One set of scans. Invalid values raise `InputError`, here and in the options below."""

    name: str = SIMULATED  # kind of scans: a name in `r2flow.data.opening.SOURCES`
    root: str | int | None = None  # folder of the data set
    split: str | None = None  # part of the data set's standard split; None takes all
    drives: list[str | int] | None = None  # names or numbers of the drives to take; None takes all
    scenes: Annotated[int, SCENES] = 512  # number of simulated scenes
    reading: Mapping[str, Any] | None = None  # fields of `r2flow.data.reading.Reading`: projection, convention, ...

    def __post_init__(self) -> None:
        check_options("data.reading", ReadingOptions, self.reading or {})
        check_columns(self.chosen.get("columns"))

    @property
    def chosen(self) -> dict[str, Any]:
        """The fields of `reading` that are not None."""
        return {key: value for key, value in (self.reading or {}).items() if value is not None}

    @property
    def folder(self) -> Path:
        """`root` as a path: YAML reads a folder name of digits as a number."""
        check(self.root is not None, f"data={self.name} needs the folder of its scans: data.root=FOLDER.")
        return Path(str(self.root)).expanduser()


@dataclass(frozen=True)
class PartOptions(SourceOptions):
    """One part of a mixture (`data.parts`)."""

    weight: Positive | None = None  # relative share of a run's images
    sensor: Mapping[str, Any] | None = None  # `build_sensor`; None: the run's. Only stage=transfer takes several


@dataclass(frozen=True)
class ValidationOptions:
    """Held-out scans (`data.validation`)."""

    share: Portion = 0.1  # approximate share of the scans to hold out, in one contiguous block
    scans: Natural = 64  # maximum number of validation scans
    data: Mapping[str, Any] | None = None  # another set of scans to hold out instead: {name, root, split, drives, ...}


@dataclass(frozen=True)
class PairOptions:
    """Settings of a set of pairs (`data.pairs`)."""

    num: Count = 1000
    sampler: Mapping[str, Any] = field(default_factory=lambda: {"name": "adams3"})  # of the flow that draws them
    batch_size: Count = 16  # pairs solved in one batch; the last bits of a pair depend on it
    shard_mib: Positive = 16.0  # size of a shard; a killed process repeats its shard
    seed: Seed = 0  # seed of the noise, separate from the run's: runs of several seeds can share one set of pairs
    first: Seed | None = None  # index of the first pair; None: after the pairs that the flow itself was trained on
    precision: Precision = "32-true"  # precision of the network
    of: str | None = None  # the flow that draws the pairs; None: the flow of stage.init
    parent: str | None = None  # hash of the flow, filled in by the run

    def __post_init__(self) -> None:
        build_sampler(self.sampler)


@dataclass(frozen=True)
class DataOptions(SourceOptions):
    """All keys of a run's `data`. `name` may also be `mixed` or `pairs`; for `pairs`, `root` is their folder.

    The weights of parts are relative shares of the run's images; without weights, the parts are concatenated.
    """

    parts: Sequence[Mapping[str, Any]] | None = None  # of `mixed`: {name, root, split, drives, ..., weight} each
    augment: Mapping[str, Any] | None = None  # `r2flow.data.augment.Augmentation`, of training scans only
    batch_size: Count = 8  # images in one optimiser step, over all devices and accumulated batches
    workers: Annotated[int, Bound("from 0 to 1,000", lambda n: 0 <= n <= 1000)] = 0  # loader processes per device
    memory_gib: NonNegative = 2.0  # training scans that fit into this are kept in memory, others read when needed
    validation: Mapping[str, Any] | None = None  # `ValidationOptions`
    pairs: Mapping[str, Any] | None = None  # `PairOptions`, for pairs
    scans: Mapping[str, Any] | None = None  # `SourceOptions` of scans next to pairs, for the velocities of a flow map

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, name in (("parts", MIXED), ("scans", PAIRS)):
            if getattr(self, key) is not None and self.name != name:
                raise InputError(f"data.{key} needs data={name}, found data={self.name}; leave one of them out.")

    @property
    def validation_options(self) -> ValidationOptions:
        return construct("data.validation", ValidationOptions, self.validation)

    # The following properties need the `data` of `r2flow.data.resolving.resolve`.

    @property
    def sets(self) -> list[PartOptions]:
        """The sets of scans to train on; empty for pairs."""
        if self.name == MIXED:
            return [PartOptions(**part) for part in self.parts or ()]
        single = PartOptions(**{f.name: getattr(self, f.name) for f in fields(SourceOptions)})
        return [] if self.name == PAIRS else [single]

    @property
    def held_out(self) -> SourceOptions | None:
        """The set of `validation.data`."""
        other = self.validation_options.data
        return None if other is None or self.name == PAIRS else SourceOptions(**other)
