"""Pictures of samples during training."""

from pathlib import Path

import lightning as L

from r2flow.generators import Generator
from r2flow.model.sampling import draw
from r2flow.registry import Count, Natural

from .loggers import log_picture
from .periodic import Periodic


class SamplePictures(Periodic):
    """Draws a few scans, always from the same noise, into the run's folder and its loggers.

    Args:
        folder: Folder of `step-XXXXXXXX.png`.
        every: Steps between two pictures; 0 for none.
        num: Scans per picture.
        steps: Steps per scan; None: the generator's default sampler.
    """

    def __init__(
        self, folder: str | Path, seed: int, every: Natural = 500, num: Count = 4, steps: Count | None = None
    ) -> None:
        super().__init__(every)
        self.folder, self.seed, self.num, self.steps = Path(folder), seed, num, steps

    def act(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        from r2flow.reports.pictures import contact_sheet, figure_pixels, save_figure

        step, path = trainer.global_step, self.folder / f"step-{trainer.global_step:08d}.png"
        generator: Generator = pl_module.generator  # type: ignore[assignment]
        if path.exists() or not generator.draws:
            return
        steps = None if generator.fixed else self.steps
        drawn = draw(generator, range(self.num), self.seed, generator.choose(steps=steps))
        figure = contact_sheet(list(drawn.images.numpy()), generator.space.sensor.rays(), [f"step {step}"])
        save_figure(figure, path)
        log_picture(trainer.loggers, "samples", figure_pixels(figure), step)
