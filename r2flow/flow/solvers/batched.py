"""Per-scene arithmetic on batches."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.solution import flat

# The error of a step is (mean |e|^6)^(1/6) over a scene's elements. Few pixels turn towards dropped or measured in any
# one step: a root mean square would hide their error, and with the maximum a single element would set the step.
NORM = 6


def norms(*values: Tensor) -> np.ndarray:
    """Root mean square over each scene's elements, (len(values), B) float64, in one transfer to the host.

    Sums are in float64 and rounded to float32: the order of summation may depend on the batch size, but a scene's steps
    must not. The rounding removes the difference in nearly all cases.
    """
    sums = [torch.linalg.vector_norm(flat(value), dim=1, dtype=torch.float64) for value in values]
    count = max(values[0][0].numel(), 1)
    with np.errstate(over="ignore"):
        return (torch.stack(sums).cpu().numpy() / math.sqrt(count)).astype(np.float32).astype(np.float64)


def powered(value: Tensor) -> Tensor:
    """Raise a value in place to the power with which `norms` computes the norm of order `NORM`; see `unpowered`."""
    return value.pow_(NORM // 2)


def unpowered(norm: np.ndarray) -> np.ndarray:
    """The norm of order `NORM` from that of the powered values."""
    return (norm ** (2 / NORM)).astype(np.float32).astype(np.float64)


def weighted(weights: Sequence[float | Tensor], k: Sequence[Tensor]) -> Tensor:
    """sum_i weights_i k_i, always a new tensor."""
    terms = [(w, stage) for w, stage in zip(weights, k, strict=True) if isinstance(w, Tensor) or w]
    total = terms[0][1] * terms[0][0]
    for weight, stage in terms[1:]:
        if isinstance(weight, Tensor):
            total.addcmul_(stage, weight)
        else:
            total.add_(stage, alpha=weight)
    return total


def rows(x: Tensor, places: np.ndarray) -> Tensor:
    return x[torch.from_numpy(places).to(x.device)]
