"""An evaluation that the processes of torchrun share."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist


@dataclass(frozen=True)
class Process:
    """This process among those that share an evaluation."""

    rank: int  # its number
    ranks: int  # how many there are
    device: str  # that it computes on


@contextmanager
def joined(device: str, environment: Mapping[str, str] = os.environ) -> Iterator[Process]:
    """Join the group of processes that torchrun has started, and leave it afterwards; alone without torchrun.

    The processes take batches by turns, statistics are added up when figures are computed, and every process has all
    figures.
    """
    ranks = int(environment.get("WORLD_SIZE", "1"))
    if ranks == 1 or "RANK" not in environment:
        yield Process(0, 1, device)
        return
    rank, local = int(environment["RANK"]), int(environment.get("LOCAL_RANK", "0"))
    if device == "cuda":
        device = f"cuda:{local % torch.cuda.device_count()}"
        torch.cuda.set_device(device)
    # Counts are exchanged on the CPU, statistics on the device that they are on.
    # The first process alone resamples, which can take hours (`--bootstrap`), and the others wait for it.
    dist.init_process_group("cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo", timeout=timedelta(days=7))
    try:
        yield Process(rank, ranks, device)
        dist.barrier()
    finally:
        dist.destroy_process_group()
