"""Pairs made under the eyes of the user: how many, how fast, how long still."""

import os
import sys
import time
from collections.abc import Mapping

import torch

from r2flow.checkpoints import Checkpoint
from r2flow.data.pairs import Made, make_pairs
from r2flow.data.shards import PairStore
from r2flow.progress import Bar
from r2flow.reports.clock import duration


def make_and_tell(
    store: PairStore,
    checkpoint: Checkpoint,
    num: int,
    rank: int = 0,
    ranks: int = 1,
    device: torch.device | str = "cpu",
    seconds: float = 15.0,
) -> Made:
    """`make_pairs` with a bar, or a line every `seconds` where no one watches or several work."""
    generator = checkpoint.generator.to(device)
    there = sum(store.shard_path(shard).is_file() for shard in store.shards(num))
    if there > 4 and rank == 0:
        print(f"checking {there} shards of pairs", flush=True)
    own = [batch for batch in store.missing(num) if batch % ranks == rank]
    who = f"process {rank + 1} of {ranks}: " if ranks > 1 else ""
    teller = _Teller(who, len(own) * store.recipe.batch_size, seconds, watched=sys.stdout.isatty() and ranks == 1)
    with teller.bar:
        made = make_pairs(store, generator, num, rank, ranks, teller)
    if made.pairs:
        unusable = f", {made.unusable} did not come to an end and are left out" if made.unusable else ""
        print(f"{who}{made.pairs} pairs, {rate(made)}{unusable}", flush=True)
    return made


def rate(made: Made) -> str:
    """Pairs a second, evaluations a pair."""
    return f"{made.pairs / made.seconds:.2f} pairs/s, {made.evaluations / made.pairs:.1f} evaluations a pair"


class _Teller:
    """Moves a bar on a terminal and prints lines elsewhere."""

    def __init__(self, who: str, total: int, seconds: float, watched: bool) -> None:
        self.who, self.total, self.seconds, self.watched = who, total, seconds, watched
        self.bar = Bar("drawing", total, "pairs", shown=watched)
        self.last = time.monotonic()

    def __call__(self, made: Made) -> None:
        self.bar.set(made.pairs, rate(made))
        now = time.monotonic()
        if self.watched or now - self.last < self.seconds:
            return
        self.last = now
        left = max(self.total - made.pairs, 0) * made.seconds / made.pairs
        print(f"{self.who}pair {made.pairs}/{self.total}  {rate(made)}  {duration(left)} left", flush=True)


def wait_for_others(
    store: PairStore, num: int, launched: bool = False, pause: float = 2.0, patience: float = 120.0
) -> bool:
    """Until the other processes' pairs are there too: no collective call, which would time out after a while.

    Args:
        launched: This process was started by one of the others, and is of no use when that is gone.

    Returns:
        Whether all are there; False when none has come for `patience` seconds: what is missing is anyone's to make.
    """
    parent, lacking, since = os.getppid(), len(store.missing(num)), time.monotonic()
    while not store.is_whole(num):
        time.sleep(pause)
        for shard in store.shards(num):
            store.seal(shard, num)
        now = len(store.missing(num))
        if now != lacking:
            lacking, since = now, time.monotonic()
        elif time.monotonic() - since > patience:
            return False
        if launched and os.getppid() != parent:
            raise SystemExit("the process that started this one is gone")
    return True


def place(environment: Mapping[str, str] = os.environ) -> tuple[int, int, int]:
    """(rank, processes, rank on this machine) as torchrun or SLURM tell it, arrays included; (0, 1, 0) elsewhere."""

    def number(name: str, default: int) -> int:
        return int(environment.get(name, default))

    # Of a step, not of the job: in the batch script itself, outside srun, there is one process however many were asked.
    tasks = number("SLURM_STEP_NUM_TASKS", 1)
    task = number("SLURM_PROCID", 0) if tasks > 1 else 0
    jobs = number("SLURM_ARRAY_TASK_COUNT", 1)
    job = number("SLURM_ARRAY_TASK_ID", 0) - number("SLURM_ARRAY_TASK_MIN", 0)
    step = number("SLURM_ARRAY_TASK_STEP", 1)
    job //= step
    if "RANK" in environment and "WORLD_SIZE" in environment:
        rank, ranks, local = number("RANK", 0), number("WORLD_SIZE", 1), number("LOCAL_RANK", 0)
        return job * ranks + rank, jobs * ranks, local
    return job * tasks + task, jobs * tasks, number("SLURM_LOCALID", 0)
