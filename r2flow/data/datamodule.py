"""The DataModule of all stages."""

import hashlib
import logging
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Dataset

from r2flow.base.arguments import NamedArguments
from r2flow.base.errors import InputError
from r2flow.base.registry import Count, Natural, NonNegative, Options, Seed, construct
from r2flow.base.signals import init_loader_worker
from r2flow.data.augment import Augmentation
from r2flow.data.kinds import SOURCES
from r2flow.data.loader import (
    FlowDataset,
    Item,
    ItemFormat,
    Mixture,
    Order,
    RunSampler,
)
from r2flow.data.options import (
    MIXED,
    PAIRS,
    SIMULATED,
    DataOptions,
    PairOptions,
    ParentRecord,
    ReadingOptions,
    ValidationOptions,
)
from r2flow.data.own import DATASET
from r2flow.data.pairs import PairDataset, PairStore
from r2flow.data.reading import AUTO
from r2flow.data.resolving import lacking_reflectance, plan_data, reflectance_levels
from r2flow.data.run_scans import Scans, in_memory, open_for_training, open_plan, order_of
from r2flow.data.sources import holdout_block, spread
from r2flow.lidar.encoding import Encoding, encoding_options
from r2flow.lidar.sensors import Sensor, build_sensor, sensor_options

_log = logging.getLogger(__name__)

_HeldOut = DataLoader[Item] | list[Any]  # an empty list: there are none


