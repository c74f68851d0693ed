"""From a checkpoint to scans in metres."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from r2flow.checkpoints import Checkpoint
from r2flow.errors import InputError
from r2flow.flow.solvers import solve
from r2flow.noise import standard_normal


@dataclass(frozen=True)
class Samples:
    """Generated scans.

    Attributes:
        images: Range in metres and reflectance, (B, 2 or 1, H, W), on the CPU; 0 where a ray was dropped.
        first: Number of the first one; scan i depends on (seed, i) alone.
        evaluations: Network evaluations of each, (B,).
    """

    images: Tensor
    first: int
    evaluations: Tensor


def noise_of(indices: range, shape: tuple[int, ...], seed: int, purpose: str = "evaluation") -> Tensor:
    """x_0 of the given scans, (B, C, H, W), on the CPU."""
    return torch.stack([standard_normal(shape, seed, purpose, index) for index in indices])


def sample(
    checkpoint: Checkpoint,
    num: int,
    steps: int = 32,
    seed: int = 0,
    method: str = "euler",
    tolerance: float = 1e-5,
    batch_size: int = 1,
    progress: Callable[[], None] | None = None,
) -> Iterator[Samples]:
    """Draw scans 0 to num - 1 of a seed, batch by batch.

    Args:
        steps: Equal steps from noise to data.
        method: A solver's name (`r2flow.flow.solvers.solve`).
        batch_size: Scans at once. It does not change a fixed-step result beyond rounding.
        progress: Called after every network evaluation of a batch.

    Raises:
        InputError: num or batch_size below 1; a solver's own complaints.
    """
    if num < 1 or batch_size < 1:
        raise InputError(f"needs at least one scan and a batch of at least one; found {num} and {batch_size}.")
    device = next(checkpoint.model.parameters()).device
    shape = (checkpoint.encoding.channels, *checkpoint.sensor.shape)
    for first in range(0, num, batch_size):
        x_0 = noise_of(range(first, min(first + batch_size, num)), shape, seed).to(device)
        with torch.inference_mode():
            end = solve(checkpoint.model, x_0, 0.0, 1.0, method, steps, tolerance, progress)
        yield Samples(checkpoint.encoding.decode(end.x.cpu()), first, end.evaluations)


def batches(num: int, batch_size: int) -> int:
    """How many batches `sample` takes."""
    return math.ceil(num / batch_size)
