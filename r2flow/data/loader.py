"""The images of a run as resumable batches, also of mixtures of data sets."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset
from torch.utils.data.distributed import DistributedSampler

from r2flow.base import noise
from r2flow.base.errors import InputError
from r2flow.base.processes import rank_and_world_size
from r2flow.data.augment import Augmentation
from r2flow.data.sources import ScanSource
from r2flow.lidar.encoding import FAR, Encoding, wrong_with
from r2flow.lidar.sensors import Sensor

Item = dict[str, Tensor]
# of x_1, (C, H, W), its sensor, the image's draws
_Further = Callable[[Tensor, Sensor, np.random.Generator], Item]
# of an item: the number k of the image in the run, and that of the scan; or both in one
Key = int | tuple[int, int]


class ItemFormat(NamedTuple):
    """What a LightningModule takes as an item."""

    encoding: Encoding  # of the scans
    noise_shape: tuple[int, ...]  # of x_0
    further: _Further | None = None  # makes further entries for training and validation
    several_sensors: bool = False  # whether parts of a mixture may be scans of different sensors
    smallest: tuple[int, int] = (1, 1)  # rows and columns that `further` needs


@dataclass(eq=False)
class FlowDataset(Dataset[Item]):
    """Image k of a run as a training item.

    A batch has these keys; each depends only on (seed, purpose, k) and the scan:

    - x_1, (B, C, H, W): scans in model space, where t = 1;
    - x_0, (B, *noise_shape): standard normal noise, where t = 0;
    - u, (B,): uniform in [0, 1); the stage maps it to t;
    - k, (B,): number of the image in the run; a stage derives further draws for an image from
      (seed, purpose, k);
    - the keys of `further`: a stage's conditions, the same for every seed in validation.

    A mixture has a sensor per part; images of several sizes need a `further` that crops them.
    """

    source: ScanSource
    format: ItemFormat
    seed: int
    purpose: str
    augment: Augmentation | None = None
    sensors: Sequence[Sensor] = ()

    def __post_init__(self) -> None:
        encoding = self.format.encoding
        self.encodings = [encoding.through(sensor) for sensor in self.sensors] or [encoding]

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: Key) -> Item:
        k, index = (key, key) if isinstance(key, int) else key
        draw = noise.generator(self.seed, self.purpose, k)
        x_0 = torch.from_numpy(draw.standard_normal(self.format.noise_shape, dtype=np.float32))
        u = torch.tensor(draw.random(dtype=np.float32))
        encoding = self.encodings[self.source.locate(index)[0]]
        shape = (len(encoding.slices), *encoding.sensor.shape)
        image = self.source[index][: shape[0]]
        if image.shape == shape:
            far = max(FAR, encoding.sensor.max_range)
            wrong = wrong_with(torch.from_numpy(image), far)
        else:
            wrong = f"an image of {shape}, found {image.shape}"
        if wrong:
            raise InputError(f"{self.source.names[index]}: {wrong}.")
        if self.augment:
            image = self.augment(image, self.seed, k)
        x_1 = encoding.encode(torch.from_numpy(image))
        item = {"x_1": x_1, "x_0": x_0, "u": u, "k": torch.tensor(k)}
        if self.format.further is None:
            return item
        seed = self.seed if self.purpose == "training" else 0
        return item | self.format.further(
            x_1, encoding.sensor, noise.generator(seed, "condition", k)
        )


class Order(Protocol):
    """Maps the number k of an image of a run to the number of its scan."""

    def __getitem__(self, k: int, /) -> int: ...


class Permutations:
    """Scan permutation_{k // n}[k mod n] of n scans: every epoch has every scan once, in a new
    order.

    The permutations are counter-based: the order at k does not need the draws before k.
    """

    def __init__(self, scans: int, seed: int) -> None:
        self.scans = scans
        self.seed = seed
        self.epoch = -1
        self.order = np.empty(0, dtype=np.int64)

    def __getitem__(self, k: int) -> int:
        epoch, turn = divmod(k, self.scans)
        if epoch != self.epoch:
            self.order = noise.generator(self.seed, "shuffle", epoch).permutation(self.scans)
            self.epoch = epoch
        return int(self.order[turn])


@dataclass(eq=False)
class RunSampler(DistributedSampler[Key]):
    """The images of one rank in an epoch of a run as (k, scan), or scans held out by number.

    An epoch of n images is the range [first, first + n) of k, of which rank r of R takes first + r,
    first + r + R, ... So batches of b images on each rank are the global batches of b R images,
    whatever R is. Lightning leaves a `DistributedSampler` as it is.

    Args:
        order: Maps k to a scan; None: k is the number of the scan.
        images: Number n of images of an epoch, on all ranks.
        rank, ranks: 0 ranks: those of the process group that runs.
        place: Gives the next k of the run, and the number of images of this epoch before it, which
            a resumed run skips; None: the first k of the epoch that `set_epoch` names.
    """

    order: Order | None
    images: int
    rank: int = 0
    ranks: int = 0
    place: Callable[[], tuple[int, int]] | None = None
    epoch: int = 0  # as Lightning sets it by `set_epoch`; `place` does not depend on it

    def _share(self) -> tuple[int, int]:
        return (self.rank, self.ranks) if self.ranks else rank_and_world_size()

    def __len__(self) -> int:
        rank, ranks = self._share()
        return len(range(rank, self.images, ranks))

    def __iter__(self) -> Iterator[Key]:
        first, done = self.place() if self.place else (self.epoch * self.images, 0)
        rank, ranks = self._share()
        for k in range(first + rank, first + self.images - done, ranks):
            yield k if self.order is None else (k, self.order[k])


class Mixture(ScanSource):
    """Concatenated sources."""

    def __init__(self, parts: Sequence[ScanSource]) -> None:
        self.parts = list(parts)
        self.starts = np.cumsum([0, *map(len, parts)])

    @property
    def names(self) -> list[str]:
        return [name for part in self.parts for name in part.names]

    @property
    def contents(self) -> str:  # type: ignore[override]
        return "\n".join(part.contents for part in self.parts)

    def __len__(self) -> int:
        return int(self.starts[-1])

    def locate(self, index: int) -> tuple[int, int]:
        if not 0 <= index < len(self):
            raise IndexError(index)
        part = int(np.searchsorted(self.starts, index, side="right")) - 1
        return part, index - int(self.starts[part])

    def __getitem__(self, index: int) -> np.ndarray:
        part, number = self.locate(index)
        return self.parts[part][number]

    def subset(self, indices: Sequence[int]) -> "Mixture":
        """Some of the scans, by ascending numbers, as a mixture of the same parts."""
        of_parts: list[list[int]] = [[] for _ in self.parts]
        for index in indices:
            part, number = self.locate(index)
            of_parts[part].append(number)
        subsets = zip(self.parts, of_parts, strict=True)
        return Mixture([part.subset(numbers) for part, numbers in subsets])


class MixedOrder:
    """Maps image k of a run to a scan of a mixture, as a function of (seed, k).

    Part p has probability w_p / sum w; its scan is drawn uniformly, with replacement.
    """

    def __init__(self, sizes: Sequence[int], weights: Sequence[float], seed: int) -> None:
        if not all(sizes):
            raise InputError(
                f"data.parts: a part has no scan left to train on; the parts have {list(sizes)}."
            )
        self.seed = seed
        self.sizes = sizes
        self.edges = np.cumsum(weights) / np.sum(weights)
        self.starts = np.cumsum([0, *sizes])

    def __getitem__(self, k: int) -> int:
        u, v = noise.generator(self.seed, "mixture", k).random(2)
        part = int(np.searchsorted(self.edges[:-1], u, side="right"))
        return int(self.starts[part]) + int(v * self.sizes[part])
