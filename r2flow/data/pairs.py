"""Reflow pairs (x_0, x_1): noise and the sample that a flow maps it to."""

import math
import os
import random
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from torch import Tensor
from torch.utils.data import Dataset

from r2flow.base import noise
from r2flow.base.errors import InputError, check
from r2flow.base.files import reading_errors
from r2flow.base.processes import rank_and_world_size
from r2flow.base.progress import Bar
from r2flow.base.signals import LATER, Stopped
from r2flow.data.loader import FlowDataset, Item, Key, Permutations
from r2flow.data.options import PairOptions
from r2flow.generators import Flow, Generator, as_flow
from r2flow.model.shipped import name_of
from r2flow.samplers import build_sampler
from r2flow.store import Store


class PairStore(Store):
    """A folder of pairs: shard s holds the batches [s S, (s + 1) S), batch b the indices first + [b
    B, (b + 1) B).

    A pair depends on its index and on all `options` except `num`: folders of equal options hold the
    same bytes. The last shard has only the batches that the first `num` pairs need; it is made
    again for a larger `num`.

    Args:
        shape: (C, H, W) of a scan in model space.
        noise_shape: That of x_0; None: the scan's.
    """

    option = "data.root=FOLDER (r2flow pairs --out FOLDER)"

    def __init__(
        self,
        folder: str | Path,
        options: PairOptions,
        shape: tuple[int, int, int],
        noise_shape: tuple[int, ...] | None = None,
    ) -> None:
        self.options = options
        self.first = options.first or 0
        self.noise_shape = noise_shape or shape
        self.sampler = build_sampler(options.sampler)
        size = options.batch_size * 2 * math.prod(shape)
        self.shard_batches = max(round(options.shard_mib * 2**20 / size), 1)
        recipe = {
            "parent": options.parent or "",
            "shape": shape,
            "seed": options.seed,
            "first": self.first,
            "sampler": self.sampler.asdict(),
            "batch_size": options.batch_size,
            "shard_batches": self.shard_batches,
            "noise_shape": None if self.noise_shape == shape else self.noise_shape,
            "precision": options.precision,
        }
        super().__init__(folder, "pairs", recipe)
        self.check()
        self.shards = range(math.ceil(options.num / (self.shard_batches * options.batch_size)))

    def batches_of(self, shard: int) -> range:
        """The batches of a shard that the first `num` pairs need."""
        needed = range(math.ceil(self.options.num / self.options.batch_size))
        return needed[shard * self.shard_batches : (shard + 1) * self.shard_batches]

    def pairs_of(self, shard: int) -> int:
        return len(self.batches_of(shard)) * self.options.batch_size

    def has(self, item: int) -> bool:
        """Whether a shard exists and has all batches that the first `num` pairs need."""
        return super().has(item) and len(self.head(item)["usable"]) >= self.pairs_of(item)

    def missing_pairs(self) -> int:
        return sum(map(self.pairs_of, self.missing(self.shards)))

    def usable(self) -> np.ndarray:
        """The numbers of the usable pairs, from 0; refuses a folder that lacks pairs."""
        num = self.options.num
        if lacking := min(self.missing_pairs(), num):
            raise InputError(
                f"{self.folder} lacks about {lacking} of {num} pairs; make them: r2flow pairs RUN."
            )
        flags = [flag for shard in self.shards for flag in self.head(shard)["usable"]]
        return np.flatnonzero(flags[:num])

    def noise(self, index: int) -> Tensor:
        """x_0 of a pair, which is not stored: the noise of (seed, "pairs", index)."""
        return noise.standard_normal(self.noise_shape, self.options.seed, "pairs", index)


