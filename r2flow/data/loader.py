"""Batches that a run can leave and come back to."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from r2flow import noise
from r2flow.data.augment import Augmentation
from r2flow.data.sources import ScanSource
from r2flow.lidar.encoding import Encoding

Item = dict[str, Tensor]
Further = Callable[[Tensor, np.random.Generator], Item]  # of x_1, (C, H, W), and draws of the image's own


class FlowDataset(Dataset[Item]):
    """Image k of a run as a training item.

    A batch has these keys; each depends on (seed, purpose, k) and on the scan alone:

    - x_1, (B, C, H, W): scans in model space, where t = 1;
    - x_0, (B, *noise_shape): standard normal noise, where t = 0;
    - u, (B,): uniform in [0, 1); the stage makes t of it;
    - k, (B,): number of the image in the run. A stage that needs more draws for an image derives them from
      (seed, purpose, k);
    - what `further` makes of the image: a stage's conditions. Those of validation are the same for every seed.
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
    ) -> None:
        self.source, self.encoding, self.seed, self.purpose = source, encoding, seed, purpose
        self.augment, self.noise_shape = augment, tuple(noise_shape or encoding.shape)
        self.further = further

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: tuple[int, int]) -> Item:
        k, index = key
        draw = noise.generator(self.seed, self.purpose, k)
        x_0 = torch.from_numpy(draw.standard_normal(self.noise_shape, dtype=np.float32))
        u = torch.tensor(draw.random(dtype=np.float32))
        image = self.source[index]
        if self.augment:
            image = self.augment(image, self.seed, k)
        x_1 = self.encoding.encode(torch.from_numpy(image))
        item = {"x_1": x_1, "x_0": x_0, "u": u, "k": torch.tensor(k)}
        if self.further is None:
            return item
        seed = self.seed if self.purpose == "training" else 0
        return item | self.further(x_1, noise.generator(seed, "condition", k))


class Order(Protocol):
    """Which scan is image k of a run, a function of k alone."""

    def __getitem__(self, k: int) -> int: ...


class Permutations:
    """Scan permutation_{k // n}[k mod n] of n: every scan once, in an order of its own, then every scan again.

    The permutations are counter-based, so that the order is known at every k without having drawn what came before.
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
    """The batches of one rank over a whole run, (k, scan) each, from batch `first_batch` on.

    Global batch m holds images [m B, (m + 1) B); rank r of R takes every R-th of them, from r on. The length is that of
    the run even if a resumed iterator starts late: Lightning adds the batches of a resumed run to what it fetches.
    """

    def __init__(self, order: Order, batch_size: int, batches: int, rank: int = 0, ranks: int = 1) -> None:
        self.order, self.batch_size, self.batches = order, batch_size, batches
        self.rank, self.ranks = rank, ranks
        self.first_batch = 0

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        for batch in range(self.first_batch, self.batches):
            start = batch * self.batch_size
            yield [(k, self.order[k]) for k in range(start + self.rank, start + self.batch_size, self.ranks)]


class RunLoader(DataLoader[Item]):
    """A loader whose one epoch is the whole run, by a `RunSampler`."""

    # Lightning takes a loader with these two for one that resumes. The position itself comes from the
    # trainer's step (ScanDataModule.train_dataloader), which also holds when the number of ranks changed.
    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


def fixed_batches(scans: int, batch_size: int, rank: int = 0, ranks: int = 1) -> list[list[tuple[int, int]]]:
    """Every `ranks`-th scan in order, the key of each its own number: the same items at every validation."""
    keys = [(scan, scan) for scan in range(rank, scans, ranks)]
    return [keys[i : i + batch_size] for i in range(0, len(keys), batch_size)]
