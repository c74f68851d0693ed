"""A reconstruction that a discriminator sharpens (Esser et al. 2021, "Taming transformers", section 3.1)."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

Mean = Callable[[Tensor], Tensor]


def hinge_loss(real: Tensor, fake: Tensor) -> Tensor:
    """(mean max(0, 1 - real) + mean max(0, 1 + fake)) / 2 of the discriminator's scores."""
    return (F.relu(1 - real).mean() + F.relu(1 + fake).mean()) / 2


def adaptive_weight(
    reconstruction: Tensor, adversarial: Tensor, last: Tensor, weight: float, mean: Mean = lambda g: g
) -> Tensor:
    """weight |grad R| / (|grad A| + 1e-4), at most 1e4 weight: the adversarial loss A then pulls as hard as the
    reconstruction R does at the decoder's last weights (eq. 7).

    Args:
        last: These weights.
        mean: Of a gradient over all processes.
    """
    toward, against = (
        mean(torch.autograd.grad(loss, last, retain_graph=True)[0]).norm() for loss in (reconstruction, adversarial)
    )
    return weight * (toward / (against + 1e-4)).clamp(0, 1e4).detach()


def reconstruction_loss(x: Tensor, made: Tensor, mask: Tensor | None = None, mask_factor: float = 0.0) -> Tensor:
    """mean |x - made|; with a mask, (mean |x - made| + mask_factor mean |mask - made's last channel|) / 2.

    Args:
        x: Images, (B, C, H, W).
        made: (B, C, H, W), or with a channel more, the mask's.
        mask: (B, 1, H, W), 1 where a ray returns and -1 where it does not.
    """
    error = (x - made[:, : x.shape[1]]).abs().mean()
    if mask is None or not mask_factor:
        return error
    return (error + mask_factor * (mask - made[:, x.shape[1] :]).abs().mean()) / 2


def adversarial_factor(step: int, start: int, inverted: bool = False) -> float:
    """0 before the step `start` and 1 from it on; `inverted`, as LiDM's published code: 1 up to it and 0 after it."""
    return float(step <= start if inverted else step >= start)
