"""Sets of scans to measure: sampled from a generator on access; real references; baselines."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy import ndarray
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.noise import generator, standard_normal
from r2flow.data.sets import ScanSet
from r2flow.data.sources import MadeScans
from r2flow.generators import Sampler
from r2flow.generators.base import Precision
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.model.checkpoint import Checkpoint
from r2flow.model.paths import FOLDER, checkpoints_of
from r2flow.model.sampling import draw
from r2flow.model.saving import weights_hash
from r2flow.model.shipped import MODELS

AGAIN = 100  # largest half of the real scans for which a model is sampled again
HALVES = "real halves"  # name of a reference
AS_MANY = ", as many"  # suffix of a judged set's name


def is_checkpoint(text: str) -> bool:
    """Whether a text names a generator to sample: a checkpoint file, a run folder, the folder of
    its checkpoints, or a model.
    """
    path = Path(text).expanduser()
    if path.is_dir():
        return bool(checkpoints_of(path.parent if path.name == FOLDER else path))
    if path.suffix in (".ckpt", ".pth", ".safetensors"):
        return True
    return text in MODELS and not path.exists()


def sampled_set(
    flow: Checkpoint,
    label: str,
    num: int,
    sampler: Sampler | None = None,
    seed: int = 0,
    precision: Precision = "32-true",
) -> ScanSet:
    """Set of scans 0 to num - 1 of a generator and seed, sampled on access.

    Their noise (seed, "evaluation", i) is disjoint from the noise of training and reflow pairs.
    """
    sampler = sampler or flow.generator.sampler
    sampler.check(flow.generator)
    return ScanSet(label, SampledScans(flow, range(num), sampler, seed, precision), flow.sensor)


@dataclass(eq=False)
class SampledScans(MadeScans):
    """Scans of a generator; each depends only on (seed, number)."""

    flow: Checkpoint
    numbers: Sequence[int]
    sampler: Sampler
    seed: int
    precision: Precision
    unsolved: int = field(default=0, init=False)  #: samples so far that missed the tolerance
    evaluations: list[int] = field(default_factory=list, init=False)  #: per scan
    seconds: list[float] = field(default_factory=list, init=False)  #: per scan, for each batch

    drawn = True
    word = "sample"

    def about(self) -> dict[str, Any]:
        return {
            "kind": "sampled",
            "weights": weights_hash(self.flow),
            "step": self.flow.step,
            "num": len(self),
            "sampler": self.sampler.asdict(),
            "precision": self.precision,
            "seed": self.seed,
            "noise": "evaluation",
            "reflectance": self.flow.encoding.reflectance,
        }

    def __getitem__(self, index: int) -> ndarray:
        return self.batch([index])[0].numpy()

    def subset(self, indices: Sequence[int]) -> Self:
        return replace(self, numbers=[self.numbers[i] for i in indices])

    def batch(self, indices: Sequence[int]) -> Tensor:
        """Sample a batch, (B, 2 or 1, H, W), without labels; unconverged samples are included and
        counted.
        """
        numbers = [self.numbers[i] for i in indices]
        batch = draw(
            self.flow.generator, numbers, self.seed, self.sampler, precision=self.precision
        )
        self.seconds.append(batch.seconds / len(indices))
        self.evaluations += batch.evaluations.tolist()
        self.unsolved += int((~batch.converged).sum())
        return batch.images[:, :2].nan_to_num(0.0)


def reference_sets(
    real: ScanSet, generated: Mapping[str, ScanSet] | None = None
) -> dict[str, tuple[ScanSet, ScanSet]]:
    """Pairs of real sets, as lower references for a generator's distance.

    They are two halves, and two drives if any. Halves are contiguous blocks: neighbouring scans of
    a drive are near-duplicates, and random halves would share places. The two drives are the
    largest. Distances decrease with the number of scans; generated scans are therefore also
    compared with the first half, limited to the size of the second half. Models are sampled again
    for that, if the half has at most `AGAIN` scans.
    """
    count = len(real)
    if count < 2:
        raise InputError(f"{real.label} has {count} scan; --reference needs at least two.")
    half = real.part(range(count // 2), "first half")
    other = real.part(range(count // 2, count), "second half")
    pairs = {HALVES: (half, other)}
    for name, scans in (generated or {}).items():
        if len(scans) >= len(other) and (len(other) <= AGAIN or not scans.source.drawn):
            pairs[f"{name}{AS_MANY}"] = half, scans.limited(len(other))
    largest = sorted(real.drives, key=lambda drive: -len(real.drives[drive]))[:2]
    if len(largest) == 2:
        a, b = (real.part(real.drives[drive], f"drive {drive}") for drive in sorted(largest))
        pairs["real drives"] = a, b
    return pairs


@dataclass(eq=False)
class _Baseline(MadeScans):
    """Scans (2 or 1, H, W) of the baseline `word` of `BASELINES`."""

    word: str
    training: ndarray  #: real scans, (N, 2 or 1, H, W)
    sensor: Sensor
    numbers: Sequence[int]

    def __getitem__(self, index: int) -> ndarray:
        return BASELINES[self.word](self, self.numbers[index])

    def about(self) -> dict[str, object]:
        return {"kind": "baseline", "seed": 0, "reflectance": self.training.shape[1] > 1}

    def noise(self, number: int) -> ndarray:
        """Decoded x_0 ~ N(0, I)."""
        shape = self.training.shape[1:]
        encoding = Encoding(self.sensor, reflectance=shape[0] > 1)
        return encoding.decode(standard_normal(shape, 0, "evaluation", number)).numpy()

    def _flat_ground(self, number: int) -> ndarray:
        """r = -height / sin e within the sensor's range limits."""
        sensor = self.sensor
        e = sensor.rays()[0].numpy().astype(np.float64)
        r = np.where(e < 0, -sensor.height / np.sin(np.minimum(e, -1e-6)), 0)
        r = np.where((r >= sensor.min_range) & (r <= sensor.max_range), r, 0)
        return np.stack([r, 0.3 * (r > 0)])[: self.training.shape[1]].astype(np.float32)

    @cached_property
    def _mean_scan(self) -> ndarray:
        """Mean of the training scans, at pixels where more than half of them return."""
        returned = self.training[:, 0] > 0
        mean = self.training.sum(0) / np.maximum(returned.sum(0), 1)
        return np.where(returned.mean(0) > 0.5, mean, 0).astype(np.float32)

    def _shuffled_pixels(self, number: int) -> ndarray:
        """Each pixel from a random training scan."""
        rows, columns = np.indices(self.sensor.shape)
        draws = generator(0, "shuffle", number)
        scan = draws.integers(len(self.training), size=self.sensor.shape)
        return np.moveaxis(self.training[scan, :, rows, columns], -1, 0)


BASELINES = {
    "noise": _Baseline.noise,
    "flat ground": _Baseline._flat_ground,
    "mean scan": lambda baseline, number: baseline._mean_scan,
    "shuffled pixels": _Baseline._shuffled_pixels,
}


def baseline_sets(real: ScanSet, num: int) -> dict[str, ScanSet]:
    """Each baseline as a set of `num` scans, computed from 200 evenly spaced real scans."""
    training = real.spread(200)[:].numpy()
    sets = {}
    for name in BASELINES:
        sets[name] = ScanSet(name, _Baseline(name, training, real.sensor, range(num)), real.sensor)
    return sets
