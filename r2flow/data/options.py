"""Keys of a run's `data`: types, defaults and meaning."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from r2flow.base.config import Found, Free, Rule
from r2flow.base.errors import InputError
from r2flow.base.registry import (
    Config,
    Count,
    Natural,
    NonNegative,
    Options,
    Portion,
    Positive,
    Seed,
    strict,
)
from r2flow.generators.base import Precision
from r2flow.lidar.labels import SEMANTIC_KITTI, label_list
from r2flow.lidar.projection import Convention, Projection
from r2flow.lidar.scan_files import check_columns
from r2flow.samplers import build_sampler

# names in `r2flow.data.kinds.SOURCES`
SIMULATED = "simulated"
PREPARED = "prepared"
FOLDER = "folder"
# other values of `data.name`: several sets of scans, and pairs drawn by a flow
MIXED = "mixed"
PAIRS = "pairs"
_OfAll = Rule(links="all")  # links of a chain


@strict
@dataclass(frozen=True)
class ReadingOptions:
    """Fields of a `Reading` in a config (`data.reading`); None: from the parent run or the scans,
    or default.
    """

    projection: Projection | None = None
    convention: Convention | None = None
    reflectance_scale: Positive | None = None
    columns: Sequence[str] | None = None
    on_bad_scan: Literal["error", "skip"] | None = None
    label_ids: str | Mapping[int | str, Any] | None = None  # a `LabelList`: name, file or map

    def __post_init__(self) -> None:
        check_columns(self.columns)
        label_list(self.label_ids or SEMANTIC_KITTI)


@strict
@dataclass(frozen=True)
class SourceOptions:
    """One set of scans."""

    name: str = SIMULATED  # kind of scans: a name in `r2flow.data.kinds.SOURCES`
    root: Free[str | int | None] = None  # folder of the data set
    split: str | None = None  # part of the data set's standard split; None takes all
    drives: list[str | int] | None = None  # names or numbers of the drives to take; None takes all
    scenes: Annotated[int, Field(ge=1, le=10**7)] = 512  # number of simulated scenes
    reading: ReadingOptions | None = None

    @property
    def reading_fields(self) -> Config:
        """The fields of `reading` that are not None."""
        fields = asdict(self.reading) if self.reading else {}
        return {key: value for key, value in fields.items() if value is not None}

    @property
    def folder(self) -> Path:
        """`root` as a path: YAML reads a folder name of digits as a number."""
        if self.root is None:
            raise InputError(f"data={self.name} needs the folder of its scans: data.root=FOLDER.")
        return Path(str(self.root)).expanduser()


@strict
@dataclass(frozen=True)
class PartOptions(SourceOptions):
    """One part of a mixture (`data.parts`)."""

    weight: Positive | None = None  # relative share of a run's images
    # `build_sensor`; None: the run's. Only stage=transfer takes several
    sensor: Options | None = None


@strict
@dataclass(frozen=True)
class ValidationOptions:
    """Held-out scans (`data.validation`)."""

    share: Portion = 0.1  # approximate share of the scans to hold out, in one contiguous block
    scans: Natural = 64  # maximum number of validation scans
    # another set of scans to hold out instead: {name, root, split, drives, ...}
    data: Annotated[Options | None, SourceOptions, Rule(links="scans")] = None


@dataclass(frozen=True)
class ParentRecord:
    """Identity of the model that a run starts from, as its checkpoints store it."""

    path: Free[str] = ""
    weights: str | None = None  # hash of the averaged weights; None: not trained yet
    step: int = 0
    stage: str | None = None
    first_pair: int = 0  # the first pair whose noise the model was not trained on
    pairs: Free[str] = ""  # default folder of its pairs


@strict
@dataclass(frozen=True)
class PairOptions:
    """Settings of a set of pairs (`data.pairs`)."""

    num: Count = 1000
    # of the flow that draws them
    sampler: Options = field(default_factory=lambda: {"name": "adams3"})
    batch_size: Count = 16  # pairs solved in one batch; the last bits of a pair depend on it
    shard_mib: Positive = 16.0  # size of a shard; a killed process repeats its shard
    # seed of the noise, separate from the run's: runs of several seeds can share one set of pairs
    seed: Seed = 0
    # index of the first pair; None: after the pairs that the flow itself was trained on
    first: Seed | None = None
    precision: Precision = "32-true"  # precision of the network
    of: Free[str | None] = None  # the flow that draws the pairs; None: the stage's parent
    parent: Found[str | None] = None  # hash of the flow, filled in by the run

    def __post_init__(self) -> None:
        build_sampler(self.sampler)


@strict
@dataclass(frozen=True)
class DataOptions(SourceOptions):
    """All keys of a run's `data`. `name` may also be `mixed` or `pairs`; for `pairs`, `root` is
    their folder.

    The weights of parts are relative shares of the run's images; without weights, the parts are
    concatenated.
    """

    # of `mixed`: {name, root, split, drives, ..., weight} each
    parts: Sequence[Annotated[Options, PartOptions]] | None = None
    # `r2flow.data.augment.Augmentation`, of training scans only
    augment: Options | None = None
    # images in one optimiser step, over all devices and accumulated batches
    batch_size: Annotated[Count, _OfAll] = 4
    # loader processes per device
    workers: Annotated[Natural, Field(le=1000), _OfAll, Rule(free=True)] = 0
    # training scans that fit into this are kept in memory, others read when needed
    memory_gib: Annotated[NonNegative, _OfAll, Rule(free=True)] = 2.0
    validation: Annotated[ValidationOptions, _OfAll] = ValidationOptions()
    pairs: Annotated[PairOptions, Rule(links="pairs")] = PairOptions()
    # `SourceOptions` of scans next to pairs, for the velocities of a flow map
    scans: Annotated[Options | None, SourceOptions, Rule(links="pairs")] = None

    def __post_init__(self) -> None:
        for key, name in (("parts", MIXED), ("scans", PAIRS)):
            if getattr(self, key) is not None and self.name != name:
                raise InputError(
                    f"data.{key} needs data={name}, found data={self.name}; leave one of them out."
                )
