"""Per-scene arithmetic on batches."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.flow.solvers.solution import flat

# The error of a step is (mean |e|^6)^(1/6) over a scene's elements. Few pixels turn towards dropped
# or measured in any one step: a root mean square would hide their error, and with the maximum a
# single element would set the step.
_NORM = 6


def norms(*values: Tensor) -> ndarray:
    """Root mean square over each scene's elements, (len(values), B) float64, on the host.

    Sums are in float64 and rounded to float32: the order of summation may depend on the batch size,
    but a scene's steps must not. The rounding removes the difference in nearly all cases.
    """
    sums = [torch.linalg.vector_norm(flat(value), dim=1, dtype=torch.float64) for value in values]
    count = max(values[0][0].numel(), 1)
    return rounded(torch.stack(sums).cpu().numpy() / math.sqrt(count))


def powered(value: Tensor) -> Tensor:
    """A value in place to the power whose `norms` gives the norm of order 6 (`unpowered`)."""
    return value.pow_(_NORM // 2)


def unpowered(norm: ndarray) -> ndarray:
    """The norm of order 6 from that of the powered values."""
    return rounded(norm ** (2 / _NORM))


def rounded(values: ndarray) -> ndarray:
    """Values with the digits of float32: differences in float64's last digits do not propagate."""
    return values.astype(np.float32).astype(np.float64)


def weighted(weights: Sequence[float], k: Sequence[Tensor]) -> Tensor:
    """sum_i weights_i k_i, always a new tensor."""
    total = weights[0] * k[0]
    for weight, stage in zip(weights[1:], k[1:], strict=True):
        total.add_(stage, alpha=weight)
    return total
