"""Figures of a batch that is shared by several processes."""

from collections.abc import Iterable

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
