"""Reflow pairs (x_0, x_1): noise and the sample that a flow maps it to."""

import copy
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from torch.utils.data import Dataset

from r2flow import noise
from r2flow.data.loader import FlowDataset, Item, Permutations
from r2flow.errors import InputError
from r2flow.flow.solvers import Solution
from r2flow.generators import Generated, Generator, as_flow
from r2flow.generators.base import Precision, autocast
from r2flow.models import name_of
from r2flow.processes import place
from r2flow.samplers import build_sampler
from r2flow.store import Damaged, Store


@dataclass(frozen=True)
class PairRecipe:
    """All that a pair depends on, except its index: folders with equal recipes hold the same bytes."""

    parent: str  # hash of the flow's weights and config
    shape: tuple[int, int, int]  # (C, H, W) of a scan in model space
    seed: int  # x_0 of index i is the noise of (seed, "pairs", i), which is not stored
    first: int  # index of the first pair
    sampler: dict[str, Any]  # name and fields of the flow's sampler
    batch_size: int  # consecutive indices that are solved in one batch
    shard_batches: int  # batches in a shard
    noise_shape: tuple[int, ...] | None = None  # shape of x_0, if it differs from the scan's
    knots: int = 0  # number of inner states stored per path
    precision: Precision = "32-true"  # precision of the network


