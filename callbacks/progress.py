"""Training progress, with rate and remaining time."""

import math
import sys
import time
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import RichProgressBar

from r2flow.progress import duration
from r2flow.registry import NonNegative


class Progress(RichProgressBar):
    """Lightning's rich bar with scans per second; a line every `seconds` if standard output is not a terminal."""

    def __init__(self, seconds: NonNegative = 15.0) -> None:
        super().__init__(leave=True)
        self.seconds = seconds
        self._begin = -math.inf, 0  # time and step at which the run (re)started
        self._last_line = 0.0
        self._watched = sys.stdout.isatty()
        if not self._watched:
            self.disable()

    def _get_train_description(self, current_epoch: int) -> str:
        return "training"  # the base class counts epochs, but a run is one epoch

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self._begin = (time.monotonic(), trainer.global_step)
        self._last_line = time.monotonic()
        self._print(trainer, "begins")  # the first step of a large network can take minutes

    def _print(self, trainer: L.Trainer, text: str) -> None:
        if not self._watched and trainer.is_global_zero:
            print(f"step {trainer.global_step}/{trainer.max_steps}  {text}", flush=True)

    def _rate(self, trainer: L.Trainer) -> float:
        """Scans per second since the run (re)started."""
        seconds, steps = time.monotonic() - self._begin[0], trainer.global_step - self._begin[1]
        return steps * int(getattr(trainer.datamodule, "batch_size", 1)) / max(seconds, 1e-9)  # type: ignore[attr-defined]

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        items: dict[str, Any] = super().get_metrics(trainer, pl_module)
        items.pop("v_num", None)
        items["scans/s"] = f"{self._rate(trainer):.1f}"
        return items

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        now = time.monotonic()
        if trainer.global_step < trainer.max_steps and now - self._last_line < self.seconds:
            return
        self._last_line = now
        per_step = (now - self._begin[0]) / max(trainer.global_step - self._begin[1], 1)
        left = duration((trainer.max_steps - trainer.global_step) * per_step)
        loss = float(trainer.callback_metrics.get("train/loss", math.nan))
        self._print(trainer, f"loss {loss:.4f}  {self._rate(trainer):.1f} scans/s  {left} left")

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        super().on_validation_end(trainer, pl_module)
        if not trainer.sanity_checking and (loss := trainer.callback_metrics.get("val/loss")) is not None:
            self._print(trainer, f"val/loss {float(loss):.4f}")
