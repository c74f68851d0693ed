"""Exponential moving averages of the weights."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor

from r2flow.base.registry import Count, Natural, Portion, Positive, Registry

# Decays, at most `decay`, of n = 1, 2, ..., the steps after the warm-up, during which it is 0.
_DECAYS: Registry[Callable[[int], float]] = Registry(
    "decay of the average",
    power=lambda n: 1 - n ** (-2 / 3),
    constant=lambda n: 1.0,  # LiDARGen
    ratio=lambda n: (1 + n) / (10 + n),  # LiDM
)


class EMA(WeightAveraging):
    """Exponential moving average of the weights, for validation, pictures and checkpoints.

    Every `every` steps: average <- decay average + (1 - decay) weights. A run that ends before the
    first update after the warm-up keeps its raw weights as the average.

    Args:
        decay: Highest decay.
        rule: Decay schedule, `power`, `constant` or `ratio`; the last two are meant for every=1.
        every: Steps between two updates.
        warmup_steps: Steps during which the average copies the weights; None: the stage's
            learning-rate warm-up.
    """

    def __init__(
        self,
        decay: Portion = 0.995,
        every: Count = 2,
        warmup_steps: Natural | None = None,
        rule: str = "power",
    ) -> None:
        # Buffers are not averaged: most are constants (ray angles, frequencies), the others
        # counters.
        super().__init__(use_buffers=False, avg_fn=self._average)
        self.decay = decay
        self.every = every
        self.warmup_steps = warmup_steps
        _DECAYS[rule]  # refuses an unknown name
        self.rule = rule  # a function without a name cannot be pickled
        self._step = 0
        self._end: float = -1
        self._copies = False

    def _decay(self) -> float:
        """Decay after step `_step`, counted from 0."""
        n = self._step + 1 - (self.warmup_steps or 0)
        return 0.0 if self._copies or n < 1 else min(self.decay, _DECAYS[self.rule](n))

    def _average(self, average: Tensor, weight: Tensor, updates: Any) -> Tensor:
        return average.lerp(weight, 1 - self._decay())

    def should_update(self, step_idx: int | None = None, epoch_idx: int | None = None) -> bool:
        if step_idx is None:
            return False
        self._step = step_idx
        before = step_idx - step_idx % self.every  # the last regular update
        self._copies = step_idx == self._end and before <= (self.warmup_steps or 0)
        return before == step_idx or self._copies

    def setup(self, trainer, pl_module, stage):
        self._device = trainer.strategy.root_device  # the module moves there later
        # As the strategy does later: the average has its type.
        trainer.precision_plugin.convert_module(pl_module)
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:
            # At 0 the base class copies the weights, whatever the rule.
            self._average_model.n_averaged.fill_(1)

    def on_train_start(self, trainer, pl_module):
        self._end = trainer.estimated_stepping_batches - 1
        if self.warmup_steps is None:
            images = getattr(pl_module, "warmup_images", 0)
            self.warmup_steps = images and images // pl_module.images_per_step


def half_life_decay(step: int, batch_size: int, half_life: float, rampup: float) -> float:
    """Decay of the generator's average after step 1, 2, ...: 2^(-B / h), h = min(half_life, rampup
    B step).

    Half of the average is from the last h images. h grows with the images seen, so that the average
    is not that of an untrained generator; the first step all but copies the weights (Karras et al.
    2020, StyleGAN2-ADA, appendix B).
    """
    images = min(half_life, rampup * batch_size * step)
    return 0.5 ** (batch_size / images) if images > 0 else 0.0


class HalfLifeEMA(EMA):
    """EMA of a GAN's generator, updated every step: its half-life is `half_life` images, or a share
    `rampup` of the images seen so far if that is less (`half_life_decay`).

    Args:
        half_life: Half-life in images.
        rampup: Upper limit of the half-life, as a share of the images seen.
    """

    def __init__(self, half_life: Positive = 10_000.0, rampup: Positive = 0.05) -> None:
        super().__init__(every=1, warmup_steps=0)
        self.half_life = half_life
        self.rampup = rampup

    def on_train_start(self, trainer, pl_module):
        super().on_train_start(trainer, pl_module)
        self.batch_size: Any = pl_module.images_per_step

    def _decay(self) -> float:
        return half_life_decay(self._step + 1, self.batch_size, self.half_life, self.rampup)


@contextmanager
def averaged_weights(trainer: L.Trainer, pl_module: L.LightningModule) -> Iterator[None]:
    """Context with the averaged weights in the module, if the run has an `EMA`; else with the raw
    weights.
    """
    averages = [c for c in trainer.callbacks if isinstance(c, EMA)]  # type: ignore[attr-defined]
    for average in averages:
        average.on_validation_epoch_start(trainer, pl_module)
    try:
        yield
    finally:
        for average in averages:
            average.on_validation_epoch_end(trainer, pl_module)
