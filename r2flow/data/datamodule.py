"""The one DataModule that every stage shares."""

import math
from collections.abc import Mapping
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader

from r2flow.data.layouts import find_drives
from r2flow.data.loader import FixedSampler, FlowDataset, Item, RunLoader, RunSampler
from r2flow.data.sources import (
    InMemory,
    ScanFiles,
    ScanSource,
    SimulatedScans,
    holdout_block,
    spread,
)
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.registry import check_options

SIMULATED = "simulated"


class ScanDataModule(L.LightningDataModule):
    """Projected scans with their noise, for training and validation.

    Args:
        sensor: What the scans are projected through.
        encoding: Metres to model space.
        seed: Run seed; noise, times and order derive from it (`r2flow.noise`).
        name: `simulated`, or a layout of `r2flow.data.layouts.LAYOUTS`.
        root: Folder of the data set.
        split: Part of the layout's standard split; None takes all.
        drives: Drives to take; None takes all.
        scenes: Number of simulated training scenes.
        projection: `spherical` or `unfolding`.
        convention: `centre` or `reference`.
        reflectance_scale: The value in the files that means full reflectance.
        on_bad_scan: `error` or `skip`.
        batch_size: Images in one optimiser step, over all devices and accumulated batches.
        workers: Loader processes a device.
        memory_gib: Training scans are kept in memory where they fit into this, else read when needed.
        validation: `{share, scans, data}`: the share of the scans held out as one contiguous block, the most
            scans to validate on, or `data`, another data config (name, root, split, drives, ...) to hold out instead.
    """

    def __init__(
        self,
        sensor: Sensor,
        encoding: Encoding,
        seed: int,
        name: str = SIMULATED,
        root: str | None = None,
        split: str | None = None,
        drives: list[str | int] | None = None,
        scenes: int = 512,
        projection: str = "spherical",
        convention: str = "centre",
        reflectance_scale: float = 1.0,
        on_bad_scan: str = "error",
        batch_size: int = 8,
        workers: int = 0,
        memory_gib: float = 2.0,
        validation: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        if batch_size < 1 or workers < 0 or scenes < 1:
            raise InputError(
                "data.batch_size and data.scenes must be at least 1 and data.workers at least 0; "
                f"found {batch_size}, {scenes} and {workers}."
            )
        self.sensor, self.encoding, self.seed = sensor, encoding, seed
        self.options = {
            "name": name, "root": root, "split": split, "drives": drives, "scenes": scenes,
            "projection": projection, "convention": convention,
            "reflectance_scale": reflectance_scale, "on_bad_scan": on_bad_scan,
        }  # fmt: skip
        self.batch_size, self.workers, self.memory_gib = batch_size, workers, memory_gib
        self.validation = dict(validation or {})
        check_options("data.validation", _validation_options, self.validation)
        self.training_source: ScanSource | None = None
        self.validation_source: ScanSource | None = None

    def setup(self, stage: str | None = None) -> None:
        if self.training_source is not None:
            return
        source = self._source(self.options)
        share, most, other = _validation_options(**self.validation)
        if other is not None:
            held: ScanSource = self._source({**self.options, "split": None, "drives": None, **other})
            training = source
        else:
            first, last = holdout_block(len(source), share)
            training, held = source.subset(first), source.subset(last)
        self.training_source = self._kept(training, "training scans")
        self.validation_source = self._kept(held.subset(spread(len(held), most)), "validation scans")

    def _source(self, options: Mapping[str, Any]) -> ScanSource:
        reflectance = self.encoding.reflectance
        if options["name"] == SIMULATED:
            return SimulatedScans(self.sensor, self.seed, range(options["scenes"]), reflectance)
        if options["root"] is None:
            raise InputError(f"data={options['name']} needs the folder of its scans: data.root=FOLDER.")
        drives = find_drives(options["name"], options["root"], options["split"], options["drives"])
        return ScanFiles(
            [path for drive in drives for path in drive.scans],
            self.sensor,
            options["on_bad_scan"],
            projection=options["projection"],
            convention=options["convention"],
            reflectance=reflectance,
            reflectance_scale=options["reflectance_scale"],
        )

    def _kept(self, source: ScanSource, what: str) -> ScanSource:
        """The source in memory where it fits, read with a progress bar."""
        height, width = self.sensor.shape
        size = len(source) * (1 + self.encoding.reflectance) * height * width * 4
        if size > self.memory_gib * 2**30 or len(source) == 0:
            return source
        from rich.progress import track

        return InMemory(source, lambda numbers: track(numbers, f"reading {what}", disable=len(numbers) < 16))

    def _ranks(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    def train_dataloader(self) -> RunLoader:
        """The rest of the run: from the trainer's step on, to max_steps."""
        assert self.training_source is not None
        assert self.trainer is not None
        rank, ranks = self._ranks()
        accumulated = self.trainer.accumulate_grad_batches
        if self.batch_size % (ranks * accumulated):
            raise InputError(
                f"data.batch_size={self.batch_size} cannot be shared by {ranks} devices times "
                f"{accumulated} accumulated batches; give a multiple of {ranks * accumulated}."
            )
        if self.trainer.max_steps < 1:
            raise InputError(
                f"trainer.max_steps must be at least 1, found {self.trainer.max_steps}: "
                "it is the length of a run, which is one epoch."
            )
        sampler = RunSampler(
            len(self.training_source),
            self.batch_size // accumulated,
            self.trainer.max_steps * accumulated,
            self.seed,
            rank,
            ranks,
        )
        sampler.first_batch = self.trainer.global_step * accumulated
        dataset = FlowDataset(self.training_source, self.encoding, self.seed, "training")
        return RunLoader(dataset, sampler, **self._loader_options())

    def val_dataloader(self) -> DataLoader[Item] | list[Any]:
        assert self.validation_source is not None
        if len(self.validation_source) == 0:
            return []
        rank, ranks = self._ranks()
        sampler = FixedSampler(len(self.validation_source), max(self.batch_size // ranks, 1), rank, ranks)
        dataset = FlowDataset(self.validation_source, self.encoding, self.seed, "validation")
        return DataLoader(dataset, batch_sampler=sampler, **self._loader_options())

    def _loader_options(self) -> dict[str, Any]:
        return {
            "num_workers": self.workers,
            "persistent_workers": self.workers > 0,
            "pin_memory": torch.cuda.is_available(),
        }


def _validation_options(
    share: float = 0.1, scans: int = 64, data: Mapping[str, Any] | None = None
) -> tuple[float, int, Mapping[str, Any] | None]:
    if not (isinstance(scans, int) and scans >= 0 and math.isfinite(share)):
        raise InputError(f"data.validation.scans must be a whole number, found {scans!r}.")
    return share, scans, data
