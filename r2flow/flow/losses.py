"""Losses of a velocity estimate: each maps (v_t, u_t) of shape (B, ...) to one value per sample, (B,)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from r2flow.registry import Registry

Loss = Callable[[Tensor, Tensor], Tensor]

PSEUDO_HUBER_SCALE = 0.00054  # c = 0.00054 sqrt(d), paper, below eq. 3


def mse(v_t: Tensor, u_t: Tensor) -> Tensor:
    """|v_t - u_t|^2 / d, the conditional flow matching loss (paper, eq. 2) on the scale of one element."""
    return (v_t.float() - u_t.float()).square().flatten(1).mean(1)


def pseudo_huber(v_t: Tensor, u_t: Tensor) -> Tensor:
    """(sqrt(|r|^2 + c^2) - c) / sqrt(d) with r = v_t - u_t, c = 0.00054 sqrt(d): the paper's eq. 3 over sqrt(d).

    The division does not move the minimum and brings gradients to the scale of the other losses; without it they are
    sqrt(d) = 362 times those of the element-wise form, and every gradient would be clipped at 1.
    """
    r = (v_t.float() - u_t.float()).flatten(1)
    d = r.shape[1]
    # vector_norm has gradient 0 at r = 0, where sqrt of a sum of squares has NaN. The scale keeps |r|^2 finite where an
    # element is large; the quotient has no cancellation at small r.
    scale = r.detach().abs().amax(1).clamp(min=1)
    rms = torch.linalg.vector_norm(r / scale[:, None], dim=1) / math.sqrt(d) * scale
    c = torch.full_like(rms, PSEUDO_HUBER_SCALE)
    return rms * (rms / (torch.hypot(rms, c) + c))


def pseudo_huber_elementwise(v_t: Tensor, u_t: Tensor) -> Tensor:
    """mean_i (sqrt(r_i^2 + c^2) - c), c = 0.00054 sqrt(d): what the published weights were trained with."""
    r = (v_t.float() - u_t.float()).flatten(1)
    c = PSEUDO_HUBER_SCALE * math.sqrt(r.shape[1])
    return (r.square() / ((r.square() + c**2).sqrt() + c)).mean(1)


LOSSES: Registry[Loss] = Registry(
    "loss", mse=mse, pseudo_huber=pseudo_huber, pseudo_huber_elementwise=pseudo_huber_elementwise
)
