"""The DataModule of all stages."""

import hashlib
import logging
import os
from collections.abc import Sequence
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from r2flow.data.augment import Augmentation
from r2flow.data.loader import FlowDataset, Further, Item, MixedOrder, Mixture, Permutations, RunLoader, RunSampler
from r2flow.data.opening import open_source
from r2flow.data.options import PAIRS, SIMULATED, DataOptions, PairOptions, SourceOptions
from r2flow.data.pairs import PairDataset, PairStore
from r2flow.data.reading import Reading
from r2flow.data.resolving import resolve
from r2flow.data.sources import InMemory, ScanSource, holdout_block, spread
from r2flow.errors import InputError, check
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor, build_sensor
from r2flow.progress import track
from r2flow.registry import construct
from r2flow.signals import outlive_the_signal

log = logging.getLogger(__name__)


class ScanDataModule(L.LightningDataModule):
    """Projected scans with their noise, or pairs that a flow has drawn, for training and validation.

    `r2flow.data.loader.FlowDataset` describes a batch; `further`, a function of the run's stage, adds items to each of
    its scans. Noise, of `noise_shape` or the encoding's (C, H, W), times and order derive from the run's seed
    (`r2flow.noise`). `keys` are those of `r2flow.data.options.DataOptions`.
    """

    def __init__(
        self, sensor: Sensor, encoding: Encoding, seed: int, noise_shape: Sequence[int] | None = None, **keys: Any
    ) -> None:
        super().__init__()
        self.sensor, self.encoding, self.seed = sensor, encoding, seed
        self.noise_shape = tuple(noise_shape or encoding.shape)
        self.options = DataOptions(**resolve(keys, sensor.reflectance_scale))
        self.batch_size = self.options.batch_size
        self.parts = self.options.sets
        self.sensors = [sensor if part.sensor is None else build_sensor(**part.sensor) for part in self.parts]
        self.augment = construct("data.augment", Augmentation, self.options.augment)
        self.validation = self.options.validation_options
        self.further: Further | None = None
        self.names: list[str] = []
        self.opened: Sequence[Mixture] = ()  # as found, before they are read
        self.training_source: Mixture | np.ndarray | None = None  # scans, or the numbers of pairs
        self.validation_source: Mixture | np.ndarray | None = None
        self.scans: Mixture | None = None  # next to pairs
        self.pairs: PairOptions | None = None
        if self.options.name == PAIRS:
            self.pairs = construct("data.pairs", PairOptions, self.options.pairs)
            check(not self.augment, "data.augment changes scans, and an augmented pair is not a flow's; leave it out.")
            check(self.validation.data is None, "data.validation.data cannot be held out from pairs; leave it out.")

    @property
    def pair_store(self) -> PairStore:
        """The folder of the run's pairs, complete or not."""
        assert self.pairs is not None
        return PairStore(self.options.folder, self.pairs, self.encoding.shape, self.noise_shape)

    def setup(self, stage: str | None = None) -> None:
        """Open the scans; `read` reads them."""
        if self.pairs is None and self.training_source is None:
            self.training_source, self.validation_source = self.opened = self.sources()
            self._order(self.training_source)  # refuses wrong weights before anything is read or written
        elif self.options.scans is not None and self.scans is None:
            self.scans = Mixture([self._open(SourceOptions(**self.options.scans))])
            self.names, self.opened = list(self.scans.names), [self.scans]

    def read(self) -> None:
        """Read the scans into memory if they fit; a second call reads at most one of each set."""
        self.setup()
        if self.scans is not None:
            self.scans = self._kept(self.scans, "scans next to the pairs")
        if isinstance(self.training_source, Mixture) and isinstance(self.validation_source, Mixture):
            self.training_source = self._kept(self.training_source, "training scans")
            self.validation_source = self._kept(self.validation_source, "validation scans")

    def sources(self) -> tuple[Mixture, Mixture]:
        """The training and the validation scans, not yet read.

        Without `validation.data`, each part of a mixture holds out one block.
        """
        whole, first_scene = list[ScanSource](), 0  # parts and held-out scans have different simulated scenes
        for part, sensor in zip(self.parts, self.sensors, strict=True):
            whole.append(self._open(part, first_scene, sensor))
            first_scene += part.scenes if part.name == SIMULATED else 0
        # A prefix makes the names of the parts' scans distinct.
        labels = [f"{number}: " if len(whole) > 1 else "" for number in range(len(whole))]
        self.names = [f"{label}{name}" for label, source in zip(labels, whole, strict=True) for name in source.names]
        other = self.options.held_out
        if other is None:
            training, held = [], []
            for source in whole:
                starts = sorted(numbers[0] for numbers in source.drives.values() if len(numbers))
                first, last = holdout_block(len(source), self.validation.share, starts)
                training.append(source.subset(first))
                held.append(source.subset(last))
        else:
            training, held = whole, [self._open(other, first_scene)]
        if other is not None or len(whole) > 1:
            trained, validated = (set().union(*(source.places() for source in side)) for side in (training, held))
            if shared := trained & validated:
                log.warning(
                    "%s holds %d scans that are trained on, as %s: give each set its own split or drives",
                    "data.validation.data" if other else "a held-out block of data.parts",
                    len(shared), min(shared),
                )  # fmt: skip
        validation = Mixture(held)
        return Mixture(training), validation.subset(spread(len(validation), self.validation.scans))

    def _open(self, options: SourceOptions, first_scene: int = 0, sensor: Sensor | None = None) -> ScanSource:
        images = {"reflectance": self.encoding.reflectance, "within_limits": True}
        reading = Reading.of({**options.chosen, **images, "sensor": (sensor or self.sensor).described()})
        return open_source(options, reading, self.seed, first_scene)

    def _order(self, source: Mixture | np.ndarray) -> MixedOrder | Permutations:
        weights = [part.weight for part in self.parts if part.weight is not None]
        if isinstance(source, Mixture) and len(weights) > 1:
            return MixedOrder([len(part) for part in source.parts], weights, self.seed)
        return Permutations(len(source), self.seed)

    def fingerprint(self) -> str:
        """Identity of the data, independent of its path: a run resumes only with the same scans and order."""
        texts = [] if self.pairs is None else [f"{self.pairs.num} pairs, {self.pair_store.digest[:16]}"]
        if self.opened:
            known = [*self.names, *(source.contents for source in self.opened)]
            digest = hashlib.sha256(os.fsencode("\n".join(known))).hexdigest()[:12]
            texts.append(f"{len(self.opened[0])} of {len(self.names)} scans, {digest}")
        return "; ".join(texts)

    def _kept(self, source: Mixture, what: str) -> Mixture:
        """The source with its slow parts read into memory, if they fit into `memory_gib`."""
        parts = [*source.parts]
        firsts = {i: part[0] for i, part in enumerate(parts) if part.slow and len(part)}
        if sum(4 * len(parts[i]) * first.size for i, first in firsts.items()) > self.options.memory_gib * 2**30:
            return source
        for i, first in firsts.items():
            images = np.empty((len(parts[i]), *first.shape), np.float32)
            for number in track(range(len(images)), f"reading {what}", least=16):
                image = parts[i][number]
                if image.shape != first.shape:  # of one channel, it would fill both
                    raise InputError(f"{parts[i].names[number]}: an image of {first.shape}, found {image.shape}.")
                images[number] = image
            parts[i] = InMemory(images, parts[i].names)
        return Mixture(parts)

    def check_run(self, ranks: int, accumulated: int) -> None:
        """Refuse a run whose global batch cannot be divided among devices."""
        check(
            self.batch_size % (ranks * accumulated) == 0,
            f"data.batch_size={self.batch_size} cannot be shared by {ranks} devices times "
            f"{accumulated} accumulated batches; give a multiple of {ranks * accumulated}.",
        )

    def train_dataloader(self) -> RunLoader:
        """Batches from the trainer's current step to max_steps."""
        self._ready()
        assert self.training_source is not None
        trainer = self.trainer
        assert trainer is not None
        rank, ranks, accumulated = trainer.global_rank, trainer.world_size, trainer.accumulate_grad_batches
        self.check_run(ranks, accumulated)  # also for a Trainer that `build` did not make
        check(trainer.max_steps >= 1, "trainer.max_steps must be at least 1: it is the length of a run.")
        images = trainer.max_steps * self.batch_size
        sampler = RunSampler(self._order(self.training_source), self.batch_size // accumulated, images, rank, ranks)
        sampler.first_batch = trainer.global_step * accumulated
        dataset = self._dataset(self.training_source, "training")
        return RunLoader(dataset, batch_sampler=sampler, **self._loader_options())

    def _ready(self) -> None:
        """Read the scans, and open the pairs, which are made after `setup`."""
        self.read()
        if self.pairs is not None and self.training_source is None:
            pairs = self.pair_store.usable()
            first, last = holdout_block(len(pairs), self.validation.share)
            self.training_source = pairs[first]
            self.validation_source = pairs[last][spread(len(last), self.validation.scans)]

    def _dataset(self, source: Mixture | np.ndarray, purpose: str) -> Dataset[Item]:
        if not isinstance(source, Mixture):
            scans = None
            if self.scans is not None and purpose == "training":
                scans = FlowDataset(self.scans, self.encoding, self.seed, "beside", None, self.noise_shape)
            return PairDataset(self.pair_store, source, self.seed, purpose, scans)
        augment = self.augment if purpose == "training" else None
        sensors = self.sensors if purpose == "training" or self.options.held_out is None else [self.sensor]
        return FlowDataset(source, self.encoding, self.seed, purpose, augment, self.noise_shape, self.further, sensors)

    def val_dataloader(self) -> DataLoader[Item] | list[Any]:
        """The held-out scans, each once, without those that are left when the devices share them equally."""
        self._ready()
        assert self.validation_source is not None
        if len(self.validation_source) == 0:
            return []
        rank, ranks = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        scans, batch_size = len(self.validation_source), max(self.batch_size // ranks, 1)
        # All ranks need the same number of batches, or they would wait for each other: with fewer scans than ranks,
        # every rank takes all scans; otherwise the remainder is left out.
        if scans < ranks:
            rank, ranks = 0, 1
        batches = RunSampler(range(scans), batch_size * ranks, scans - scans % ranks, rank, ranks)
        dataset = self._dataset(self.validation_source, "validation")
        return DataLoader(dataset, batch_sampler=batches, **self._loader_options())

    def _loader_options(self) -> dict[str, Any]:
        return {
            "num_workers": self.options.workers,
            "persistent_workers": self.options.workers > 0,
            "worker_init_fn": outlive_the_signal,
            "pin_memory": torch.cuda.is_available(),
        }