class PairStore(Store):
    """A folder of pairs: shard s holds the batches [s S, (s + 1) S), batch b the indices first + [b B, (b + 1) B).

    The last shard has only the batches that the first `num` pairs need; it is made again for a larger `num`.
    """

    option = "data.root=FOLDER (r2flow pairs --out FOLDER)"

    def __init__(self, folder: str | Path, recipe: PairRecipe, num: int) -> None:
        self.recipe, self.num = recipe, num
        super().__init__(folder, "pairs", asdict(recipe))
        self.check()
        self.shards = range(-(-num // (recipe.shard_batches * recipe.batch_size)))

    def batches_of(self, shard: int) -> range:
        """The batches of a shard that the first `num` pairs need."""
        size = self.recipe.shard_batches
        return range(shard * size, min((shard + 1) * size, -(-self.num // self.recipe.batch_size)))

    def has(self, item: int) -> bool:
        """Whether a shard exists and has all batches that the first `num` pairs need."""
        try:
            usable = self.head(item)["usable"]
        except (FileNotFoundError, Damaged):
            return False
        return len(usable) >= len(self.batches_of(item)) * self.recipe.batch_size

    def missing_pairs(self) -> int:
        """Number of pairs in missing shards."""
        return sum(len(self.batches_of(shard)) for shard in self.missing(self.shards)) * self.recipe.batch_size


def pair_noise(recipe: PairRecipe, index: int) -> Tensor:
    """x_0 of a pair, in the recipe's noise shape or (C, H, W), drawn from its index."""
    return noise.standard_normal(recipe.noise_shape or recipe.shape, recipe.seed, "pairs", index)


@dataclass
class Made:
    """Progress of one process."""

    pairs: int = 0
    evaluations: int = 0
    unusable: int = 0  # pairs left out
    seconds: float = 0.0


def make_pairs(
    store: PairStore,
    generator: Generator,
    progress: Callable[[Made], None] = lambda made: None,
    wait: bool = True,
) -> Made:
    """Make the missing or damaged pairs of a store; `wait`: await those that others are making.

    x_1 is the generator's sample for x_0 = `pair_noise`, neither clamped nor snapped, in half precision. With `chord`
    or `renoise` of a flow map, it is the sample of the first jump, corrected by later jumps; fresh noise is a function
    of (seed, index, step). Batches do not depend on the process: shards are byte-identical for any number of processes.
    `progress` is called after each batch.
    """
    if generator.noise_shape != (store.recipe.noise_shape or store.recipe.shape):
        raise InputError(f"the noise of these pairs does not have the generator's shape {generator.noise_shape}.")
    sampler = build_sampler(store.recipe.sampler)
    sampler.check(generator)
    if not sampler.paired:
        raise InputError(f"pairs are the two ends of a path, and sampler {sampler.name} leaves it: give a solver.")
    made, start = Made(), time.monotonic()

    def make_shard(shard: int) -> None:
        store.mend([shard])
        batches = []
        for batch in store.batches_of(shard):
            batches.append(solve_batch(store.recipe, generator, batch))
            made.pairs += store.recipe.batch_size
            made.evaluations += int(batches[-1]["evaluations"].sum())
            made.unusable += int((~batches[-1]["usable"]).sum())
            made.seconds = time.monotonic() - start
            progress(made)
            if made.unusable == made.pairs and (made.pairs > 64 or batch == store.batches_of(shard)[-1]):
                raise InputError(
                    f"none of {made.pairs} pairs came to an end with sampler {sampler.name}: the flow is broken, or "
                    "the tolerance out of its reach."
                )
        tensors = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
        usable = tensors.pop("usable").astype(int).tolist()
        store.write(shard, tensors, {"usable": usable})

    store.begin()
    rank, ranks = place()  # of a run, whose processes verify a part each
    store.mend(store.shards[rank::ranks])
    missing = store.missing(store.shards)
    random.Random().shuffle(missing)  # processes rarely meet, also where locks do not reach other machines
    store.make(missing, make_shard, wait=wait)
    return made


def solve_batch(recipe: PairRecipe, generator: Generator, batch: int) -> dict[str, np.ndarray]:
    """The pairs first + [b B, (b + 1) B) of batch b: x_1, evaluations, usable and, with knots, the inner states.

    States are float16, (B, C, H, W) and (B, K, C, H, W); pairs whose states overflow float16 are not usable.
    """
    indices = range(recipe.first + batch * recipe.batch_size, recipe.first + (batch + 1) * recipe.batch_size)
    x_0 = torch.stack([pair_noise(recipe, index) for index in indices]).to(generator.device)
    sampler, states = build_sampler(recipe.sampler), {}
    end: Generated | Solution
    if recipe.knots:
        with autocast(generator.device, recipe.precision):
            end = as_flow(generator, "data.pairs.knots").solve(x_0, sampler=sampler, knots=recipe.knots)
        assert end.knots is not None
        states["knots"] = end.knots
    else:
        fresh = noise.Draws(recipe.seed, indices, "pairs") if sampler.draws else None
        end = generator(x_0, sampler=sampler, draws=fresh, precision=recipe.precision)
    states["x_1"] = end.x
    tensors, usable = {"evaluations": end.evaluations.cpu().numpy().astype(np.int32)}, end.converged.cpu().numpy()
    for name, values in states.items():
        tensors[name] = values.to(torch.float16).cpu().numpy()
        usable = usable & np.isfinite(tensors[name]).reshape(len(usable), -1).all(1)
    return {**tensors, "usable": usable}


class PairSource:
    """The usable pairs of a store: (x_0, x_1), both (C, H, W) float32 in model space."""

    def __init__(self, store: PairStore) -> None:
        self.store = store
        if lacking := store.missing_pairs():
            raise InputError(f"{store.folder} lacks about {lacking} of {store.num} pairs; make them: r2flow pairs RUN.")
        usable = [flag for shard in store.shards for flag in store.head(shard)["usable"]]
        self.indices = np.flatnonzero(usable[: store.num])

    def __len__(self) -> int:
        return len(self.indices)

    def subset(self, indices: Sequence[int]) -> "PairSource":
        part = copy.copy(self)
        part.indices = self.indices[np.asarray(indices, dtype=np.int64)]
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
        (path,) = self.store.files(shard)
        try:
            with safe_open(path, framework="pt") as file:
                return file.get_slice(name)[offset].float()
        except (SafetensorError, OSError) as error:
            raise InputError(
                f"{path} was lost or damaged while it was in use ({error}). The same command makes it again."
            ) from None


class PairDataset(Dataset[Item]):
    """Pairs as training items, with the keys of `FlowDataset`; u depends only on (seed, purpose, k).

    Further keys with knots: knots, (K, C, H, W), the inner states of the path, and times, (K + 2,), the times of x_0,
    the knots and x_1. Further keys with `scans`: scan, (C, H, W), a scan in model space, and noise, (*noise_shape),
    independent of the scan.
    """

    def __init__(self, source: PairSource, seed: int, purpose: str, scans: FlowDataset | None = None) -> None:
        self.source, self.seed, self.purpose, self.scans = source, seed, purpose, scans
        self.order = None if scans is None else Permutations(len(scans), seed)
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
            scan = self.scans[k, self.order[k]]
            item |= {"scan": scan["x_1"], "noise": scan["x_0"]}
        return item


def default_folder(checkpoint: Path) -> Path:
    """The default folder of a flow's pairs: `pairs` in its run folder, or a folder next to its file.

    The pairs of an installed model lie in `runs`, not in the folder of the package or of the models.
    """
    if checkpoint.parent.name == "checkpoints":
        return checkpoint.parent.parent / "pairs"
    if name_of(checkpoint) is not None:
        return Path("runs", f"{checkpoint.stem}-pairs")
    return checkpoint.with_name(f"{checkpoint.stem}-pairs")
