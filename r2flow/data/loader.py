"""Batches that a run can leave and come back to."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from r2flow import noise
from r2flow.data.sources import ScanSource
from r2flow.lidar.encoding import Encoding

Item = dict[str, Tensor]


class FlowDataset(Dataset[Item]):
    """Image k of a run as a training item: {x_1, x_0, u, k}.

    x_1 (C, H, W) is the encoded scan, x_0 (C, H, W) its noise and u () the uniform draw that becomes t;
    noise and u depend on (seed, purpose, k) alone.

    Args:
        flip: Mirror every other scan, left for right: azimuth -> -azimuth, columns reversed, exact because bins
            lie symmetrically about straight ahead. Which ones depends on k alone.
    """

    def __init__(self, source: ScanSource, encoding: Encoding, seed: int, purpose: str, flip: bool = False) -> None:
        self.source, self.encoding, self.seed, self.purpose = source, encoding, seed, purpose
        self.flip = flip

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: tuple[int, int]) -> Item:
        k, index = key
        shape = self.encoding.shape
        draw = noise.generator(self.seed, self.purpose, k)
        x_0 = torch.from_numpy(draw.standard_normal(shape, dtype=np.float32))
        u = torch.tensor(draw.random(dtype=np.float32))
        image = self.source[index]
        if self.flip and draw.random() < 0.5:
            image = image[..., ::-1].copy()
        x_1 = self.encoding.encode(torch.from_numpy(image))
        return {"x_1": x_1, "x_0": x_0, "u": u, "k": torch.tensor(k)}


class RunSampler(Sampler[list[tuple[int, int]]]):
    """The batches of one rank over a whole run, from image `first` on.

    Image k of the run is scan permutation_{k // n}[k mod n] of n; the permutations are counter-based, so
    the order is known at every k without having drawn what came before. Global batch m holds images
    [m B, (m + 1) B); rank r of R takes every R-th of them, from r on.
    """

    def __init__(self, scans: int, batch_size: int, batches: int, seed: int, rank: int = 0, ranks: int = 1) -> None:
        self.scans, self.batch_size, self.batches = scans, batch_size, batches
        self.seed, self.rank, self.ranks = seed, rank, ranks
        self.first_batch = 0

    def __len__(self) -> int:
        return self.batches

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        epoch, order = -1, np.empty(0, dtype=np.int64)
        for batch in range(self.first_batch, self.batches):
            keys = []
            start = batch * self.batch_size
            for k in range(start + self.rank, start + self.batch_size, self.ranks):
                if k // self.scans != epoch:
                    epoch = k // self.scans
                    order = noise.generator(self.seed, "shuffle", epoch).permutation(self.scans)
                keys.append((k, int(order[k % self.scans])))
            yield keys


class RunLoader(DataLoader[Item]):
    """A loader whose one epoch is the whole run.

    Its length stays that of the run although a resumed iterator starts late: Lightning adds the batches
    of a resumed run to what it fetches, and a shortened length would shift everything after it.
    """

    def __init__(self, dataset: Dataset[Item], sampler: RunSampler, **options: Any) -> None:
        super().__init__(dataset, batch_sampler=sampler, **options)
        self.run_sampler = sampler

    def __len__(self) -> int:
        return self.run_sampler.batches

    # Lightning takes a loader with these two for one that resumes. The position itself comes from the
    # trainer's step (ScanDataModule.train_dataloader), which also holds when the number of ranks changed.
    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


class FixedSampler(Sampler[list[tuple[int, int]]]):
    """Every `ranks`-th scan in order, the key of each its own number: the same items at every validation."""

    def __init__(self, scans: int, batch_size: int, rank: int = 0, ranks: int = 1) -> None:
        mine: Sequence[int] = range(rank, scans, ranks)
        self.chunks = [list(mine[i : i + batch_size]) for i in range(0, len(mine), batch_size)]

    def __len__(self) -> int:
        return len(self.chunks)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        return ([(i, i) for i in chunk] for chunk in self.chunks)
