"""The one DataModule that every stage shares."""

import hashlib
import logging
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset

from r2flow.data.layouts import find_drives
from r2flow.data.loader import FixedSampler, FlowDataset, Item, RunLoader, RunSampler
from r2flow.data.pairs import PairDataset, PairOptions, PairSource
from r2flow.data.shards import PairStore
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
from r2flow.registry import check_options, did_you_mean

log = logging.getLogger(__name__)

SIMULATED = "simulated"
PAIRS = "pairs"


class ScanDataModule(L.LightningDataModule):
    """Projected scans with their noise, or pairs that a flow has drawn, for training and validation.

    Args:
        sensor: What the scans are projected through.
        encoding: Metres to model space.
        seed: Run seed; noise, times and order derive from it (`r2flow.noise`).
        name: `simulated`, `pairs`, or a layout of `r2flow.data.layouts.LAYOUTS`.
        root: Folder of the data set, or of the pairs.
        split: Part of the layout's standard split; None takes all.
        drives: Drives to take; None takes all.
        scenes: Number of simulated training scenes.
        projection: `spherical` or `unfolding`.
        convention: `centre` or `reference`.
        reflectance_scale: The value in the files that means full reflectance.
        on_bad_scan: `error` or `skip`.
        flip: Mirror every other training scan, left for right.
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
        flip: bool = False,
        batch_size: int = 8,
        workers: int = 0,
        memory_gib: float = 2.0,
        validation: Mapping[str, Any] | None = None,
        pairs: Mapping[str, Any] | None = None,
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
        self.batch_size, self.workers, self.memory_gib, self.flip = batch_size, workers, memory_gib, flip
        self.scenes = scenes
        self.validation = dict(validation or {})
        check_options("data.validation", _validation_options, self.validation)
        self.names: list[str] = []
        self.training_source: ScanSource | PairSource | None = None
        self.validation_source: ScanSource | PairSource | None = None
        self.pairs = self._pair_options(pairs or {}) if name == PAIRS else None

    def _pair_options(self, options: Mapping[str, Any]) -> PairOptions:
        check_options("data.pairs", PairOptions, options)
        if self.flip:
            raise InputError("data.flip mirrors scans; a mirrored pair is none of the flow's. Leave it out with pairs.")
        if self.validation.get("data") is not None:
            raise InputError("data.validation.data cannot be held out from pairs; leave it out.")
        if self.options["root"] is None:
            raise InputError("data=pairs needs the flow that draws them: stage.init=RUN.")
        return PairOptions(**options)

    @property
    def pair_store(self) -> PairStore:
        """The folder of the run's pairs, whatever it holds yet."""
        assert self.pairs is not None
        shape = self.encoding.shape
        return PairStore(str(self.options["root"]), self.pairs.recipe(shape))

    def setup(self, stage: str | None = None) -> None:
        if self.training_source is not None:
            return
        if self.pairs is not None:
            _ = self.pair_store  # other pairs in its folder are refused now; missing ones are made later
            return
        training, held = self.sources()
        self.training_source = self._kept(training, "training scans")
        self.validation_source = self._kept(held, "validation scans")

    def sources(self) -> tuple[ScanSource, ScanSource]:
        """The scans to train on and those held out, none of them read yet."""
        share, most, other = _validation_options(**self.validation)
        source = self._source(self.options)
        if other is not None:
            for key in other:
                if key not in self.options:
                    hint = did_you_mean(key, self.options)
                    known = ", ".join(self.options)
                    raise InputError(f"data.validation.data has no option {key!r}; it knows: {known}.{hint}")
            held = self._source({**self.options, "split": None, "drives": None, **other}, held_out=True)
        else:
            first, last = holdout_block(len(source), share)
            source, held = source.subset(first), source.subset(last)
        return source, held.subset(spread(len(held), most))

    def fingerprint(self) -> str:
        """What is trained on, wherever it lies: a run goes on only with the same scans in the same order."""
        if self.pairs is not None:
            return f"{self.pairs.num} pairs, {self.pair_store.recipe.digest}"
        assert self.training_source is not None
        names = hashlib.sha256("\n".join(self.names).encode()).hexdigest()[:12]
        return f"{len(self.training_source)} of {len(self.names)} scans, {names}"

    def _source(self, options: Mapping[str, Any], held_out: bool = False) -> ScanSource:
        reflectance = self.encoding.reflectance
        if options["name"] == SIMULATED:
            # Scenes that are held out beside simulated training ones come after them.
            first = self.scenes if held_out and self.options["name"] == SIMULATED else 0
            scenes = range(first, first + int(options["scenes"]))
            self.names = self.names if held_out else [f"scene {scene}" for scene in scenes]
            return SimulatedScans(self.sensor, self.seed, scenes, reflectance)
        if options["root"] is None:
            raise InputError(f"data={options['name']} needs the folder of its scans: data.root=FOLDER.")
        root = str(options["root"])
        drives = find_drives(options["name"], root, options["split"], options["drives"])
        paths = [path for drive in drives for path in drive.scans]
        if not held_out:
            self.names = [str(path.relative_to(Path(root).expanduser())) for path in paths]
        if options["projection"] == "unfolding" and self.sensor.name == "hdl64e":
            log.warning(
                "unfolded rows are the sensor's rings, which are not evenly spaced: sensor=hdl64e_rings has their "
                "elevations, sensor=hdl64e is up to 6 degrees off"
            )
        return ScanFiles(
            paths,
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
            len(self.training_source),
            self.batch_size // accumulated,
            self.trainer.max_steps * accumulated,
            self.seed,
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
        return FlowDataset(source, self.encoding, self.seed, purpose, self.flip and purpose == "training")

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
            "pin_memory": torch.cuda.is_available(),
        }


def _validation_options(
    share: float = 0.1, scans: int = 64, data: Mapping[str, Any] | None = None
) -> tuple[float, int, Mapping[str, Any] | None]:
    if not (isinstance(scans, int) and scans >= 0 and math.isfinite(share)):
        raise InputError(f"data.validation.scans must be a whole number, found {scans!r}.")
    return share, scans, data
