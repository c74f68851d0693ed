"""Pictures of samples while a flow is trained."""

from pathlib import Path

import lightning as L
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from r2flow.generators import Generator
from r2flow.sampling import draw

from .ema import averaged_weights


class SamplePictures(L.Callback):
    """Every `every` steps, and at the end: a few scans from fixed noise, to the run's folder and TensorBoard.

    The noise is the same every time, so that the pictures show one set of scans getting sharper.

    Args:
        folder: Where `step-XXXXXXXX.png` goes.
        every: Steps between two pictures; 0 leaves them out.
        num: Scans a picture.
        steps: Steps a scan; None for the generator's own sampler.
    """

    def __init__(
        self, folder: str | Path, seed: int, every: int = 1000, num: int = 4, steps: int | None = None
    ) -> None:
        self.folder, self.seed = Path(folder), seed
        self.every, self.num, self.steps = every, num, steps

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        step = trainer.global_step
        due = self.every > 0 and step > 0 and (step % self.every == 0 or step == trainer.max_steps)
        path = self.folder / f"step-{step:08d}.png"
        # Under accumulation a step lasts several batches: the first one that ends it draws.
        if due and trainer.is_global_zero and not path.exists():
            self._draw(trainer, pl_module, path)

    def _draw(self, trainer: L.Trainer, pl_module: L.LightningModule, path: Path) -> None:
        from r2flow.reports.pictures import contact_sheet, figure_pixels, save_figure

        generator: Generator = pl_module.generator  # type: ignore[assignment]
        training = pl_module.training
        with averaged_weights(trainer, pl_module), torch.no_grad():
            pl_module.eval()
            drawn = draw(generator, range(self.num), self.seed, generator.sampler.changed(steps=self.steps))
            pl_module.train(training)
        images = list(drawn.images.numpy())
        figure = contact_sheet(images, generator.space.sensor.rays(), [f"step {trainer.global_step}"])
        save_figure(figure, path)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                pixels: np.ndarray = figure_pixels(figure)
                logger.experiment.add_image("samples", pixels, trainer.global_step, dataformats="HWC")
