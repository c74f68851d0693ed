"""Losses of a velocity estimate: each maps (v_t, u_t), (B, ...), to one value per sample, (B,)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.base.registry import Registry

_Loss = Callable[[Tensor, Tensor], Tensor]

_C = 0.00054  # c = 0.00054 sqrt(d), paper, below eq. 3


def mse(v_t: Tensor, u_t: Tensor) -> Tensor:
    """|v_t - u_t|^2 / d, the conditional flow matching loss (paper, eq. 2) of one element."""
    return (v_t.float() - u_t.float()).square().flatten(1).mean(1)


def pseudo_huber(v_t: Tensor, u_t: Tensor) -> Tensor:
    """(sqrt(|r|^2 + c^2) - c) / sqrt(d) with r = v_t - u_t, c = 0.00054 sqrt(d): the paper's eq. 3
    over sqrt(d).

    The division keeps the minimum and brings gradients to the scale of the other losses. Without it
    they are sqrt(d) = 362 times those of the element-wise form, and gradient clipping at 1 would
    affect every step.
    """
    r = (v_t.float() - u_t.float()).flatten(1)
    # Squares of large elements overflow float32: they are scaled. vector_norm has gradient 0 at r =
    # 0, where sqrt of a sum of squares has NaN; the quotient avoids cancellation at small r.
    scale = r.detach().abs().amax(1, keepdim=True).clamp(min=1)
    rms = torch.linalg.vector_norm(r / scale, dim=1) * scale[:, 0] / math.sqrt(r.shape[1])
    return rms * (rms / (rms.hypot(rms.new_tensor(_C)) + _C))


def pseudo_huber_elementwise(v_t: Tensor, u_t: Tensor) -> Tensor:
    """mean_i (sqrt(r_i^2 + c^2) - c), c = 0.00054 sqrt(d): the loss of the published weights."""
    r = (v_t.float() - u_t.float()).flatten(1)
    c = _C * math.sqrt(r.shape[1])
    return (r.square() / ((r.square() + c**2).sqrt() + c)).mean(1)


def absolute(v_t: Tensor, u_t: Tensor) -> Tensor:
    """mean_i |r_i|: its minimum is the median of each element."""
    return (v_t.float() - u_t.float()).abs().flatten(1).mean(1)


LOSSES: Registry[_Loss] = Registry(
    "loss",
    mse=mse,
    pseudo_huber=pseudo_huber,
    pseudo_huber_elementwise=pseudo_huber_elementwise,
    absolute=absolute,
)
