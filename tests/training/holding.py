"""A plug-in: a run waits at a step, or before the first, until a test has done something to it."""

import time
from pathlib import Path

import lightning as L
from r2flow.callbacks import CALLBACKS, Stopping


class Hold(L.Callback):
    """Writes `file` at the end of a step, 0: before the first, and waits for a signal unless
    `file.go` exists.
    """

    def __init__(self, file: str, step: int = 0, seconds: float = 60.0) -> None:
        self.file, self.step, self.seconds = Path(file), step, seconds

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        if self.step == 0:
            self._wait(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, *_: object) -> None:
        if trainer.global_step == self.step:
            self._wait(trainer)

    def _wait(self, trainer: L.Trainer) -> None:
        go, begin = self.file.with_suffix(".go"), time.monotonic()
        if go.exists():
            return
        self.file.touch()
        (stopping,) = (one for one in trainer.callbacks if isinstance(one, Stopping))
        while stopping.received is None and time.monotonic() - begin < self.seconds:
            time.sleep(0.01)


CALLBACKS.add("hold", Hold)
