"""Generation of reflow pairs with progress output."""

import os
from collections.abc import Mapping

import torch

from r2flow.data.pairs import Made, PairStore, make_pairs
from r2flow.model.checkpoint import Checkpoint
from r2flow.progress import Bar


def make_and_tell(
    store: PairStore,
    checkpoint: Checkpoint,
    rank: int = 0,
    ranks: int = 1,
    device: torch.device | str = "cpu",
    wait: bool = True,
) -> Made:
    """`make_pairs` with a progress bar, or lines for several processes."""
    generator = checkpoint.generator.to(device)
    who = f"process {rank + 1} of {ranks}: " if ranks > 1 else ""
    with Bar(f"{who}drawing", store.missing_pairs(), "pairs", lines=ranks > 1) as bar:
        made = make_pairs(store, generator, rank, ranks, lambda made: bar.set(made.pairs), wait)
    if made.pairs:
        unusable = f", {made.unusable} did not converge and are left out" if made.unusable else ""
        rate, cost = made.pairs / made.seconds, made.evaluations / made.pairs
        drawn = f"{who}{made.pairs} pairs drawn in whole batches"
        print(f"{drawn}, {rate:.2f} pairs/s, {cost:.1f} evaluations a pair{unusable}", flush=True)
    return made


def place(environment: Mapping[str, str] = os.environ) -> tuple[int, int, int]:
    """(rank, processes, rank on this machine) from torchrun or SLURM, including arrays; else (0, 1, 0)."""

    def number(name: str, default: int = 0) -> int:
        return int(environment.get(name, default))

    # Variables of the step, not the job: the batch script outside srun is always one process.
    tasks = number("SLURM_STEP_NUM_TASKS", 1)
    task = number("SLURM_PROCID") if tasks > 1 else 0
    jobs = number("SLURM_ARRAY_TASK_COUNT", 1)
    job = number("SLURM_ARRAY_TASK_ID") - number("SLURM_ARRAY_TASK_MIN")
    job //= number("SLURM_ARRAY_TASK_STEP", 1)
    if "RANK" in environment and "WORLD_SIZE" in environment:
        rank, ranks, local = number("RANK"), number("WORLD_SIZE"), number("LOCAL_RANK")
        return job * ranks + rank, jobs * ranks, local
    return job * tasks + task, jobs * tasks, number("SLURM_LOCALID")
