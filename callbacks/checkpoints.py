"""Checkpoints during training, written atomically."""

import os
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch.callbacks import Checkpoint

from r2flow.base.errors import InputError
from r2flow.base.files import atomic_write
from r2flow.base.registry import Config, Count
from r2flow.model.paths import FOLDER, checkpoints_of, step_of
from r2flow.model.tensor_files import read_checkpoint


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes Lightning's checkpoints to a temporary file, flushed to disk before it replaces the
    old checkpoint.
    """

    def save_checkpoint(
        self,
        checkpoint: Config,
        path: str | os.PathLike[str],
        storage_options: Any | None = None,
    ) -> None:
        try:
            with atomic_write(Path(path)) as file:
                torch.save(checkpoint, file)
        except (OSError, RuntimeError) as error:
            # torch's writer raises a RuntimeError when the file's write fails.
            cause = error.__context__ if isinstance(error, RuntimeError) else error
            if not isinstance(cause, OSError):
                raise
            kept = "Fix"
            if any(Path(path).parent.glob("step-*.ckpt")):
                kept = "The earlier checkpoints are intact; fix"
            raise InputError(
                f"{path} cannot be written: {cause.strerror or cause}. {kept} this and give the "
                "same command again."
            ) from None

    def load_checkpoint(
        self, path: Any, map_location: Any = "cpu", weights_only: bool | None = None
    ) -> Config:
        # On the CPU, as in Lightning, so that a run can resume without the GPU that it started on.
        checkpoint = read_checkpoint(path, map_location or "cpu")
        # Lightning's timer would resume with its time used up; trainer.max_time applies to each
        # command.
        states = checkpoint.get("callbacks") or {}
        checkpoint["callbacks"] = {n: states[n] for n in states if not n.startswith("Timer")}
        return checkpoint


class Checkpoints(Checkpoint):
    """A checkpoint every `every` steps and one at the last step; the newest `keep` remain.

    They are `checkpoints/step-XXXXXXXX.ckpt` in the trainer's `default_root_dir`.
    """

    def __init__(self, every: Count = 100, keep: Count = 2) -> None:
        self.every = every
        self.keep = keep
        self._saved = 0
        self._stop = False

    def on_train_batch_end(self, trainer, *given):
        *_, batch_idx = given
        stepped = (batch_idx + 1) % trainer.accumulate_grad_batches == 0
        stop = self._stop or trainer.should_stop  # after a whole step: no run can resume within one
        trainer.should_stop = stop and stepped
        self._stop = stop and not stepped
        if stepped and trainer.global_step % self.every == 0:
            self.save(trainer)

    def on_train_epoch_end(self, trainer, pl_module):
        if trainer.should_stop or trainer.global_step >= trainer.estimated_stepping_batches:
            self.save(trainer)

    def save(self, trainer: L.Trainer) -> None:
        """Save the current step, and delete old checkpoints."""
        step = trainer.global_step
        if step == self._saved:
            return
        self._saved = step
        run = trainer.default_root_dir
        trainer.save_checkpoint(Path(run, FOLDER, f"step-{step:08d}.ckpt"), weights_only=False)
        if not trainer.is_global_zero:
            return
        for path in checkpoints_of(run):
            if step_of(path) > step:  # damaged: the run could not resume from it
                path.rename(path.with_suffix(".damaged"))
        for old in checkpoints_of(run)[self.keep :]:
            old.unlink(missing_ok=True)
