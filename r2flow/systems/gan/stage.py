"""Training of GANs: losses, R1, learning rates, warm-up, and the stage."""

import math
from dataclasses import dataclass
from typing import Any, Unpack

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from r2flow.base.registry import (
    Count,
    Natural,
    NonNegative,
    Options,
    Portion,
    Registry,
    construct,
)
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    Betas,
    ModelArguments,
    SensorLike,
    Stage,
)
from r2flow.systems.gan import dcgan, style_discriminator
from r2flow.systems.gan.augment import AdaptiveAugment, BatchDraws
from r2flow.systems.gan.generator import Gan
from r2flow.systems.gan.layers import DROPPED, Filter


def _generator_loss(fake: Tensor) -> Tensor:
    """mean softplus(-D(G(z))) (Goodfellow et al. 2014, section 3, the non-saturating form)."""
    return softplus(-fake).mean()


def _discriminator_loss(real: Tensor, fake: Tensor) -> Tensor:
    """mean softplus(-D(x)) + mean softplus(D(G(z))) (Goodfellow et al. 2014, eq. 1, as a loss)."""
    return softplus(-real).mean() + softplus(fake).mean()


def r1(scores: Tensor, x: Tensor) -> Tensor:
    """mean over images x of |dD/dx|^2, from scores D(x) (Mescheder et al. 2018, eq. 9, without its
    gamma / 2).

    x, (B, C, H, W), must require a gradient, and the scores have their graph.
    """
    (gradient,) = torch.autograd.grad(scores.sum(), x, create_graph=True)
    return gradient.square().flatten(1).sum(1).mean()


def _lazy_adam(
    learning_rate: float, betas: tuple[float, float], every: int
) -> tuple[float, tuple[float, float]]:
    """Adam's learning rate and betas with an additional penalty step every `every` steps.

    With c = every / (every + 1): c times the rate, and betas to the power of c (Karras et al. 2020,
    StyleGAN2, appendix B). 0 for no such steps.
    """
    c = every / (every + 1) if every else 1.0
    return c * learning_rate, (betas[0] ** c, betas[1] ** c)


@dataclass(frozen=True)
class Warmup:
    """Decreasing degradation of the discriminator's inputs: dropped pixels and blur."""

    images: Natural = 200_000  # seen until nothing is changed any more; 0 for no warm-up
    dropout: Portion = 0.5  # share of dropped pixels at the start
    blur: NonNegative = 0.0  # sigma of the blur at the start, in pixels

    def left(self, images: int) -> float:
        """1 at the start, 0 from `images` on, linear between."""
        return max(1 - images / self.images, 0.0) if self.images else 0.0

    def __call__(self, x: Tensor, images: int, uniform: Tensor | None) -> Tensor:
        """Degrade x (B, C, H, W) in model space, after a number of images of the run.

        `uniform` has each value's draw in [0, 1); None is enough once the warm-up is over.
        """
        left = self.left(images)
        x = _blurred(x, self.blur * left)
        if uniform is None:
            return x
        return torch.where(uniform < 1 - self.dropout * left, x, DROPPED)


def _blurred(x: Tensor, sigma: float) -> Tensor:
    """x filtered by 2^(-(k / sigma)^2), |k| <= floor(3 sigma), over its sum.

    Circular in azimuth, the edge rows repeated (Karras et al. 2021, StyleGAN3).
    """
    reach = math.floor(3 * sigma)
    if reach == 0:
        return x
    window = torch.exp2(-((torch.arange(-reach, reach + 1) / sigma) ** 2))
    return Filter(window.tolist()).to(x.device)(x)


_DISCRIMINATORS = Registry(
    "discriminator", dcgan=dcgan.Discriminator, style_gan=style_discriminator.Discriminator
)


_ALL_DEFAULTS: Options = {}

# Parts of a step, with separate random draws per image.
_GENERATOR, _FAKE, _REAL, _PENALTY = 1, 2, 3, 4


