"""Reflow pairs (x_0, x_1): noise and where a flow carries it."""

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from r2flow import noise
from r2flow.data.loader import Item, Order
from r2flow.errors import InputError
from r2flow.flow.solvers import Solution
from r2flow.generators import Generated, Generator, as_flow
from r2flow.generators.base import Precision, autocast
from r2flow.models import name_of
from r2flow.samplers import build_sampler
from r2flow.store import PATIENCE, Damaged, Store

ELSEWHERE = "data.root=FOLDER (r2flow pairs --out FOLDER)"  # how another folder is given


@dataclass(frozen=True)
class PairRecipe:
    """What a pair depends on, apart from its index: two folders of one recipe hold the same bytes."""

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
        knots: Inner states of each path, (n, K, C, H, W) float16, at `r2flow.samplers.Sampler.knot_times`, or None.
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


def pair_noise(recipe: PairRecipe, index: int) -> Tensor:
    """x_0 of a pair, of the recipe's noise shape or (C, H, W), drawn again from its index."""
    return noise.standard_normal(recipe.noise_shape or recipe.shape, recipe.seed, "pairs", index)


@dataclass
class Made:
    """What one process has done."""

    pairs: int = 0
    evaluations: int = 0
    unusable: int = 0  # pairs that are left out
    seconds: float = 0.0


def make_pairs(
    store: PairStore,
    generator: Generator,
    num: int,
    rank: int = 0,
    ranks: int = 1,
    progress: Callable[[Made], None] = lambda made: None,
    wait: bool = False,
) -> Made:
    """Make those of the first `num` pairs that are missing or damaged, and that no other process is making.

    x_1 is where the generator carries x_0 = `pair_noise`, neither clamped nor snapped, in half precision. By `chord` or
    `renoise` of a flow map it is where its first jump goes, as its later jumps correct it; fresh noise is a function of
    (seed, index, step). A batch is computed alike whoever makes it, so the shards are the same, byte for byte, for any
    number of processes; rank r of R begins with shard r, r + R, ... `progress` is called after each batch.

    Args:
        wait: Whether to wait for the shards that other processes are making.

    Raises:
        InputError: no pair is usable: the flow is broken, or the tolerance out of its reach; or the folder cannot be
            written, or holds other pairs.
    """
    if generator.noise_shape != (store.recipe.noise_shape or store.recipe.shape):
        raise InputError(f"these pairs are of another noise than the generator's {generator.noise_shape}.")
    sampler = build_sampler(store.recipe.sampler)
    sampler.check(generator)
    if not sampler.paired:
        raise InputError(f"a pair is the ends of one path, which sampler {sampler.name} leaves: give a solver.")
    if generator.fixed and sampler != generator.sampler:
        raise InputError(
            f"this generator was distilled for {generator.sampler} and draws no pairs by {sampler}: give the same "
            "data.pairs.sampler, or pairs of the flow that it comes from."
        )
    store.begin()
    shards, made, start = store.shards(num), Made(), time.monotonic()
    store.mend(shards[rank::ranks])
    left = sorted(shards, key=lambda shard: ((shard - rank) % ranks, shard))
    while left := [shard for shard in left if store.lacking(shard, num)]:
        before = made.pairs
        for shard in left:
            with store.claim(shard) as mine:
                if mine:
                    _make_shard(store, generator, shard, num, made, start, progress)
        if not wait:
            break
        if made.pairs == before:
            time.sleep(PATIENCE)
    made.seconds = time.monotonic() - start
    return made


def _make_shard(
    store: PairStore,
    generator: Generator,
    shard: int,
    num: int,
    made: Made,
    start: float,
    progress: Callable[[Made], None],
) -> None:
    store.mend([shard])
    blocks = []
    for batch in store.lacking(shard, num):
        block = solve_batch(store.recipe, generator, batch)
        made.pairs += len(block.usable)
        made.evaluations += int(block.evaluations.sum())
        made.unusable += int((~block.usable).sum())
        if made.unusable == made.pairs > 64:
            break
        blocks.append(block)
        made.seconds = time.monotonic() - start
        progress(made)
    if made.pairs and made.unusable == made.pairs:
        raise InputError(
            f"none of {made.pairs} pairs came to an end with sampler {store.recipe.sampler['name']}: the flow is "
            "broken, or the tolerance out of its reach."
        )
    if blocks:
        store.append(shard, blocks)


