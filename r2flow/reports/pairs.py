"""Reflow pairs made with progress: how many, how fast, how long still."""

import os
import time
from collections.abc import Mapping

import torch

from r2flow.data.pairs import Made, make_pairs
from r2flow.data.shards import PairStore
from r2flow.model.checkpoint import Checkpoint
from r2flow.progress import Bar


def make_and_tell(
    store: PairStore,
    checkpoint: Checkpoint,
    num: int,
    rank: int = 0,
    ranks: int = 1,
    device: torch.device | str = "cpu",
) -> Made:
    """`make_pairs` with a bar; with lines where several processes work."""
    generator = checkpoint.generator.to(device)
    there = sum(store.shard_path(shard).is_file() for shard in store.shards(num))
    if there > 4 and rank == 0:
        print(f"checking {there} shards of pairs", flush=True)
    who = f"process {rank + 1} of {ranks}: " if ranks > 1 else ""
    total = sum(batch % ranks == rank for batch in store.missing(num)) * store.recipe.batch_size
    with Bar(f"{who}drawing", total, "pairs", lines=ranks > 1) as bar:
        made = make_pairs(store, generator, num, rank, ranks, lambda made: bar.set(made.pairs))
    if made.pairs:
        unusable = f", {made.unusable} did not converge and are left out" if made.unusable else ""
        rate, cost = made.pairs / made.seconds, made.evaluations / made.pairs
        drawn = f"{who}{made.pairs} pairs drawn in whole batches"
        print(f"{drawn}, {rate:.2f} pairs/s, {cost:.1f} evaluations a pair{unusable}", flush=True)
    return made


def wait_for_others(
    store: PairStore, num: int, launched: bool = False, pause: float = 2.0, patience: float = 120.0
) -> bool:
    """Wait for the other processes' pairs, without a collective call, which would time out.

    Args:
        launched: Whether one of the others started this process, which ends when that one is gone.

    Returns:
        Whether all are there; False when none has come for `patience` seconds: then any process may make the rest.
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

    def number(name: str, default: int = 0) -> int:
        return int(environment.get(name, default))

    # Of a step, not of the job: in the batch script itself, outside srun, there is one process however many were asked.
    tasks = number("SLURM_STEP_NUM_TASKS", 1)
    task = number("SLURM_PROCID") if tasks > 1 else 0
    jobs = number("SLURM_ARRAY_TASK_COUNT", 1)
    job = number("SLURM_ARRAY_TASK_ID") - number("SLURM_ARRAY_TASK_MIN")
    job //= number("SLURM_ARRAY_TASK_STEP", 1)
    if "RANK" in environment and "WORLD_SIZE" in environment:
        rank, ranks, local = number("RANK"), number("WORLD_SIZE"), number("LOCAL_RANK")
        return job * ranks + rank, jobs * ranks, local
    return job * tasks + task, jobs * tasks, number("SLURM_LOCALID")