class LearnGan(Stage):
    """Alternating steps of G and D (on new G(z) and scans), and a step of R1 every `r1_every`
    steps.

    All that D sees is warmed up (`Warmup`) and augmented (`AdaptiveAugment`). Both learn by Adam at
    a constant rate (`_lazy_adam` for D). The loss is the non-saturating one; R1's weight is r1
    r1_every / 2, which makes up for the steps without it. The recipe is DUSty v2's. The log has the
    probability of augmentation after each step (`train/augmented`) and R1 when it was last measured
    (`train/last_r1`).

    Args:
        discriminator: Name and options, as `{name: style_gan, base_channels: 32}`.
        r1: gamma of R1; 0 for none.
        r1_every: Steps between two of R1.
        warmup: Options of `Warmup`.
        augment: Options of `AdaptiveAugment`, without any its defaults; None: no augmentation.
    """

    learns = Gan
    generator: Gan

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        discriminator: str | Options = "dcgan",
        r1: NonNegative = 1.0,
        r1_every: Count = 16,
        warmup: Options | None = None,
        augment: Options | None = _ALL_DEFAULTS,
        learning_rate: NonNegative = 2e-3,
        betas: Betas = (0.0, 0.99),
        **options: Unpack[ModelArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            learning_rate=learning_rate,
            betas=betas,
            warmup_images=0,
            **options,
        )
        self.automatic_optimization = False
        self.r1 = r1
        self.r1_every = r1_every
        self.last_r1: Tensor | None = None
        channels, *shape = self.space.shape
        self.discriminator: nn.Module = _DISCRIMINATORS.build(discriminator, shape, channels)
        self.warmup = construct("stage.warmup", Warmup, warmup)
        self.augment = None
        if augment is not None:
            self.augment = construct("stage.augment", AdaptiveAugment, augment)

    def configure_optimizers(self) -> Any:
        lazy = _lazy_adam(self.learning_rate, self.betas, self.r1_every if self.r1 else 0)
        return [
            torch.optim.Adam(self.generator.parameters(), self.learning_rate, self.betas),
            torch.optim.Adam(self.discriminator.parameters(), *lazy),
        ]

    def training_step(self, batch: Batch, batch_idx: int) -> None:
        step = self.global_step + 1  # counted from 1, as published
        for_generator, for_discriminator = self.own_optimizers()
        images = step * self.images_per_step
        real = batch["x_1"]

        def drawn(part: int) -> BatchDraws:
            return BatchDraws(self.seed, batch, part)

        draws = drawn(_GENERATOR)
        self.discriminator.requires_grad_(False)
        shown = self._shown(self._make(batch["x_0"], draws), images, draws)
        loss = _generator_loss(self.discriminator(shown))
        self.take_step(for_generator, loss)
        self.discriminator.requires_grad_(True)

        draws = drawn(_FAKE)
        with torch.no_grad():
            z = draws.normal(*self.generator.noise_shape).to(real.device)
            fake = self._shown(self._make(z, draws), images, draws)
            seen = self._shown(real, images, drawn(_REAL))
        of_real = self.discriminator(seen)
        wrong = _discriminator_loss(of_real, self.discriminator(fake))
        self.take_step(for_discriminator, wrong)

        if self.r1 and step % self.r1_every == 0:
            penalty = self._penalty(real, images, drawn(_PENALTY))
            self.take_step(for_discriminator, self.r1 * self.r1_every / 2 * penalty)
            self.last_r1 = penalty.detach()
        if self.last_r1 is not None:
            self.log("train/last_r1", self.last_r1, sync_dist=True)
        if self.augment is not None:
            self.augment.count(of_real)
            if self.augment.every and step % self.augment.every == 0:
                self.augment.move()
            self.log("train/augmented", self.augment.p)
        self.log("train/loss", loss, prog_bar=True, sync_dist=True)
        self.log("train/discriminator", wrong, prog_bar=True, sync_dist=True)

    def _make(self, z: Tensor, draws: BatchDraws) -> Tensor:
        """G(z), (B, C, H, W), with random mask and rotation."""
        gan = self.generator
        uniform = draws.uniform(1, *gan.space.shape[1:]).to(z.device) if gan.drops else None
        shift = None if gan.angle is None else draws.uniform().to(z.device)
        return gan.made(z, uniform, shift=shift)["image"]

    def _shown(self, x: Tensor, images: int, draws: BatchDraws) -> Tensor:
        """Input x of D after a number of images of the run."""
        uniform = None
        if self.warmup.left(images):
            uniform = draws.uniform(*x.shape[1:]).to(x.device)
        x = self.warmup(x, images, uniform)
        return x if self.augment is None else self.augment(x, self.augment.draw(draws))

    def _penalty(self, real: Tensor, images: int, draws: BatchDraws) -> Tensor:
        """R1 with gradients by the scans, through warm-up and augmentation, in float32."""
        with torch.autocast(real.device.type, enabled=False):
            x = real.detach().requires_grad_()
            return r1(self.discriminator(self._shown(x, images, draws)), x)
