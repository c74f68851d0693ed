"""A ray-drop mask that a gradient passes: Bernoulli draws relaxed by logistic noise."""

import torch
from torch import Tensor

EPS = torch.finfo(torch.float32).eps


def logistic(uniform: Tensor) -> Tensor:
    """log u - log(1 - u): standard logistic noise of u in [0, 1), clamped to [eps, 1 - eps] of float32."""
    u = uniform.clamp(EPS, 1 - EPS)
    return u.log() - torch.log1p(-u)


def straight_through_mask(logit: Tensor, noise: Tensor, temperature: float = 1.0) -> Tensor:
    """m ~ Bernoulli(sigmoid(logit)), 0 or 1, with the gradient of its relaxation s.

    s = sigmoid((logit + noise) / temperature) and m = [s > 1/2] (Maddison et al. 2017, appendix B; Nakashima and
    Kurazume 2021, eq. 4).

    Args:
        logit: Log-odds that a ray returns, (B, 1, H, W).
        noise: `logistic` noise of the same shape.
    """
    soft = torch.sigmoid((logit + noise) / temperature)
    return soft + ((soft > 0.5).to(soft) - soft).detach()
