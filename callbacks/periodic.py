"""Callbacks that act every so many steps, and pictures of samples."""

from abc import ABC, abstractmethod
from pathlib import Path

import lightning as L
import torch

from r2flow.base.registry import Count, Natural
from r2flow.generators import Generator, Sampler
from r2flow.model.sampling import draw
from r2flow.reports.figures import figure_pixels, save_figure
from r2flow.reports.pictures import contact_sheet

from .ema import averaged_weights
from .loggers import log_picture


class Periodic(L.Callback, ABC):
    """Calls `act` every `every` steps and at the end, in the first process, with averaged weights
    in eval mode.

    Args:
        every: Steps between two calls; 0 for none.
    """

    def __init__(self, every: int) -> None:
        self.every = every
        self._last = 0

    @abstractmethod
    def act(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Action of a subclass."""

    def on_train_start(self, trainer, pl_module):
        self._last = trainer.global_step  # a resumed run has already acted at this step

    def on_train_batch_end(self, trainer, pl_module, *given):
        if self.every and trainer.global_step % self.every == 0:
            self.on_train_end(trainer, pl_module)

    def on_train_end(self, trainer, pl_module):
        """Act at this step, unless it was done: with gradient accumulation a step spans several
        batches.
        """
        done = trainer.global_step in (0, self._last)
        if done or not self.every or not trainer.is_global_zero:
            return
        self._last = trainer.global_step
        training = pl_module.training
        with averaged_weights(trainer, pl_module), torch.no_grad():
            pl_module.eval()
            self.act(trainer, pl_module)
            pl_module.train(training)


def seed_of(module: L.LightningModule) -> int:
    """The seed of a stage; 0 of other modules."""
    return int(getattr(module, "seed", 0))


class SamplePictures(Periodic):
    """Draws a few scans, always from the same noise, into the run's folder and its loggers.

    They are `pictures/step-XXXXXXXX.png` in the trainer's `default_root_dir`.

    Args:
        every: Steps between two pictures; 0 for none.
        num: Scans per picture.
        steps: Steps per scan; None: the generator's default sampler.
    """

    def __init__(self, every: Natural = 500, num: Count = 4, steps: Count | None = None) -> None:
        super().__init__(every)
        self.num = num
        self.steps = steps

    def sampler(self, generator: Generator) -> Sampler:
        """The sampler of the pictures; refuses `steps` that the generator does not take."""
        return generator.choose(steps=None if generator.fixed else self.steps)

    def check(self, generator: Generator) -> None:
        """Refuse `steps` that the generator of a run does not take."""
        if self.every and generator.unconditional:
            self.sampler(generator)

    def setup(self, trainer, pl_module, stage):
        generator: Generator = pl_module.generator
        self.check(generator)

    def act(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        step = trainer.global_step
        path = Path(trainer.default_root_dir, "pictures", f"step-{step:08d}.png")
        generator: Generator = pl_module.generator  # type: ignore[assignment]
        if path.exists() or not generator.unconditional:
            return
        drawn = draw(generator, range(self.num), seed_of(pl_module), self.sampler(generator))
        figure = contact_sheet(
            list(drawn.images.numpy()), generator.space.sensor.rays(), [f"step {step}"]
        )
        save_figure(figure, path)
        log_picture(trainer.loggers, "samples", figure_pixels(figure), step)
