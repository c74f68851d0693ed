"""Several processes of torchrun that share an evaluation."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.distributed as dist


@dataclass(frozen=True)
class Place:
    """Where this process stands.

    Attributes:
        rank, ranks: Its number and how many there are.
        device: Its own of those asked for.
        folder: Where the rows of scans are kept that all processes need; None for one process, which needs no name.
    """

    rank: int
    ranks: int
    device: str
    folder: Path | None = None


@contextmanager
def joined(device: str, environment: Mapping[str, str] = os.environ) -> Iterator[Place]:
    """Join the processes that torchrun has started, and part from them; alone where it has not.

    Batches go to the processes by turns, statistics are added up when figures are made of them, and every process has
    all figures. The folder lies in TMPDIR of the first process: on several machines TMPDIR must be one they share.
    """
    ranks = int(environment.get("WORLD_SIZE", "1"))
    if ranks == 1 or "RANK" not in environment:
        yield Place(0, 1, device)
        return
    rank, local = int(environment["RANK"]), int(environment.get("LOCAL_RANK", "0"))
    if device == "cuda":
        device = f"cuda:{local % torch.cuda.device_count()}"
        torch.cuda.set_device(device)
    # Counts go over the CPU, statistics from where they are.
    dist.init_process_group("cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo")
    told: list[str | None] = [tempfile.mkdtemp(prefix="r2flow-rows-") if rank == 0 else None]
    try:
        dist.broadcast_object_list(told, src=0)
        assert told[0] is not None
        yield Place(rank, ranks, device, Path(told[0]))
        dist.barrier()
    finally:
        if rank == 0 and told[0] is not None:
            shutil.rmtree(told[0], ignore_errors=True)
        dist.destroy_process_group()
