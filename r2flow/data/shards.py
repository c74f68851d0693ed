"""Reflow pairs on disk."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.generators.base import Precision
from r2flow.store import Damaged, Store

ELSEWHERE = "data.root=FOLDER (r2flow pairs --out FOLDER)"  # how another folder is given


@dataclass(frozen=True)
class PairRecipe:
    """What a pair is a function of, beside its index: two folders of one recipe hold the same bytes."""

    parent: str  # hash of the flow's weights and of what they mean
    shape: tuple[int, int, int]  # (C, H, W) of a scan in model space
    seed: int  # x_0 of index i is the noise of (seed, "pairs", i); it is never stored
    first: int  # index of the first pair
    sampler: dict[str, Any]  # name and fields of the flow's
    batch_size: int  # consecutive indices that are solved together
    shard_batches: int  # batches in a shard
    noise_shape: tuple[int, ...] | None = None  # of x_0, where it is not the scan's
    knots: int = 0  # inner states of each path that are kept with it
    precision: Precision = "32-true"  # of the network


NO_KNOTS = np.empty(0, np.float16)


class Block(NamedTuple):
    """Consecutive pairs.

    Attributes:
        x_1: (n, C, H, W) float16.
        evaluations: (n,) int32.
        usable: (n,) bool.
        knots: Inner states of each path, (n, K, C, H, W) float16, at `r2flow.flow.solvers.knot_times`; or none.
    """

    x_1: np.ndarray
    evaluations: np.ndarray
    usable: np.ndarray
    knots: np.ndarray = NO_KNOTS

    def with_knots(self, knots: Tensor | None) -> "Block":
        """With inner states, (n, K, C, H, W); a path with one that half precision cannot hold is not usable."""
        assert knots is not None
        kept = knots.to(torch.float16).cpu()
        return self._replace(knots=kept.numpy(), usable=self.usable & kept.isfinite().flatten(1).all(1).numpy())


class PairStore(Store):
    """A folder of pairs: shard s holds the batches [s S, (s + 1) S), batch b the indices first + [b B, (b + 1) B).

    The last shard is as long as the pairs that were asked for need, and grows when more are asked for.

    Raises:
        InputError: the folder holds other pairs, or a damaged manifest.
    """

    def __init__(self, folder: str | Path, recipe: PairRecipe) -> None:
        super().__init__(folder, "pairs", asdict(recipe), ELSEWHERE)
        self.recipe = recipe
        self.check()

    def shards(self, num: int) -> range:
        return range(-(-num // (self.recipe.batch_size * self.recipe.shard_batches)))

    def batches_of(self, shard: int, num: int) -> range:
        """The batches of a shard that the first `num` pairs need."""
        size, needed = self.recipe.shard_batches, -(-num // self.recipe.batch_size)
        return range(shard * size, min((shard + 1) * size, needed))

    def usable(self, shard: int) -> list[int]:
        """Whether each pair of a shard can be used; empty where the shard is missing or damaged."""
        try:
            usable: list[int] = self.head(shard)["usable"]
        except (FileNotFoundError, Damaged):
            return []
        return usable

    def lacking(self, shard: int, num: int) -> range:
        """The batches that a shard lacks of those that the first `num` pairs need."""
        return self.batches_of(shard, num)[len(self.usable(shard)) // self.recipe.batch_size :]

    def missing_pairs(self, num: int) -> int:
        return sum(len(self.lacking(shard, num)) for shard in self.shards(num)) * self.recipe.batch_size

    def append(self, shard: int, blocks: list[Block]) -> None:
        """Write a shard: the pairs that it holds already, and these."""
        if self.has(shard):
            tensors, notes = self.read(shard)
            usable = np.array(notes["usable"], bool)
            blocks = [Block(tensors["x_1"], tensors["evaluations"], usable, tensors.get("knots", NO_KNOTS)), *blocks]
        whole = Block(*(np.concatenate(parts) for parts in zip(*blocks, strict=True)))
        tensors = {"evaluations": whole.evaluations, "x_1": whole.x_1}
        if self.recipe.knots:
            tensors["knots"] = whole.knots
        self.write(shard, tensors, {"usable": [int(one) for one in whole.usable]})
