"""The one DataModule that every stage shares."""

import hashlib
import logging
import math
from collections.abc import Mapping, Sequence
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset

from r2flow import simulator
from r2flow.data.augment import Augmentation
from r2flow.data.loader import FixedSampler, FlowDataset, Item, Order, Permutations, RunLoader, RunSampler
from r2flow.data.mixture import MixedOrder, Mixture, refuse_shared_scans, scan_places
from r2flow.data.opening import (
    MIXED,
    SIMULATED,
    PartOptions,
    SourceOptions,
    open_source,
    split_parts,
    validation_source,
)
from r2flow.data.pairs import PairDataset, PairOptions, PairSource
from r2flow.data.shards import PairStore
from r2flow.data.sources import InMemory, ScanFiles, ScanSource, SimulatedScans, holdout_block, spread
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.progress import track
from r2flow.registry import check_options
from r2flow.signals import outlive_the_signal

log = logging.getLogger(__name__)

PAIRS = "pairs"


class ScanDataModule(L.LightningDataModule):
    """Projected scans with their noise, or pairs that a flow has drawn, for training and validation.

    Args:
        sensor: What the scans are projected through.
        encoding: Metres to model space.
        seed: Run seed; noise, times and order derive from it (`r2flow.noise`).
        name: `simulated`, `pairs`, `prepared` (what `r2flow prepare` wrote), `mixed`, or a layout of
            `r2flow.data.layouts.LAYOUTS`.
        root: Folder of the data set, or of the pairs.
        split: Part of the layout's standard split; None takes all.
        drives: Drives to take; None takes all.
        scenes: Number of simulated training scenes.
        projection: `spherical` or `unfolding`.
        convention: `centre` or `reference`.
        reflectance_scale: The value in the files that means full reflectance.
        on_bad_scan: `error` or `skip`.
        parts: Of `mixed`: its data sets, each `{name, root, split, drives, ..., weight}`. The weights are the shares of
            the run's images; without any, all scans are one set.
        augment: Options of `r2flow.data.augment.Augmentation`, done to training scans.
        batch_size: Images in one optimiser step, over all devices and accumulated batches.
        workers: Loader processes a device.
        memory_gib: Training scans are kept in memory where they fit into this, else read when needed.
        validation: `{share, scans, data}`: the share of the scans held out as one contiguous block, the most
            scans to validate on, or `data`, another data config (name, root, split, drives, ...) to hold out instead.
        pairs: Options of `r2flow.data.pairs.PairOptions`, where the data are pairs.
    """

    def __init__(
        self,
        sensor: Sensor,
        encoding: Encoding,
        seed: int,
        name: str = SIMULATED,
        root: str | int | None = None,
        split: str | None = None,
        drives: list[str | int] | None = None,
        scenes: int = 512,
        projection: str = "spherical",
        convention: str = "centre",
        reflectance_scale: float = 1.0,
        on_bad_scan: str = "error",
        parts: Sequence[Mapping[str, Any]] | None = None,
        augment: Mapping[str, Any] | None = None,
        batch_size: int = 8,
        workers: int = 0,
        memory_gib: float = 2.0,
        validation: Mapping[str, Any] | None = None,
        pairs: Mapping[str, Any] | None = None,
        noise_shape: Sequence[int] | None = None,
    ) -> None:
        super().__init__()
        self.noise_shape = noise_shape
        if batch_size < 1 or workers < 0:
            raise InputError(
                f"data.batch_size must be at least 1 and data.workers at least 0; found {batch_size} and {workers}."
            )
        self.sensor, self.encoding, self.seed = sensor, encoding, seed
        self.options = SourceOptions(
            name, root, split, drives, scenes, projection, convention, reflectance_scale, on_bad_scan
        )
        if parts is not None and name != MIXED:
            raise InputError(f"data.parts are those of data=mixed, found data={name}; leave them out, or give it.")
        self.parts = split_parts(self.options, parts) if name == MIXED else [self.options]
        self.batch_size, self.workers, self.memory_gib = batch_size, workers, memory_gib
        check_options("data.augment", Augmentation, augment or {})
        self.augment = Augmentation(**(augment or {}))
        self.validation = dict(validation or {})
        check_options("data.validation", _validation_options, self.validation)
        self.names: list[str] = []
        self.training_source: ScanSource | PairSource | None = None
        self.validation_source: ScanSource | PairSource | None = None
        self.pairs = self._pair_options(pairs or {}) if name == PAIRS else None

    def _pair_options(self, options: Mapping[str, Any]) -> PairOptions:
        check_options("data.pairs", PairOptions, options)
        if self.augment:
            raise InputError("data.augment changes scans, and a changed pair is none of the flow's; leave it out.")
        if self.validation.get("data") is not None:
            raise InputError("data.validation.data cannot be held out from pairs; leave it out.")
        if self.options.root is None:
            raise InputError("data=pairs needs the flow that draws them: stage.init=RUN.")
        return PairOptions(**options)

    @property
    def pair_store(self) -> PairStore:
        """The folder of the run's pairs, whatever it holds yet."""
        assert self.pairs is not None
        shape = self.encoding.shape
        return PairStore(self.options.folder, self.pairs.recipe(shape))

    def setup(self, stage: str | None = None) -> None:
        if self.training_source is not None:
            return
        if self.pairs is not None:
            _ = self.pair_store  # other pairs in its folder are refused now; missing ones are made later
            return
        training, held = self.sources()
        self._order(training)  # weights that it refuses are refused before anything is read or written
        self.training_source = self._kept(training, "training scans")
        self.validation_source = self._kept(held, "validation scans")

    def sources(self) -> tuple[ScanSource, ScanSource]:
        """The scans to train on and those held out, none of them read yet.

        Without other data to hold out, each part of a mixture holds out its own block.
        """
        share, most, other = _validation_options(**self.validation)
        opened = [self._open(options) for options in self.parts]
        whole = [source for source, _ in opened]
        if len(whole) > 1:
            refuse_shared_scans(whole)
        self.names = [
            f"{label}{name}" for label, source in zip(self._labels(), whole, strict=True) for name in source.names
        ]
        if other is None:
            blocks = [holdout_block(len(source), share, starts) for source, starts in opened]
            training = [source.subset(first) for source, (first, _) in zip(whole, blocks, strict=True)]
            held = [source.subset(last) for source, (_, last) in zip(whole, blocks, strict=True)]
        else:
            # Scenes that are held out beside simulated training ones come after them.
            first_scene = max((part.scenes for part in self.parts if part.name == SIMULATED), default=0)
            training, held = whole, [self._open(validation_source(self.options, other), first_scene)[0]]
            shared = scan_places(held[0]) & set().union(*map(scan_places, whole))
            if shared:
                log.warning(
                    "data.validation.data holds %d scans that are trained on, as %s: give it its own split or drives",
                    len(shared), min(shared),
                )  # fmt: skip
        validation = self._joined(held)
        return self._joined(training), validation.subset(spread(len(validation), most))

    def _open(self, options: SourceOptions, first_scene: int = 0) -> tuple[ScanSource, list[int]]:
        return open_source(options, self.sensor, self.seed, self.encoding.reflectance, first_scene)

    def _labels(self) -> list[str]:
        """What goes before the names of each part's scans: they are told apart by it."""
        return [f"{number}: " if len(self.parts) > 1 else "" for number in range(len(self.parts))]

    def _joined(self, sources: list[ScanSource]) -> ScanSource:
        return sources[0] if len(sources) == 1 else Mixture(sources)

    def _order(self, source: ScanSource | PairSource) -> Order:
        """Which scan is image k of the run."""
        weights = [part.weight for part in self.parts if isinstance(part, PartOptions) and part.weight is not None]
        if isinstance(source, Mixture) and weights:
            return MixedOrder(source.sizes, weights, self.seed)
        return Permutations(len(source), self.seed)

    def fingerprint(self) -> str:
        """What is trained on, wherever it lies: a run goes on only with the same scans in the same order."""
        if self.pairs is not None:
            return f"{self.pairs.num} pairs, {self.pair_store.recipe.digest}"
        assert self.training_source is not None
        # Another revision of the simulator draws other scans of the same name.
        revision = [f"simulator {simulator.REVISION}"] if any(p.name == SIMULATED for p in self.parts) else []
        names = hashlib.sha256("\n".join([*self.names, *revision]).encode()).hexdigest()[:12]
        return f"{len(self.training_source)} of {len(self.names)} scans, {names}"

    def _kept(self, source: ScanSource, what: str) -> ScanSource:
        """The source in memory where all that is slow to get of it fits there, read with a progress bar."""
        parts = source.parts if isinstance(source, Mixture) else [source]
        height, width = self.sensor.shape
        scans = sum(len(part) for part in parts if isinstance(part, ScanFiles | SimulatedScans))
        if scans * (1 + self.encoding.reflectance) * height * width * 4 > self.memory_gib * 2**30:
            return source

        def read(part: ScanSource) -> ScanSource:
            # What was prepared is mapped from its files, which the system keeps in memory as it sees fit.
            if not isinstance(part, ScanFiles | SimulatedScans) or len(part) == 0:
                return part
            return InMemory(part, lambda numbers: track(numbers, f"reading {what}", least=16))

        return Mixture([read(part) for part in parts]) if isinstance(source, Mixture) else read(source)

    def _ranks(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def check_run(self, ranks: int, accumulated: int, max_steps: int) -> None:
        """Refuse a run whose global batch cannot be shared, or that has no length.

        Raises:
            InputError: either of these.
        """
        if self.batch_size % (ranks * accumulated):
            raise InputError(
                f"data.batch_size={self.batch_size} cannot be shared by {ranks} devices times "
                f"{accumulated} accumulated batches; give a multiple of {ranks * accumulated}."
            )
        if max_steps < 1:
            raise InputError(f"trainer.max_steps must be at least 1, found {max_steps}: it is the length of a run.")

    def train_dataloader(self) -> RunLoader:
        """The rest of the run: from the trainer's step on, to max_steps."""
        self._ready()
        assert self.training_source is not None
        assert self.trainer is not None
        rank, ranks = self._ranks()
        accumulated = self.trainer.accumulate_grad_batches
        self.check_run(ranks, accumulated, self.trainer.max_steps)
        sampler = RunSampler(
            self._order(self.training_source),
            self.batch_size // accumulated,
            self.trainer.max_steps * accumulated,
            rank,
            ranks,
        )
        sampler.first_batch = self.trainer.global_step * accumulated
        return RunLoader(self._dataset(self.training_source, "training"), sampler, **self._loader_options())

    def _ready(self) -> None:
        """Open what is there by now: pairs are made after `setup`.

        Raises:
            InputError: some pairs are missing still.
        """
        self.setup()
        if self.pairs is not None and self.training_source is None:
            share, most, _ = _validation_options(**self.validation)
            pairs = PairSource(self.pair_store, self.pairs.num)
            first, last = holdout_block(len(pairs), share)
            self.training_source = pairs.subset(first)
            self.validation_source = pairs.subset([last[i] for i in spread(len(last), most)])

    def _dataset(self, source: ScanSource | PairSource, purpose: str) -> Dataset[Item]:
        if isinstance(source, PairSource):
            return PairDataset(source, self.seed, purpose)
        augment = self.augment if purpose == "training" else None
        return FlowDataset(source, self.encoding, self.seed, purpose, augment, self.noise_shape)

    def val_dataloader(self) -> DataLoader[Item] | list[Any]:
        self._ready()
        assert self.validation_source is not None
        if len(self.validation_source) == 0:
            return []
        rank, ranks = self._ranks()
        scans, batch_size = len(self.validation_source), max(self.batch_size // ranks, 1)
        # Every rank needs as many batches as the others, or they would wait for each other: with fewer scans
        # than ranks all take all of them, else the few that are left over are left out.
        if scans < ranks:
            rank, ranks = 0, 1
        sampler = FixedSampler(scans - scans % ranks, batch_size, rank, ranks)
        dataset = self._dataset(self.validation_source, "validation")
        return DataLoader(dataset, batch_sampler=sampler, **self._loader_options())

    def _loader_options(self) -> dict[str, Any]:
        return {
            "num_workers": self.workers,
            "persistent_workers": self.workers > 0,
            "worker_init_fn": outlive_the_signal,
            "pin_memory": torch.cuda.is_available(),
        }


def _validation_options(
    share: float = 0.1, scans: int = 64, data: Mapping[str, Any] | None = None
) -> tuple[float, int, Mapping[str, Any] | None]:
    if not (isinstance(scans, int) and scans >= 0 and math.isfinite(share)):
        raise InputError(f"data.validation.scans must be a whole number, found {scans!r}.")
    return share, scans, data