def solve_batch(recipe: PairRecipe, generator: Generator, batch: int) -> Block:
    """The pairs first + [b B, (b + 1) B) of batch b."""
    first = recipe.first + batch * recipe.batch_size
    x_0 = torch.stack([pair_noise(recipe, index) for index in range(first, first + recipe.batch_size)])
    x_0 = x_0.to(generator.device)
    end: Generated | Solution
    how = build_sampler(recipe.sampler)
    if recipe.knots:
        with autocast(generator.device, recipe.precision):
            end = as_flow(generator, "data.pairs.knots").solve(x_0, sampler=how, knots=recipe.knots)
    else:
        fresh = noise.Draws(recipe.seed, range(first, first + recipe.batch_size), "pairs")
        end = generator(x_0, sampler=how, draws=fresh if how.draws else None, precision=recipe.precision)
    x_1, usable = end.x.to(torch.float16).cpu(), end.converged.cpu()
    usable = usable & x_1.isfinite().flatten(1).all(1)
    block = Block(x_1.numpy(), end.evaluations.cpu().numpy().astype(np.int32), usable.numpy())
    return block if not isinstance(end, Solution) else block.with_knots(end.knots)


class PairSource:
    """The usable ones of a store's first `num` pairs, each (x_0, x_1), both (C, H, W) float32 in model space.

    Raises:
        InputError: some have yet to be made.
    """

    def __init__(self, store: PairStore, num: int) -> None:
        self.store = store
        if lacking := store.missing_pairs(num):
            raise InputError(f"{store.folder} lacks about {lacking} of {num} pairs; make them: r2flow pairs RUN.")
        usable = [flag for shard in store.shards(num) for flag in store.usable(shard)]
        self.indices = np.flatnonzero(usable[:num])
        self._opened: dict[tuple[int, str], Any] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}  # memory maps stay in their process

    def __len__(self) -> int:
        return len(self.indices)

    def subset(self, indices: Sequence[int]) -> "PairSource":
        part = copy.copy(self)
        part.indices, part._opened = self.indices[np.asarray(indices, dtype=np.int64)], {}
        return part

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor]:
        recipe, number = self.store.recipe, int(self.indices[index])
        return pair_noise(recipe, recipe.first + number), self._read("x_1", number)

    def knots(self, index: int) -> Tensor:
        """Inner states of the pair's path, (K, C, H, W) float32."""
        return self._read("knots", int(self.indices[index]))

    def _read(self, name: str, number: int) -> Tensor:
        recipe = self.store.recipe
        shard, offset = divmod(number, recipe.shard_batches * recipe.batch_size)
        try:
            if (shard, name) not in self._opened:
                (path,) = self.store.files(shard)
                self._opened[shard, name] = safe_open(path, framework="pt").get_slice(name)
            values: Tensor = self._opened[shard, name][offset : offset + 1][0].float()
        except (SafetensorError, OSError, IndexError) as error:
            raise InputError(
                f"{self.store.files(shard)[0]} was lost or damaged while it was in use ({error}). "
                "The same command makes it again and resumes."
            ) from None
        return values


class PairDataset(Dataset[Item]):
    """A pair as a training item, with the keys of `FlowDataset`; u is a function of (seed, purpose, k) alone.

    With knots there are two keys more: knots, (K, C, H, W), the inner states of the path, and times, (K + 2,), those of
    x_0, the knots and x_1. With scans beside the pairs two others: scan, (C, H, W), one of them in model space, and
    noise, (*noise_shape), which does not belong to it.
    """

    def __init__(
        self,
        source: PairSource,
        seed: int,
        purpose: str,
        scans: Dataset[Item] | None = None,
        order: Order | None = None,
    ) -> None:
        self.source, self.seed, self.purpose = source, seed, purpose
        self.scans, self.order = scans, order
        recipe = source.store.recipe
        self.times = build_sampler(recipe.sampler).knot_times(recipe.knots).float() if recipe.knots else None

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, key: tuple[int, int]) -> Item:
        k, index = key
        x_0, x_1 = self.source[index]
        u = torch.tensor(noise.generator(self.seed, self.purpose, k).random(dtype=np.float32))
        item = {"x_1": x_1, "x_0": x_0, "u": u, "k": torch.tensor(k)}
        if self.times is not None:
            item |= {"knots": self.source.knots(index), "times": self.times}
        if self.scans is not None and self.order is not None:
            beside = self.scans[k, self.order[k]]
            item |= {"scan": beside["x_1"], "noise": beside["x_0"]}
        return item


def default_folder(checkpoint: Path) -> Path:
    """The usual folder of a flow's pairs: `pairs` in its run's folder, or next to its file.

    Those of a model lie in `runs`, for its own folder is that of the package or of the models.
    """
    if checkpoint.parent.name == "checkpoints":
        return checkpoint.parent.parent / "pairs"
    if name_of(checkpoint) is not None:
        return Path("runs", f"{checkpoint.stem}-pairs")
    return checkpoint.with_name(f"{checkpoint.stem}-pairs")