class ScanDataModule(L.LightningDataModule, NamedArguments):
    """Projected scans with their noise, or pairs that a flow has drawn, for training and
    validation.

    `r2flow.data.loader.FlowDataset` describes a batch. An epoch is a pass over the training scans,
    without those left over when they are shared in batches; test and prediction use the held-out
    scans. In a Trainer, scans have the encoding of the module's `item_format`, if it has one.
    Noise, times and order derive from the seed (`r2flow.base.noise`).

        data = ScanDataModule("kitti_raw", root="KITTI", sensor="hdl64e_small", batch_size=8)

    Args:
        name: Kind of scans, a name in `r2flow.data.kinds.SOURCES`, `mixed` or `pairs`; or a
            map-style `Dataset` of scans (`r2flow.data.own.DatasetScans`).
        sensor: Sensor of the images, its name, YAML file or options.
        encoding: Encoding of the images, a name in conf/encoding, or options; `reflectance: auto`
            looks at the scans.
        seed: Seed of noise, times and order.
        root: Folder of the scans; of `pairs` that of the pairs.
        split: Part of the data set's standard split; None: all.
        drives: Names or numbers of drives; None: all.
        scenes: Number of simulated scenes.
        reading: How scan files become images, `r2flow.data.options.ReadingOptions`; None: as the
            data set's kind does.
        parts: Sets of scans of `mixed`, each with the keys of `r2flow.data.options.PartOptions`.
        augment: Changes of training scans, `r2flow.data.augment.Augmentation`; None: none.
        batch_size: Images of an optimiser step, over all devices and accumulated parts.
        workers: Processes that read scans, for each device.
        memory_gib: Training scans up to this size are kept in memory.
        validation: Scans to hold out, `r2flow.data.options.ValidationOptions`.
        pairs: Pairs to draw, `r2flow.data.options.PairOptions`.
        scans: Scans next to pairs, `r2flow.data.options.SourceOptions`, for a flow map; None: none.

    Raises:
        InputError: an unknown name or option.
    """

    def __init__(
        self,
        name: str | Dataset[Any] = SIMULATED,
        sensor: Sensor | str | Mapping[str, Any] = "hdl64e",
        encoding: Encoding | str | Mapping[str, Any] = "logscale",
        seed: Seed = 0,
        *,
        root: str | int | None = None,
        split: str | None = None,
        drives: Sequence[str | int] | None = None,
        scenes: Count = 512,
        reading: ReadingOptions | Options | None = None,
        parts: Sequence[Options] | None = None,
        augment: Options | None = None,
        batch_size: Count = 4,
        workers: Natural = 0,
        memory_gib: NonNegative = 2.0,
        validation: ValidationOptions | Options | None = None,
        pairs: PairOptions | Options | None = None,
        scans: Options | None = None,
    ) -> None:
        arguments = dict(locals())
        super().__init__()
        dataset = None
        if not isinstance(name, str):
            dataset = name
            arguments["name"] = DATASET
        elif name not in (MIXED, PAIRS, *SOURCES) and Path(name).expanduser().is_dir():
            raise InputError(f"{name} is a folder: give 'folder', or its kind, and root={name!r}.")
        options = {one.name: arguments[one.name] for one in fields(DataOptions)}
        options = {key: value for key, value in options.items() if value is not None}
        self.options = construct("data", DataOptions, options)
        self.seed = seed
        self.batch_size = self.options.batch_size
        self._sensor_options = sensor_options(sensor)
        self._encoding_options = encoding_options(encoding)
        self.sensor = build_sensor(**self._sensor_options)
        self.plan = plan_data(self.options, self.sensor, seed)
        for scans_of_plan in self.plan.sets:
            scans_of_plan.dataset = dataset
        self.augment = construct("data.augment", Augmentation, self.options.augment)
        if self.pairs and self.augment:
            raise InputError(
                "data.augment changes scans, and an augmented pair is not a flow's; leave it out."
            )
        # of fewer scans to predict than devices
        self.allow_zero_length_dataloader_with_multiple_devices = True
        self.item_format: ItemFormat | None = None
        self.names: list[str] = []
        self.opened: Sequence[Mixture] = ()  # as found, before they are read
        self.training_source: Scans | None = None
        self.validation_source: Scans | None = None
        self.scans: Mixture | None = None  # next to pairs
        # the module logs those that they share
        self.save_hyperparameters(self.described(), logger=False)

    def described(self) -> dict[str, Any]:
        """The arguments of this DataModule, complete, as plain values."""
        plain = asdict(self.options)
        if self.options.parts is not None:
            plain["parts"] = [asdict(part.options) for part in self.plan.sets]
        elif self.plan.sets:
            plain["reading"] = asdict(self.plan.sets[0].options)["reading"]
        if self.plan.held_out is not None:
            plain["validation"]["data"] = asdict(self.plan.held_out.options)
        if self.plan.scans is not None:
            plain["scans"] = asdict(self.plan.scans.options)
        encoding = self._encoding_options
        return {**plain, "sensor": self._sensor_options, "encoding": encoding, "seed": self.seed}

    @cached_property
    def encoding(self) -> Encoding:
        """Encoding of the images; looks at the scans for whether they have reflectance, and its
        levels.
        """
        options = dict(self._encoding_options)
        if options["reflectance"] == AUTO:
            held_out = [self.plan.held_out] if self.plan.held_out else []
            lacking = lacking_reflectance([*self.plan.sets, *held_out])
            if lacking:
                _log.info("range alone is learned (encoding.reflectance=auto): %s", lacking)
            options["reflectance"] = lacking is None
        if options["levels"] is None and self.plan.sets:
            options["levels"] = reflectance_levels(self.plan.sets)
        return construct("encoding", Encoding, options, self.sensor)

    @property
    def pairs(self) -> PairOptions | None:
        """The pairs to learn from; None: scans."""
        return self.options.pairs if self.options.name == PAIRS else None

    @property
    def format(self) -> ItemFormat:
        """What items are: the module's `item_format`, else this DataModule's encoding and noise of
        its shape.
        """
        return self.item_format or ItemFormat(self.encoding, self.encoding.shape)

    def drawn_by(self, parent: ParentRecord) -> None:
        """Complete the identity of the pairs by the record of the flow that draws them
        (`Parent.record`).
        """
        assert self.pairs is not None
        first = parent.first_pair if self.pairs.first is None else self.pairs.first
        pairs = replace(self.pairs, parent=parent.weights, first=first)
        root = self.options.root or parent.pairs
        self.options = replace(self.options, root=root, pairs=pairs)
        self.save_hyperparameters(self.described(), logger=False)

    @property
    def pair_store(self) -> PairStore:
        """The folder of the run's pairs, complete or not."""
        assert self.pairs is not None
        return PairStore(
            self.options.folder, self.pairs, self.format.encoding.shape, self.format.noise_shape
        )

    def setup(self, stage: str | None = None) -> None:
        """Open the scans; `read` reads them."""
        module = getattr(self.trainer, "lightning_module", None)
        wanted = getattr(module, "item_format", None)
        if isinstance(wanted, ItemFormat):
            self.adopt(wanted)
        encoding = self.format.encoding
        if self.opened:
            return
        if self.pairs is None:
            training, held_out, self.names = open_plan(self.plan, encoding, self.options.validation)
            self.opened = training, held_out
            self.training_source, self.validation_source = self.opened
            self._order(training)  # refuses wrong weights before anything is read or written
        elif self.plan.scans is not None:
            self.scans = Mixture([open_for_training(self.plan.scans, encoding)])
            self.names = list(self.scans.names)
            self.opened = [self.scans]

    def adopt(self, wanted: ItemFormat) -> None:
        """Make the items that a module takes; refuses scans that it cannot learn from."""
        sensor = wanted.encoding.sensor
        if self.pairs is None and not sensor.same_image(self.sensor):
            raise InputError(
                f"the module's images are of {sensor}, the data's of {self.sensor}: give both the "
                "same sensor."
            )
        several = any(sensor != self.sensor for sensor in self.plan.sensors)
        if several and not wanted.several_sensors:
            raise InputError(
                "this stage learns from scans of one sensor: leave sensor out of data.parts."
            )
        rows, columns = wanted.smallest
        for number, one in enumerate(self.plan.sensors):
            if several and (one.shape[0] < rows or one.shape[1] < columns):
                raise InputError(
                    f"data.parts[{number}]: crops of {rows}x{columns} need images as large, found "
                    f"{one.shape}."
                )
        self.item_format = wanted

    def read(self) -> None:
        """Read the scans into memory if they fit; a second call reads at most one of each set."""
        self.setup()
        most = self.options.memory_gib
        if self.scans is not None:
            self.scans = in_memory(self.scans, "scans next to the pairs", most)
        if isinstance(self.training_source, Mixture):
            self.training_source = in_memory(self.training_source, "training scans", most)
        if isinstance(self.validation_source, Mixture):
            self.validation_source = in_memory(self.validation_source, "validation scans", most)

    def _order(self, source: Scans) -> Order:
        return order_of(source, self.plan.weights, self.seed)

    def fingerprint(self) -> str:
        """Identity of the data, independent of its path: a run resumes only with the same scans and
        order.
        """
        texts = []
        if self.pairs is not None:
            texts.append(f"{self.pairs.num} pairs, {self.pair_store.digest[:16]}")
        if self.opened:
            known = [*self.names, *(source.contents for source in self.opened)]
            digest = hashlib.sha256(os.fsencode("\n".join(known))).hexdigest()[:12]
            texts.append(f"{len(self.opened[0])} of {len(self.names)} scans, {digest}")
        return "; ".join(texts)

    def summary(self) -> str:
        """What is trained on, as '117 folder scans and 1800 simulated scans, 213 held out'."""
        if self.pairs is not None:
            return f"{self.pairs.num} pairs: noise, and the scan that stage.parent draws from it"
        assert isinstance(self.training_source, Mixture)
        counts = [
            f"{len(part)} {named.options.name} scans"
            for named, part in zip(self.plan.sets, self.training_source.parts, strict=True)
        ]
        held = len(self.names) - len(self.training_source)
        return f"{' and '.join(counts)}, {held} held out"

    @property
    def ranks(self) -> tuple[int, int]:
        """Rank of this process and number of processes."""
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)

    @property
    def _fitting(self) -> bool:
        """Whether a fit runs, whose place the training scans go on from."""
        state = self.trainer and self.trainer.state
        return bool(state and state.fn == "fit" and state.status == "running")

    def train_dataloader(self) -> DataLoader[Item]:
        """The batches of an epoch: in a fit from the trainer's step on, else of the first one.

        Raises:
            InputError: the batch cannot be shared by the devices and accumulated parts.
        """
        source, _ = self._ready()
        images = max(len(source) // self.batch_size, 1) * self.batch_size
        order = self._order(source)
        dataset = self._dataset(source, "training")
        if not self._fitting:  # a loader by itself, whatever runs it later
            return self._loader(dataset, RunSampler(order, images), self.batch_size)
        sampler = RunSampler(order, images, *self.ranks, self._place)
        assert self.trainer is not None
        return self._loader(dataset, sampler, self.share(self.trainer))

    def share(self, trainer: L.Trainer) -> int:
        """Images of a batch on each device, of each accumulated part.

        Raises:
            InputError: the batch cannot be shared by the devices and accumulated parts.
        """
        ranks = trainer.world_size
        parts = trainer.accumulate_grad_batches
        if self.batch_size % (ranks * parts):
            raise InputError(
                f"data.batch_size={self.batch_size} cannot be shared by {ranks} devices times "
                f"{parts} accumulated batches; give a multiple of {ranks * parts}."
            )
        return self.batch_size // (ranks * parts)

    def _place(self) -> tuple[int, int]:
        """The next k of the run, and the number of images of this epoch before it."""
        assert self.trainer is not None
        batch = self.batch_size // self.trainer.accumulate_grad_batches
        done = self.trainer.fit_loop.epoch_loop.batch_progress.current.ready
        return self.trainer.global_step * self.batch_size, done * batch

    def _ready(self) -> tuple[Scans, Scans]:
        """Read the scans, and open the pairs, which are made after `setup`."""
        self.read()
        if self.pairs is not None and self.training_source is None:
            pairs = self.pair_store.usable()
            first, last = holdout_block(len(pairs), self.options.validation.share)
            self.training_source = pairs[first]
            self.validation_source = pairs[last][spread(len(last), self.options.validation.scans)]
        assert self.training_source is not None
        assert self.validation_source is not None
        return self.training_source, self.validation_source

    def _dataset(self, source: Scans, purpose: str, whole: bool = False) -> Dataset[Item]:
        item_format = self.format._replace(further=None) if whole else self.format
        if not isinstance(source, Mixture):
            scans = None
            if self.scans is not None and purpose == "training":
                scans = FlowDataset(self.scans, item_format, self.seed, "beside")
            return PairDataset(self.pair_store, source, self.seed, purpose, scans)
        augment = self.augment if purpose == "training" else None
        whole_sets = purpose == "training" or self.plan.held_out is None
        sensors = self.plan.sensors if whole_sets else []
        return FlowDataset(source, item_format, self.seed, purpose, augment, sensors)

    def val_dataloader(self) -> _HeldOut:
        """The held-out scans, each once over all devices."""
        return self._held_out()

    def test_dataloader(self) -> _HeldOut:
        """The held-out scans, each once over all devices, to compare generated scans with."""
        return self._held_out(whole=True)

    def predict_dataloader(self) -> _HeldOut:
        """The held-out scans, each once over all devices, some of which may have none."""
        return self._held_out(whole=True, idle=True)

    @property
    def shares_held_out(self) -> bool:
        """Whether devices share the held-out scans; of fewer scans than devices each takes all."""
        _, source = self._ready()
        return len(source) >= self.ranks[1]

    def _held_out(self, whole: bool = False, idle: bool = False) -> _HeldOut:
        """Batches of the held-out scans; `whole`: without the stage's further entries; `idle`:
        devices may have none.
        """
        _, source = self._ready()
        if len(source) == 0:
            return []
        rank, ranks = self.ranks if self.shares_held_out or idle else (0, 1)
        batch_size = max(self.batch_size // ranks, 1)
        least, more = divmod(len(source), ranks)
        if least and more and least % batch_size == 0:
            # Devices with a scan more would have a batch more, and wait for the others.
            sizes = [size for size in range(2, least + 2) if least % size]
            batch_size = min(sizes, key=lambda size: abs(size - batch_size))
        sampler = RunSampler(None, len(source), rank, ranks, lambda: (0, 0))
        return self._loader(self._dataset(source, "validation", whole), sampler, batch_size)

    def _loader(
        self, dataset: Dataset[Item], sampler: RunSampler, batch_size: int
    ) -> DataLoader[Item]:
        return DataLoader(
            dataset,
            batch_size=batch_size,
            sampler=sampler,
            num_workers=self.options.workers,
            persistent_workers=self.options.workers > 0,
            worker_init_fn=init_loader_worker,
            pin_memory=torch.cuda.is_available(),
        )
