"""Every key of a run's `data`, once: its type, its default and what it means."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from r2flow.data.shards import Recipe
from r2flow.errors import InputError
from r2flow.flow.solvers import check_method, check_tolerance
from r2flow.registry import check_options

SIMULATED, PREPARED, FOLDER = "simulated", "prepared", "folder"  # in the table `r2flow.data.opening.SOURCES`
MIXED, PAIRS = "mixed", "pairs"  # what `data.name` may be besides: several sets of scans, and pairs drawn by a flow

MIB = 2**20


@dataclass(frozen=True)
class SourceOptions:
    """One set of scans.

    Attributes:
        name: Its kind: a name in `r2flow.data.opening.SOURCES`.
        root: Folder of the data set.
        split: Part of the data set's standard split; None takes all.
        drives: Names or numbers of the drives to take; None takes all.
        scenes: Number of simulated scenes.
        projection: `spherical` or `unfolding`.
        convention: `centre` or `reference`.
        reflectance_scale: The value in the files that means full reflectance.
        on_bad_scan: What is done with a scan that cannot be used: `error`, or `skip` to take the next one.

    Raises:
        InputError: no scene, a reflectance scale that is not positive, or another value of `on_bad_scan`.
    """

    name: str = SIMULATED
    root: str | int | None = None
    split: str | None = None
    drives: list[str | int] | None = None
    scenes: int = 512
    projection: str = "spherical"
    convention: str = "centre"
    reflectance_scale: float = 1.0
    on_bad_scan: str = "error"

    def __post_init__(self) -> None:
        if not 0 < self.reflectance_scale < math.inf:
            raise InputError(f"data.reflectance_scale must be a positive number, found {self.reflectance_scale}.")
        if self.scenes < 1:
            raise InputError(f"data.scenes must be at least 1, found {self.scenes}.")
        if self.on_bad_scan not in ("error", "skip"):
            raise InputError(f"data.on_bad_scan must be 'error' or 'skip', found {self.on_bad_scan!r}.")

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """The keys of a config's `data` that are known here."""
        return cls(**{f.name: data[f.name] for f in fields(cls) if f.name in data})

    @property
    def folder(self) -> str:
        """`root`, which is a folder's name even where it looks like a number.

        Raises:
            InputError: there is none.
        """
        if self.root is None:
            raise InputError(f"data={self.name} needs the folder of its scans: data.root=FOLDER.")
        return str(self.root)


@dataclass(frozen=True)
class PartOptions(SourceOptions):
    """One of several sets of scans.

    Attributes:
        weight: Its share of the images of a run, beside the other parts' weights.
    """

    weight: float | None = None


@dataclass(frozen=True)
class ValidationOptions:
    """What is held out of the training (`data.validation`).

    Attributes:
        share: About this share of the scans, in one contiguous block.
        scans: The most scans to validate on.
        data: Another set of scans to hold out instead: {name, root, split, drives, ...}.

    Raises:
        InputError: `scans` is not a whole number of at least 0, or the share not finite.
    """

    share: float = 0.1
    scans: int = 64
    data: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.scans, int) and self.scans >= 0 and math.isfinite(self.share)):
            raise InputError(f"data.validation.scans must be a whole number, found {self.scans!r}.")


@dataclass(frozen=True)
class PairOptions:
    """The choices behind a set of pairs (`data.pairs`).

    Attributes:
        num: Number of pairs.
        method, steps, tolerance: The solver's (`r2flow.flow.solvers.solve`); the paper takes dopri5 at 1e-5.
        batch_size: Pairs solved together. The last bits of a pair depend on it.
        shard_mib: Size of a shard.
        seed: Of the noise. It is not the run's seed: runs of several seeds can share one set of pairs.
        first: Index of the first pair; None takes the one behind the pairs that the flow itself was trained on.
        parent: Hash of the flow; the run fills it in.
    """

    num: int = 1000
    method: str = "dopri5"
    steps: int = 32
    tolerance: float = 1e-5
    batch_size: int = 16
    shard_mib: float = 256.0
    seed: int = 0
    first: int | None = None
    parent: str | None = None

    def recipe(self, shape: tuple[int, int, int], noise_shape: tuple[int, ...] | None = None) -> Recipe:
        """All that pairs depend on, where scans have this shape in model space.

        Args:
            noise_shape: Shape of x_0, where it is not the scan's.

        Raises:
            InputError: a number out of its range or an unknown solver.
        """
        if min(self.num, self.batch_size, self.steps) < 1 or not 0 < self.shard_mib < math.inf:
            raise InputError(
                "data.pairs: num, batch_size, steps must be at least 1 and shard_mib positive; "
                f"found {self.num}, {self.batch_size}, {self.steps} and {self.shard_mib}."
            )
        first = self.first or 0
        if not (0 <= self.seed < 2**63 and 0 <= first < 2**63):
            raise InputError(f"data.pairs: seed and first must be at least 0, found {self.seed} and {first}.")
        check_tolerance(self.tolerance)
        check_method(self.method)
        batch_bytes = self.batch_size * 2 * int(np.prod(shape))
        return Recipe(
            parent=self.parent or "",
            shape=shape,
            seed=self.seed,
            first=first,
            method=self.method,
            steps=self.steps,
            tolerance=float(self.tolerance),  # 1 and 1.0 are one recipe
            batch_size=self.batch_size,
            shard_batches=max(round(self.shard_mib * MIB / batch_bytes), 1),
            noise_shape=None if noise_shape == shape else noise_shape,
        )


@dataclass(frozen=True)
class DataOptions(SourceOptions):
    """All of a run's `data`. `name` may also be `mixed` or `pairs`; `root` is then that of the pairs.

    Attributes:
        parts: Of `mixed`: its sets of scans, each `{name, root, split, drives, ..., weight}`. The weights are the
            shares of the run's images; without any, all scans are one set.
        augment: Options of `r2flow.data.augment.Augmentation`, done to training scans alone.
        batch_size: Images in one optimiser step, over all devices and accumulated batches.
        workers: Loader processes of each device.
        memory_gib: Training scans are kept in memory where they fit into this, else read when needed.
        validation: `ValidationOptions`.
        pairs: `PairOptions`, where the data are pairs.

    Raises:
        InputError: as for `SourceOptions`; an empty batch, fewer than no workers, parts without data=mixed.
    """

    parts: Sequence[Mapping[str, Any]] | None = None
    augment: Mapping[str, Any] | None = None
    batch_size: int = 8
    workers: int = 0
    memory_gib: float = 2.0
    validation: Mapping[str, Any] | None = None
    pairs: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.batch_size < 1 or self.workers < 0:
            raise InputError(
                "data.batch_size must be at least 1 and data.workers at least 0; "
                f"found {self.batch_size} and {self.workers}."
            )
        if self.parts is not None and self.name != MIXED:
            raise InputError(f"data.parts are those of data=mixed, found data={self.name}; leave them out, or give it.")

    @property
    def held(self) -> ValidationOptions:
        """`validation`, checked.

        Raises:
            InputError: an option that it does not know, or a value that it cannot take.
        """
        check_options("data.validation", ValidationOptions, self.validation or {})
        return ValidationOptions(**(self.validation or {}))
