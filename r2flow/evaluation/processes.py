"""An evaluation that the processes of torchrun share."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist


@contextmanager
def joined(device: str, environment: Mapping[str, str] = os.environ) -> Iterator[str]:
    """Join the group of processes that torchrun has started, and leave it afterwards; alone without torchrun.

    The processes take batches by turns, statistics are added up when figures are computed, and every process has all
    figures. Yields the device of this process.
    """
    if environment.get("WORLD_SIZE", "1") == "1" or "RANK" not in environment:
        yield device
        return
    if device == "cuda":
        device = f"cuda:{int(environment.get('LOCAL_RANK', '0')) % torch.cuda.device_count()}"
        torch.cuda.set_device(device)
    # Counts are exchanged on the CPU, statistics on the device that they are on. The first process alone searches for
    # copies, which can take hours, and the others wait for it.
    dist.init_process_group("cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo", timeout=timedelta(days=7))
    try:
        yield device
        dist.barrier()
    finally:
        dist.destroy_process_group()
