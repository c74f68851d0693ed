"""The images of a run as resumable batches, also of mixtures of data sets."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from r2flow import noise
from r2flow.data.augment import Augmentation
from r2flow.data.sources import ScanSource
from r2flow.errors import InputError, check
from r2flow.lidar.encoding import FAR, Encoding, wrong_with
from r2flow.lidar.sensors import Sensor

Item = dict[str, Tensor]
Further = Callable[[Tensor, Sensor, np.random.Generator], Item]  # of x_1, (C, H, W), its sensor, the image's draws


class FlowDataset(Dataset[Item]):
    """Image k of a run as a training item.

    A batch has these keys; each depends only on (seed, purpose, k) and the scan:

    - x_1, (B, C, H, W): scans in model space, where t = 1;
    - x_0, (B, *noise_shape): standard normal noise, where t = 0;
    - u, (B,): uniform in [0, 1); the stage maps it to t;
    - k, (B,): number of the image in the run; a stage derives further draws for an image from (seed, purpose, k);
    - the keys of `further`: a stage's conditions, the same for every seed in validation.

    A mixture has a sensor per part; images of several sizes need a `further` that crops them.
    """

    def __init__(
        self,
        source: ScanSource,
        encoding: Encoding,
        seed: int,
        purpose: str,
        augment: Augmentation | None = None,
        noise_shape: Sequence[int] | None = None,
        further: Further | None = None,
        sensors: Sequence[Sensor] | None = None,
    ) -> None:
        self.source, self.seed, self.purpose = source, seed, purpose
        self.encodings = [encoding.through(sensor) for sensor in sensors or [encoding.sensor]]
        self.augment, self.noise_shape = augment, tuple(noise_shape or encoding.shape)
        self.further = further

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: tuple[int, int]) -> Item:
        k, index = key
        draw = noise.generator(self.seed, self.purpose, k)
        x_0 = torch.from_numpy(draw.standard_normal(self.noise_shape, dtype=np.float32))
        u = torch.tensor(draw.random(dtype=np.float32))
        encoding = self.encodings[self.source.locate(index)[0]]
        image = self.source[index][: encoding.channels]
        if image.shape != encoding.shape:
            raise InputError(f"{self.source.names[index]}: an image of {encoding.shape}, found {image.shape}.")
        if wrong := wrong_with(torch.from_numpy(image), max(FAR, encoding.sensor.max_range)):
            raise InputError(f"{self.source.names[index]}: {wrong}.")
        if self.augment:
            image = self.augment(image, self.seed, k)
        x_1 = encoding.encode(torch.from_numpy(image))
        item = {"x_1": x_1, "x_0": x_0, "u": u, "k": torch.tensor(k)}
        if self.further is None:
            return item
        seed = self.seed if self.purpose == "training" else 0
        return item | self.further(x_1, encoding.sensor, noise.generator(seed, "condition", k))


class Permutations:
    """Scan permutation_{k // n}[k mod n] of n scans: every epoch has every scan once, in a new order.

    The permutations are counter-based: the order at k does not need the draws before k.
    """

    def __init__(self, scans: int, seed: int) -> None:
        self.scans, self.seed = scans, seed
        self.epoch, self.order = -1, np.empty(0, dtype=np.int64)

    def __getitem__(self, k: int) -> int:
        epoch, turn = divmod(k, self.scans)
        if epoch != self.epoch:
            self.order = noise.generator(self.seed, "shuffle", epoch).permutation(self.scans)
            self.epoch = epoch
        return int(self.order[turn])


class RunSampler(Sampler[list[tuple[int, int]]]):
    """The batches of one rank over a whole run, or a validation, as lists of (k, scan), from `first_batch` on.

    Global batch m holds images [m B, (m + 1) B); rank r of R takes images r, r + R, ... of it. The length is that of
    the whole run, even if it starts at a later batch: Lightning adds a resumed run's finished batches to its count.
    """

    def __init__(
        self, order: "Permutations | MixedOrder | range", batch_size: int, images: int, rank: int = 0, ranks: int = 1
    ) -> None:
        self.order, self.batch_size, self.images = order, batch_size, images
        self.rank, self.ranks = rank, ranks
        self.first_batch = 0

    def __len__(self) -> int:
        return -(-self.images // self.batch_size)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        for start in range(self.first_batch * self.batch_size, self.images, self.batch_size):
            end = min(start + self.batch_size, self.images)
            yield [(k, self.order[k]) for k in range(start + self.rank, end, self.ranks)]


class RunLoader(DataLoader[Item]):
    """A loader whose only epoch is the whole run, by a `RunSampler`."""

    # With these two methods, Lightning treats the loader as resumable. The position itself comes from the trainer's
    # step (ScanDataModule.train_dataloader), which also works with another number of ranks.
    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class Mixture(ScanSource):
    """Concatenated sources."""

    def __init__(self, parts: Sequence[ScanSource]) -> None:
        self.parts = list(parts)
        self.starts = np.cumsum([0, *(len(part) for part in parts)])

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
        chosen: list[list[int]] = [[] for _ in self.parts]
        for index in indices:
            part, number = self.locate(index)
            chosen[part].append(number)
        return Mixture([part.subset(numbers) for part, numbers in zip(self.parts, chosen, strict=True)])


class MixedOrder:
    """Maps image k of a run to a scan of a mixture, as a function of (seed, k).

    Part p has probability w_p / sum w; its scan is drawn uniformly, with replacement.
    """

    def __init__(self, sizes: Sequence[int], weights: Sequence[float], seed: int) -> None:
        check(all(sizes), f"data.parts: a part has no scan left to train on; the parts have {list(sizes)}.")
        self.seed, self.sizes = seed, sizes
        self.edges = np.cumsum(weights) / np.sum(weights)
        self.starts = np.cumsum([0, *sizes])

    def __getitem__(self, k: int) -> int:
        u, v = noise.generator(self.seed, "mixture", k).random(2)
        part = int(np.searchsorted(self.edges[:-1], u, side="right"))
        return int(self.starts[part]) + int(v * self.sizes[part])
