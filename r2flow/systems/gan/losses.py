"""What a generator G and a discriminator D play for: the non-saturating loss, and R1 on real images.

D gives each image one score s = D(x), the logit of "real".
"""

import torch
from torch import Tensor
from torch.nn.functional import softplus


def generator_loss(fake: Tensor) -> Tensor:
    """mean softplus(-D(G(z))) (Goodfellow et al. 2014, section 3, the non-saturating form)."""
    return softplus(-fake).mean()


def discriminator_loss(real: Tensor, fake: Tensor) -> Tensor:
    """mean softplus(-D(x)) + mean softplus(D(G(z))) (Goodfellow et al. 2014, eq. 1, as a loss)."""
    return softplus(-real).mean() + softplus(fake).mean()


def r1(scores: Tensor, x: Tensor) -> Tensor:
    """mean over images of |dD/dx|^2 (Mescheder et al. 2018, eq. 9, without its weight gamma / 2).

    Args:
        scores: D(x), any shape with B elements, with its graph.
        x: Real images, (B, C, H, W), that require a gradient.
    """
    (gradient,) = torch.autograd.grad(scores.sum(), x, create_graph=True)
    return gradient.square().flatten(1).sum(1).mean()
