"""Training progress, with rate and remaining time."""

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
        self._begin: tuple[float, int] | None = None
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
        if not self._watched and trainer.is_global_zero:  # the first step of a large network can take minutes
            print(f"step {trainer.global_step}/{trainer.max_steps}  begins", flush=True)

    def _rate(self, trainer: L.Trainer) -> float:
        """Optimiser steps per second since the run (re)started."""
        if self._begin is None:
            return 0.0
        seconds, step = time.monotonic() - self._begin[0], trainer.global_step - self._begin[1]
        return step / seconds if seconds > 0 else 0.0

    def _scans_per_step(self, trainer: L.Trainer) -> int:
        return int(getattr(trainer.datamodule, "batch_size", 1))  # type: ignore[attr-defined]

    def get_metrics(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, Any]:
        items: dict[str, Any] = super().get_metrics(trainer, pl_module)
        items.pop("v_num", None)
        items["scans/s"] = f"{self._rate(trainer) * self._scans_per_step(trainer):.1f}"
        return items

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        now = time.monotonic()
        last = trainer.global_step >= trainer.max_steps
        if self._watched or not trainer.is_global_zero or not (last or now - self._last_line >= self.seconds):
            return
        self._last_line = now
        rate = self._rate(trainer)
        left = (trainer.max_steps - trainer.global_step) / rate if rate else 0.0
        loss = trainer.callback_metrics.get("train/loss")
        print(
            f"step {trainer.global_step}/{trainer.max_steps}"
            f"  loss {float(loss) if loss is not None else float('nan'):.4f}"
            f"  {rate * self._scans_per_step(trainer):.1f} scans/s  {duration(left)} left",
            flush=True,
        )

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        super().on_validation_end(trainer, pl_module)
        loss = trainer.callback_metrics.get("val/loss")
        if not self._watched and trainer.is_global_zero and loss is not None:
            print(f"step {trainer.global_step}/{trainer.max_steps}  val/loss {float(loss):.4f}", flush=True)