def make_pairs(store: PairStore, generator: Generator, wait: bool = True) -> list[bool]:
    """Make the missing or damaged pairs of a store, with a progress bar; `wait`: await those that
    others are making.

    The result is whether each pair that this process has drawn is usable.

    x_1 is the generator's sample for x_0 = `store.noise`, neither clamped nor snapped, in half
    precision. With `renoise` of a flow map, it is the sample of the first jump, corrected by later
    jumps; fresh noise is a function of (seed, index, step). Batches do not depend on the process:
    shards are byte-identical for any number of processes.
    """
    flow = _drawer(store, generator)
    usable: list[bool] = []
    evaluations = 0
    start = time.monotonic()
    seconds = 0.0  # without waiting for others
    launcher = os.getppid()
    launched = int(os.environ.get("LOCAL_RANK") or 0) > 0

    def make_shard(shard: int) -> None:
        nonlocal evaluations, seconds
        store.mend(shard)
        batches = []
        for batch in store.batches_of(shard):
            # killed: this process would draw all pairs and then fail
            if launched and os.getppid() != launcher:
                raise Stopped(LATER, "stopped: the process that launched this one has ended")
            batches.append(_solve_batch(store, flow, batch))
            evaluations += int(batches[-1]["evaluations"].sum())
            usable.extend(batches[-1]["usable"].tolist())
            seconds = time.monotonic() - start
            bar.set(len(usable))
            if not any(usable) and (len(usable) > 64 or batch == store.batches_of(shard)[-1]):
                raise InputError(
                    f"none of {len(usable)} pairs came to an end with {store.sampler.name}: the "
                    "flow is broken, or the tolerance out of its reach."
                )
        tensors = {name: np.concatenate([batch[name] for batch in batches]) for name in batches[0]}
        flags = tensors.pop("usable").astype(int).tolist()
        store.write(shard, tensors, {"usable": flags})

    with Bar("drawing", store.missing_pairs(), "pairs", lines="WORLD_SIZE" in os.environ) as bar:
        store.begin()
        rank, ranks = rank_and_world_size()  # of a run, whose processes verify a part each
        for shard in store.shards[rank::ranks]:
            store.mend(shard)
        # shuffled: processes rarely meet, also without common locks
        missing = store.missing(store.shards)
        store.make(random.Random().sample(missing, len(missing)), make_shard, wait=wait)
    if usable:
        lost = usable.count(False)
        print(
            f"{len(usable)} pairs drawn, {len(usable) / seconds:.1f} pairs/s, "
            f"{evaluations / len(usable):.3g} evaluations a pair"
            + (f"; left out: {lost} did not converge" if lost else ""),
            flush=True,
        )
    return usable


def _drawer(store: PairStore, generator: Generator) -> Flow:
    """The generator as a flow that can draw the pairs of a store."""
    shape = generator.noise_shape
    check(shape == store.noise_shape, f"the noise of these pairs has not the shape {shape}.")
    flow = as_flow(generator, "a reflow pair", distilled=True)
    sampler = store.sampler
    sampler.check(flow)
    check(
        sampler.paired,
        f"pairs are the two ends of a path, and sampler {sampler.name} leaves it: give a solver.",
    )
    return flow


def _solve_batch(store: PairStore, generator: Flow, batch: int) -> dict[str, np.ndarray]:
    """The pairs first + [b B, (b + 1) B) of batch b: x_1, evaluations and usable.

    x_1 is float16, (B, C, H, W); pairs that overflow float16 are not usable.
    """
    options = store.options
    sampler = store.sampler
    first = store.first + batch * options.batch_size
    indices = range(first, first + options.batch_size)
    x_0 = torch.stack([store.noise(index) for index in indices]).to(generator.device)
    fresh = noise.Draws(options.seed, indices, "pairs") if sampler.draws else None
    end = generator(x_0, sampler=sampler, draws=fresh, precision=options.precision)
    x_1 = end.x.to(torch.float16).cpu().numpy()
    return {
        "evaluations": end.evaluations.cpu().numpy().astype(np.int32),
        "x_1": x_1,
        "usable": end.converged.cpu().numpy() & np.isfinite(x_1).reshape(len(x_1), -1).all(1),
    }


@dataclass(eq=False)
class PairDataset(Dataset[Item]):
    """Some pairs of a store as training items; u depends only on (seed, purpose, k).

    The keys are those of `FlowDataset`. Further keys with `scans`: scan, (C, H, W), a scan in model
    space, and noise, (*noise_shape), independent of it.
    """

    store: PairStore
    numbers: np.ndarray
    seed: int
    purpose: str
    scans: FlowDataset | None = None

    def __post_init__(self) -> None:
        if self.scans is not None:
            self.order = Permutations(len(self.scans), self.seed)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, key: Key) -> Item:
        k, index = (key, key) if isinstance(key, int) else key
        store = self.store
        number = int(self.numbers[index])
        shard, offset = divmod(number, store.shard_batches * store.options.batch_size)
        with reading_errors(path := store.file(shard)), safe_open(path, framework="pt") as file:
            x_1 = file.get_slice("x_1")[offset].float()
        u = torch.tensor(noise.generator(self.seed, self.purpose, k).random(dtype=np.float32))
        item = {"x_0": store.noise(store.first + number), "x_1": x_1, "u": u, "k": torch.tensor(k)}
        if self.scans is not None:
            scan = self.scans[k, self.order[k]]
            item |= {"scan": scan["x_1"], "noise": scan["x_0"]}
        return item


def default_folder(checkpoint: Path) -> Path:
    """The default folder of a flow's pairs: `pairs` in its run folder, else next to its file, in
    `runs` for a model.
    """
    if checkpoint.parent.name == "checkpoints":
        return checkpoint.parent.parent / "pairs"
    if name_of(checkpoint) is not None:
        return Path("runs", f"{checkpoint.stem}-pairs")
    return checkpoint.with_name(f"{checkpoint.stem}-pairs")
