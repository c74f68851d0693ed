"""GAN losses and R1, and schedules: learning rates, weight average, warm-up."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from r2flow.registry import Natural, NonNegative, Portion
from r2flow.systems.gan.layers import DROPPED, Filter


def generator_loss(fake: Tensor) -> Tensor:
    """mean softplus(-D(G(z))) (Goodfellow et al. 2014, section 3, the non-saturating form)."""
    return softplus(-fake).mean()


def discriminator_loss(real: Tensor, fake: Tensor) -> Tensor:
    """mean softplus(-D(x)) + mean softplus(D(G(z))) (Goodfellow et al. 2014, eq. 1, as a loss)."""
    return softplus(-real).mean() + softplus(fake).mean()


def r1(scores: Tensor, x: Tensor) -> Tensor:
    """mean over images x of |dD/dx|^2, from scores D(x) (Mescheder et al. 2018, eq. 9, without its gamma / 2).

    x, (B, C, H, W), must require a gradient, and the scores have their graph.
    """
    (gradient,) = torch.autograd.grad(scores.sum(), x, create_graph=True)
    return gradient.square().flatten(1).sum(1).mean()


def half_life_decay(step: int, batch_size: int, half_life: float, rampup: float) -> float:
    """Decay of the generator's average after step 1, 2, ...: 2^(-B / h), h = min(half_life, rampup B step).

    Half of the average is from the last h images. h grows with the images seen, so that the average is not that of an
    untrained generator; the first step all but copies the weights (Karras et al. 2020, StyleGAN2-ADA, appendix B).
    """
    images = min(half_life, rampup * batch_size * step)
    return 0.5 ** (batch_size / images) if images > 0 else 0.0


def lazy_adam(learning_rate: float, betas: tuple[float, float], every: int) -> tuple[float, tuple[float, float]]:
    """Adam's learning rate and betas with an additional penalty step every `every` steps.

    With c = every / (every + 1): c times the rate, and betas to the power of c (Karras et al. 2020, StyleGAN2,
    appendix B). 0 for no such steps.
    """
    c = every / (every + 1) if every else 1.0
    return c * learning_rate, (betas[0] ** c, betas[1] ** c)


@dataclass(frozen=True)
class Warmup:
    """Decreasing degradation of the discriminator's inputs: dropped pixels and blur.

    Attributes:
        images: Images seen until nothing is changed any more; 0 for no warm-up.
        dropout: Share of dropped pixels at the start.
        blur: sigma of the blur at the start, in pixels.
    """

    images: Natural = 200_000
    dropout: Portion = 0.5
    blur: NonNegative = 0.0

    def left(self, images: int) -> float:
        """1 at the start, 0 from `images` on, linear between."""
        return max(1 - images / self.images, 0.0) if self.images else 0.0

    def __call__(self, x: Tensor, images: int, uniform: Tensor | None) -> Tensor:
        """Degrade x (B, C, H, W) in model space, after a number of images of the run.

        `uniform` has each value's draw in [0, 1); None is enough once the warm-up is over.
        """
        left = self.left(images)
        x = blurred(x, self.blur * left)
        if uniform is None or self.dropout * left == 0:
            return x
        return torch.where(uniform < 1 - self.dropout * left, x, DROPPED)


def blurred(x: Tensor, sigma: float) -> Tensor:
    """x filtered by 2^(-(k / sigma)^2), |k| <= floor(3 sigma), over its sum (Karras et al. 2021, StyleGAN3).

    Circular in azimuth, the edge rows repeated.
    """
    reach = math.floor(3 * sigma)
    if reach == 0:
        return x
    taps = torch.exp2(-((torch.arange(-reach, reach + 1) / sigma) ** 2))
    return Filter(taps.tolist()).to(x.device)(x)
