"""Training progress, with losses, rate and remaining time."""

import time

from lightning.pytorch.callbacks import ProgressBar

from r2flow.base.progress import Bar
from r2flow.base.registry import NonNegative


class Progress(ProgressBar):
    """A bar of steps with losses and scans per second; a line every `seconds` if standard error is
    not a terminal.
    """

    def __init__(self, seconds: NonNegative = 15.0) -> None:
        super().__init__()
        self.seconds = seconds
        self.is_enabled = True
        self._total = 0
        self._bar: Bar | None = None
        self._noted = 0.0

    def disable(self) -> None:
        self.is_enabled = False

    def on_train_start(self, trainer, pl_module):
        steps = trainer.estimated_stepping_batches
        self._total = int(steps) if steps < float("inf") else 0
        self._bar = Bar(
            "training", self._total, "steps", None if self.is_enabled else False, every=self.seconds
        )
        self._bar.live.transient = False
        self._bar.start()
        self._bar.set(trainer.global_step)

    def on_train_batch_end(self, trainer, *given):
        assert self._bar is not None
        if trainer.global_step == self._bar.tasks[0].completed:
            return  # within a step: the losses are those of a part of its batch
        if trainer.global_step == self._total:
            self._noted = self._bar.every = 0.0  # the last figures are always written
        note = None
        now = time.monotonic()
        if now - self._noted >= min(self.seconds, 1):  # reading a loss waits for the GPU
            self._noted = now
            shown = trainer.progress_bar_metrics  # logged with prog_bar=True
            notes = [f"{key.removeprefix('train/')} {value:.4f}" for key, value in shown.items()]
            data = getattr(trainer, "datamodule", None)
            rate = (self._bar.tasks[0].speed or 0.0) * int(getattr(data, "batch_size", 1))
            # In a narrow terminal the time left would be cut.
            if rate and (self._bar.disable or self._bar.console.width >= 100):
                notes.append(f"{rate:.1f} scans/s")
            note = "  ".join(notes)
        self._bar.set(trainer.global_step, note)

    def on_train_end(self, trainer, *given):
        if self._bar is not None:
            self._bar.stop()

    def on_exception(self, trainer, *given):
        self.on_train_end(trainer)
