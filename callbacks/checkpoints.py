"""Checkpoints during training."""

from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import Checkpoint

from r2flow.model.checkpoint import FOLDER, checkpoints_of, step_of
from r2flow.registry import Count


class Checkpoints(Checkpoint):
    """A checkpoint every `every` steps and one at the last step; the newest `keep` remain."""

    def __init__(self, run_dir: str | Path, every: Count = 100, keep: Count = 2) -> None:
        self.run_dir, self.every, self.keep = Path(run_dir), every, keep

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        stepped = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        if stepped and trainer.global_step % self.every == 0:
            self.save(trainer)

    def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.global_step > 0:
            self.save(trainer)

    def save(self, trainer: L.Trainer) -> None:
        """Save the current step, and delete old checkpoints."""
        step = trainer.global_step
        trainer.save_checkpoint(self.run_dir / FOLDER / f"step-{step:08d}.ckpt", weights_only=False)
        if trainer.is_global_zero:
            for path in checkpoints_of(self.run_dir):
                if step_of(path) > step:  # damaged: the run could not resume from it
                    path.rename(path.with_suffix(".damaged"))
            for old in checkpoints_of(self.run_dir)[self.keep :]:
                old.unlink(missing_ok=True)
