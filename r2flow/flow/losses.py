"""Losses of a velocity estimate: each maps (v_t, u_t) of shape (B, ...) to one value per sample, (B,)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.registry import Registry

Loss = Callable[[Tensor, Tensor], Tensor]

HUGE = 1e15  # its square is finite in float32
PSEUDO_HUBER_SCALE = 0.00054  # c = 0.00054 sqrt(d), paper, below eq. 3


def mse(v_t: Tensor, u_t: Tensor) -> Tensor:
    """|v_t - u_t|^2 / d, the conditional flow matching loss (paper, eq. 2) on the scale of one element."""
    return (v_t.float() - u_t.float()).square().flatten(1).mean(1)


def pseudo_huber(v_t: Tensor, u_t: Tensor) -> Tensor:
    """(sqrt(|r|^2 + c^2) - c) / sqrt(d) with r = v_t - u_t, c = 0.00054 sqrt(d): the paper's eq. 3 over sqrt(d).

    The division keeps the minimum and brings gradients to the scale of the other losses. Without it they are
    sqrt(d) = 362 times those of the element-wise form, and gradient clipping at 1 would affect every step.
    """
    r = (v_t.float() - u_t.float()).flatten(1)
    d = r.shape[1]
    # vector_norm has gradient 0 at r = 0, sqrt of a sum of squares has NaN; the quotient avoids cancellation at small
    # r. If an element's square overflows float32, r is scaled and c is negligible.
    largest = r.detach().abs().amax(1)
    scale = torch.where(largest > HUGE, largest, torch.ones_like(largest))
    rms = torch.linalg.vector_norm(r / scale[:, None], dim=1) / math.sqrt(d) * scale
    small = rms.clamp(max=HUGE)
    loss = small.square() / ((small.square() + PSEUDO_HUBER_SCALE**2).sqrt() + PSEUDO_HUBER_SCALE)
    return torch.where(rms > HUGE, rms - PSEUDO_HUBER_SCALE, loss)


def pseudo_huber_elementwise(v_t: Tensor, u_t: Tensor) -> Tensor:
    """mean_i (sqrt(r_i^2 + c^2) - c), c = 0.00054 sqrt(d): the loss of the published weights."""
    r = (v_t.float() - u_t.float()).flatten(1)
    c = PSEUDO_HUBER_SCALE * math.sqrt(r.shape[1])
    return (r.square() / ((r.square() + c**2).sqrt() + c)).mean(1)


def absolute(v_t: Tensor, u_t: Tensor) -> Tensor:
    """mean_i |r_i|: its minimum is the median of each element."""
    return (v_t.float() - u_t.float()).abs().flatten(1).mean(1)


LOSSES: Registry[Loss] = Registry(
    "loss",
    mse=mse,
    pseudo_huber=pseudo_huber,
    pseudo_huber_elementwise=pseudo_huber_elementwise,
    absolute=absolute,
)
