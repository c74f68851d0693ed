"""Communication between the processes of a run or of torchrun."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
from torch import Tensor, nn


def rank_and_world_size() -> tuple[int, int]:
    """Rank of this process and number of processes; (0, 1) for a single process."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return 0, 1
    return torch.distributed.get_rank(), torch.distributed.get_world_size()


def sum_over_processes(x: Tensor) -> Tensor:
    """Sum over all processes; x itself for a single process."""
    if rank_and_world_size()[1] == 1:
        return x
    x = x.clone()
    torch.distributed.all_reduce(x)
    return x


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Average each gradient over all processes, in one message; nothing for a single process."""
    trained = [p for p in parameters if p.grad is not None]
    if not trained or rank_and_world_size()[1] == 1:
        return
    mean = mean_over_processes(torch.cat([p.grad.flatten() for p in trained if p.grad is not None]))
    for parameter, gradient in zip(trained, mean.split([p.numel() for p in trained]), strict=True):
        parameter.grad = gradient.view_as(parameter)


def mean_over_processes(x: Tensor) -> Tensor:
    """Mean over all processes, which share a batch equally."""
    return sum_over_processes(x) / rank_and_world_size()[1]


@contextmanager
def process_group(device: str) -> Iterator[str]:
    """Join torchrun's process group for a block; without torchrun, run as a single process.

    Processes take batches in turn and sum statistics, so that each has all figures. Yields this
    process's device.
    """
    if os.environ.get("WORLD_SIZE", "1") == "1" or "RANK" not in os.environ:
        yield device
        return
    if device == "cuda":
        device = f"cuda:{int(os.environ.get('LOCAL_RANK', '0')) % torch.cuda.device_count()}"
        torch.cuda.set_device(device)
    # Counts are exchanged on the CPU, statistics on their device. The timeout covers the search for
    # copies by the first process, which can take hours.
    backend = "cpu:gloo,cuda:nccl" if device.startswith("cuda") else "gloo"
    torch.distributed.init_process_group(backend, timeout=timedelta(days=7))
    try:
        yield device
        torch.distributed.barrier()
    finally:
        torch.distributed.destroy_process_group()
