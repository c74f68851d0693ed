"""Pictures of samples while a flow is trained."""

from pathlib import Path

import lightning as L
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from r2flow.flow.solvers import solve
from r2flow.lidar.encoding import Encoding
from r2flow.lidar.sensors import Sensor
from r2flow.sampling import noise_of

from .ema import averaged_weights


class SamplePictures(L.Callback):
    """Every `every` steps, and at the end: a few scans from fixed noise, to the run's folder and TensorBoard.

    The noise is the same every time, so that the pictures show one set of scans getting sharper.

    Args:
        folder: Where `step-XXXXXXXX.png` goes.
        every: Steps between two pictures; 0 leaves them out.
        num: Scans a picture.
        steps: Euler steps a scan.
    """

    def __init__(
        self,
        folder: str | Path,
        sensor: Sensor,
        encoding: Encoding,
        seed: int,
        every: int = 1000,
        num: int = 4,
        steps: int = 16,
    ) -> None:
        self.folder, self.sensor, self.encoding, self.seed = Path(folder), sensor, encoding, seed
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

        shape = self.encoding.shape
        x_0 = noise_of(range(self.num), shape, self.seed).to(pl_module.device)
        training = pl_module.training
        with averaged_weights(trainer, pl_module), torch.no_grad():
            pl_module.eval()
            end = solve(pl_module.velocity, x_0, steps=self.steps)  # type: ignore[arg-type]
            pl_module.train(training)
        images = list(self.encoding.decode(end.x.cpu()).numpy())
        figure = contact_sheet(images, self.sensor.rays(), [f"step {trainer.global_step}"])
        save_figure(figure, path)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                pixels: np.ndarray = figure_pixels(figure)
                logger.experiment.add_image("samples", pixels, trainer.global_step, dataformats="HWC")
