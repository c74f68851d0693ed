"""Every key of a run's `data`, once: its type, its default and what it means."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from r2flow.data.pairs import PairRecipe
from r2flow.errors import InputError
from r2flow.generators.base import Precision
from r2flow.lidar.projection import Convention, Projection
from r2flow.lidar.scan_files import check_columns
from r2flow.registry import Count, Natural, NonNegative, Portion, Positive, Seed, check_options
from r2flow.samplers import build_sampler

SIMULATED, PREPARED, FOLDER = "simulated", "prepared", "folder"  # in the table `r2flow.data.opening.SOURCES`
Data = dict[str, Any]  # of a config
MIXED, PAIRS = "mixed", "pairs"  # what `data.name` may be besides: several sets of scans, and pairs drawn by a flow
MOST_SCENES = 10**7  # whose order alone takes 80 MB


@dataclass(frozen=True)
class ReadingOptions:
    """The fields of a `Reading` that a config chooses (`data.reading`); None: the parent's, the scans' or the usual."""

    projection: Projection | None = None
    convention: Convention | None = None
    reflectance_scale: Positive | None = None
    columns: list[str] | None = None
    on_bad_scan: Literal["error", "skip"] | None = None


@dataclass(frozen=True)
class SourceOptions:
    """One set of scans. A value that cannot be is refused (`InputError`), here and in the options below."""

    name: str = SIMULATED  # its kind: a name in `r2flow.data.opening.SOURCES`
    root: str | int | None = None  # folder of the data set
    split: str | None = None  # part of the data set's standard split; None takes all
    drives: list[str | int] | None = None  # names or numbers of the drives to take; None takes all
    scenes: int = 512  # number of simulated scenes
    reading: Mapping[str, Any] | None = None  # fields of `r2flow.data.reading.Reading`: projection, convention, ...
    weight: Positive | None = None  # of one of several sets: its share of a run's images

    def __post_init__(self) -> None:
        if not 1 <= self.scenes <= MOST_SCENES:
            raise InputError(f"data.scenes must be 1 to {MOST_SCENES:,}, found {self.scenes}.")
        check_options("data.reading", ReadingOptions, self.reading or {})
        check_columns(self.columns)

    @property
    def chosen(self) -> dict[str, Any]:
        """What `reading` says."""
        return {key: value for key, value in (self.reading or {}).items() if value is not None}

    @property
    def columns(self) -> list[str] | None:
        return self.chosen.get("columns")

    @property
    def on_bad_scan(self) -> str:
        found: str = self.chosen.get("on_bad_scan", "error")
        return found

    @property
    def folder(self) -> str:
        """`root`, which is a folder's name even where it looks like a number."""
        if self.root is None:
            raise InputError(f"data={self.name} needs the folder of its scans: data.root=FOLDER.")
        return str(self.root)


@dataclass(frozen=True)
class ValidationOptions:
    """What is held out of the training (`data.validation`)."""

    share: Portion = 0.1  # about this share of the scans, in one contiguous block
    scans: Natural = 64  # the most scans to validate on
    data: Mapping[str, Any] | None = None  # another set of scans to hold out instead: {name, root, split, drives, ...}


@dataclass(frozen=True)
class PairOptions:
    """The choices behind a set of pairs (`data.pairs`)."""

    num: Count = 1000
    sampler: Mapping[str, Any] = field(default_factory=lambda: {"name": "adams3"})  # of the flow that draws them
    batch_size: Count = 16  # pairs solved together; the last bits of a pair depend on it
    shard_mib: Positive = 16.0  # of a shard, which a killed process begins again
    seed: Seed = 0  # of the noise; not the run's: runs of several seeds can share one set of pairs
    first: Seed | None = None  # index of the first pair; None: behind the pairs that the flow itself was trained on
    precision: Precision = "32-true"  # of the network
    knots: Natural | None = None  # inner states of each path to keep with its pair, for stage=flow_map
    of: str | None = None  # the flow that draws them; None: that of stage.init
    parent: str | None = None  # hash of the flow; the run fills it in

    def recipe(self, shape: tuple[int, int, int], noise_shape: tuple[int, ...] | None = None) -> PairRecipe:
        """All that pairs depend on, where scans and their noise have these shapes in model space."""
        sampler = build_sampler(self.sampler).asdict()
        if self.knots:
            build_sampler(sampler).knot_times(self.knots)
        size = self.batch_size * 2 * math.prod(shape) * (1 + (self.knots or 0))
        shard_batches = max(round(self.shard_mib * 2**20 / size), 1)
        return PairRecipe(
            self.parent or "", shape, self.seed, self.first or 0, sampler, self.batch_size, shard_batches,
            None if noise_shape == shape else noise_shape, self.knots or 0, self.precision,
        )  # fmt: skip


@dataclass(frozen=True)
class DataOptions(SourceOptions):
    """All of a run's `data`. `name` may also be `mixed` or `pairs`; `root` is then that of the pairs.

    Weights of parts are the shares of the run's images; without any, all scans are one set.
    """

    parts: Sequence[Mapping[str, Any]] | None = None  # of `mixed`: {name, root, split, drives, ..., weight} each
    augment: Mapping[str, Any] | None = None  # `r2flow.data.augment.Augmentation`, of training scans alone
    batch_size: Count = 8  # images in one optimiser step, over all devices and accumulated batches
    workers: Natural = 0  # loader processes of each device
    memory_gib: NonNegative = 2.0  # training scans are kept in memory where they fit into this, else read when needed
    validation: Mapping[str, Any] | None = None  # `ValidationOptions`
    pairs: Mapping[str, Any] | None = None  # `PairOptions`, where the data are pairs
    scans: Mapping[str, Any] | None = None  # `SourceOptions` of scans beside pairs, for the velocities of a flow map

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.parts is not None and self.name != MIXED:
            raise InputError(f"data.parts are those of data=mixed, found data={self.name}; leave them out, or give it.")
        if self.scans is not None and self.name != PAIRS:
            raise InputError(
                f"data.scans stand beside pairs, found data={self.name}; leave them out, or give data=pairs."
            )

    @property
    def validation_options(self) -> ValidationOptions:
        """`validation`, checked."""
        check_options("data.validation", ValidationOptions, self.validation or {})
        return ValidationOptions(**(self.validation or {}))

    # What follows needs the `data` of `r2flow.data.resolving.resolve`.

    @property
    def sets(self) -> list[SourceOptions]:
        """The sets of scans to train on; empty for pairs."""
        if self.name == MIXED:
            return [SourceOptions(**part) for part in self.parts or ()]
        alone = SourceOptions(**{f.name: getattr(self, f.name) for f in fields(SourceOptions)})
        return [] if self.name == PAIRS else [alone]

    @property
    def held_out(self) -> SourceOptions | None:
        """The set of `validation.data`."""
        other = self.validation_options.data
        return None if other is None or self.name == PAIRS else SourceOptions(**other)

    @property
    def next_to_pairs(self) -> SourceOptions | None:
        """The set of `scans`."""
        return None if self.scans is None else SourceOptions(**self.scans)
