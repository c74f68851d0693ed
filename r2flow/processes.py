"""Work that several processes share: those of a run, or those of torchrun."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
from torch import Tensor, nn


def place() -> tuple[int, int]:
    """The number of this process among those of a run, and how many they are: (0, 1) for one alone."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return 0, 1
    return torch.distributed.get_rank(), torch.distributed.get_world_size()


def summed(x: Tensor) -> Tensor:
    """The sum over all processes of a run; x itself where there is one."""
    if place()[1] == 1:
        return x
    x = x.clone()
    torch.distributed.all_reduce(x)
    return x


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """The mean of each gradient over all processes of a run, in one message; nothing where there is one process."""
    taught = [p for p in parameters if p.grad is not None]
    if not taught or place()[1] == 1:
        return
    mean = averaged(torch.cat([p.grad.flatten() for p in taught if p.grad is not None]))
    for parameter, gradient in zip(taught, mean.split([p.numel() for p in taught]), strict=True):
        parameter.grad = gradient.view_as(parameter)


def averaged(x: Tensor) -> Tensor:
    """The mean over all processes of a run, which share a batch equally; x itself where there is one."""
    ranks = place()[1]
    return summed(x) / ranks if ranks > 1 else x


@contextmanager
def joined(device: str) -> Iterator[str]:
    """Join the group of processes that torchrun has started, and leave it afterwards; alone without torchrun.

    The processes take batches by turns, statistics are added up when figures are computed, and every process has all
    figures. Yields the device of this process.
    """
    if os.environ.get("WORLD_SIZE", "1") == "1" or "RANK" not in os.environ:
        yield device
        return
    if device == "cuda":
        device = f"cuda:{int(os.environ.get('LOCAL_RANK', '0')) % torch.cuda.device_count()}"
        torch.cuda.set_device(device)
    # Counts are exchanged on the CPU, statistics on the device that they are on. The first process alone searches for
    # copies, which can take hours, and the others wait for it.
    torch.distributed.init_process_group(
        "cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo", timeout=timedelta(days=7)
    )
    try:
        yield device
        torch.distributed.barrier()
    finally:
        torch.distributed.destroy_process_group()
