"""Mixtures of data sets: their concatenated scans, and the random choice of a scan for each image."""

from collections.abc import Sequence

import numpy as np

from r2flow import noise
from r2flow.data.sources import ScanSource
from r2flow.errors import check


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
        """The part of a scan, and its number in that part."""
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
