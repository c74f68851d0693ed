"""Several data sets in one run: their scans end to end, and whose turn it is at each image."""

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from r2flow import noise
from r2flow.data.loader import Permutations
from r2flow.data.sources import ScanSource
from r2flow.errors import InputError
from r2flow.lidar.encoding import Encoding

BLOCK = 1 << 16  # images whose parts are drawn at once


class Mixture(ScanSource):
    """Sources end to end, numbered through."""

    def __init__(self, parts: Sequence[ScanSource]) -> None:
        self.parts = list(parts)
        self.starts = np.cumsum([0, *(len(part) for part in parts)])

    @property
    def measured(self) -> bool:  # type: ignore[override]
        return all(part.measured for part in self.parts)

    @property
    def names(self) -> list[str]:
        return [name for part in self.parts for name in part.names]

    def __len__(self) -> int:
        return int(self.starts[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """(part, number in it) of a scan."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        part = int(np.searchsorted(self.starts, index, side="right")) - 1
        return part, index - int(self.starts[part])

    def __getitem__(self, index: int) -> np.ndarray:
        part, number = self.locate(index)
        return self.parts[part][number]

    def with_points(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        part, number = self.locate(index)
        return self.parts[part].with_points(number)

    def encoded(self, index: int, encoding: Encoding) -> Tensor:
        part, number = self.locate(index)
        return self.parts[part].encoded(number, encoding)

    def subset(self, indices: Sequence[int]) -> "Mixture":
        """Some of the scans, named in ascending order, as a mixture of the same parts."""
        chosen: list[list[int]] = [[] for _ in self.parts]
        for index in indices:
            part, number = self.locate(index)
            chosen[part].append(number)
        return Mixture([part.subset(own) for part, own in zip(self.parts, chosen, strict=True)])


def refuse_shared_scans(parts: Sequence[ScanSource]) -> None:
    """Refuse parts that share scans: each holds out a block of its own, which the other would train on."""
    before: set[str] = set()
    for number, part in enumerate(parts):
        own = part.places()
        if shared := own & before:
            raise InputError(
                f"data.parts[{number}] has {len(shared)} scans that a part before it has too, as {min(shared)}: they "
                "would count twice, and what one part holds out the other would train on. Name each drive, or seed of "
                "simulated scenes, in one part."
            )
        before |= own


class MixedOrder:
    """Which scan of a mixture is image k of a run: a part drawn by its weight, then that part's next scan.

    Parts are drawn independently with probabilities w_p / sum w; the j-th image of a part is its scan
    permutation_{j // n}[j mod n] of n (`Permutations`). All of it is a function of (seed, k): draws come in blocks by
    their number, and how often a part was drawn before a block is counted from the blocks before it.

    Raises:
        InputError: a weight that is not positive, or a part without scans.
    """

    def __init__(self, sizes: Sequence[int], weights: Sequence[float], seed: int) -> None:
        if not all(0 < weight < np.inf for weight in weights):
            raise InputError(f"data.parts: each weight must be a positive number, found {list(weights)}.")
        if not all(sizes):
            raise InputError(f"data.parts: a part has no scan left to train on; the parts have {list(sizes)}.")
        self.seed = seed
        self.edges = np.cumsum(weights) / np.sum(weights)
        self.orders = [Permutations(size, seed, part) for part, size in enumerate(sizes)]
        self.starts = np.cumsum([0, *sizes])
        self._counts = [np.zeros(len(sizes), dtype=np.int64)]  # of each part before block b
        self._block = -1
        self._parts, self._turns = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)

    def __getitem__(self, k: int) -> int:
        block, offset = divmod(k, BLOCK)
        while len(self._counts) <= block:
            drawn = self._draw_parts(len(self._counts) - 1)
            self._counts.append(self._counts[-1] + np.bincount(drawn, minlength=len(self.orders)))
        if block != self._block:
            self._block, self._parts = block, self._draw_parts(block)
            self._turns = np.zeros(BLOCK, dtype=np.int64)  # how often each image's part came before in the block
            for part in range(len(self.orders)):
                own = np.flatnonzero(self._parts == part)
                self._turns[own] = np.arange(len(own))
        part = int(self._parts[offset])
        return int(self.starts[part]) + self.orders[part][int(self._counts[block][part] + self._turns[offset])]

    def _draw_parts(self, block: int) -> np.ndarray:
        u = noise.generator(self.seed, "mixture", block).random(BLOCK)
        return np.searchsorted(self.edges[:-1], u, side="right")
