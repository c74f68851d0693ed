"""Figures of a batch that is shared by several processes."""

from collections.abc import Iterable

import torch
from torch import Tensor, nn


def summed(x: Tensor) -> Tensor:
    """The sum over all processes of a run; x itself where there is one."""
    if not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return x
    x = x.clone()
    torch.distributed.all_reduce(x)
    return x


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """The mean of each gradient over all processes of a run, in one message; nothing where there is one process."""
    taught = [p for p in parameters if p.grad is not None]
    if not taught or not (torch.distributed.is_available() and torch.distributed.is_initialized()):
        return
    mean = averaged(torch.cat([p.grad.flatten() for p in taught if p.grad is not None]))
    for parameter, gradient in zip(taught, mean.split([p.numel() for p in taught]), strict=True):
        parameter.grad = gradient.view_as(parameter)


def averaged(x: Tensor) -> Tensor:
    """The mean over all processes of a run, which share a batch equally; x itself where there is one."""
    there = torch.distributed.is_available() and torch.distributed.is_initialized()
    return summed(x) / torch.distributed.get_world_size() if there else x
