"""SLURM's time limit: a checkpoint, the job back in the queue, the end."""

import logging
import os
import signal
import subprocess
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L
from lightning.pytorch.utilities import rank_zero_only

from r2flow.checkpoints import FOLDER, checkpoints_of
from r2flow.errors import InputError

log = logging.getLogger(__name__)

LEFT = 75  # exit code, "try again later" among the system's: not 0, which a chain would take for a finished link


class Requeue(L.Callback):
    """On SIGUSR1 in a SLURM job: a regular checkpoint at the end of the step, `scontrol requeue`, and the end.

    Before the first step, while pairs are drawn, there is nothing to save and the end is at once.

    Lightning's own way saves from within the signal handler, in the middle of a step, to a file beside the run's
    checkpoints which is never removed and which a resumption passes over. A handler that is there before Lightning
    looks keeps it from setting its own.

    Args:
        run_dir: The run's folder.
        every: Steps between two questions to all devices whether one of them was told to leave; a single device
            asks itself at every step.

    Raises:
        InputError: `every` is below 1.
    """

    def __init__(self, run_dir: str | Path, every: int = 10) -> None:
        if every < 1:
            raise InputError(f"callbacks.requeue.every must be at least 1, found {every}.")
        self.run_dir, self.every = Path(run_dir), every
        self.job = slurm_job()
        self._process = os.getpid()
        self._asked = self._training = False
        # From here on, not from `setup`: in another callback's, pairs may be drawn for hours.
        self._before: Any = None if self.job is None else signal.signal(signal.SIGUSR1, self._hear)

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if os.getpid() != self._process:  # a loader's worker, which has inherited the handler
            return
        self._asked = True
        if not self._training:
            self._leave("before the first step")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._training = True

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self.job is None or (batch_idx + 1) % trainer.accumulate_grad_batches:
            return
        asked = self._asked
        if trainer.world_size > 1:
            if trainer.global_step % self.every:
                return
            asked = trainer.strategy.reduce_boolean_decision(asked, all=False)
        if asked:
            trainer.save_checkpoint(self.run_dir / FOLDER / f"step-{trainer.global_step:08d}.ckpt")
            self._keep_two(trainer)
            self._leave(f"step {trainer.global_step} saved")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._training = False
        if self.job is not None:
            self._keep_two(trainer)

    def _keep_two(self, trainer: L.Trainer) -> None:
        """What is saved here, the callback that saves regularly does not know of and would leave behind."""
        if trainer.is_global_zero:
            for old in checkpoints_of(self.run_dir)[2:]:
                old.unlink(missing_ok=True)

    def _leave(self, where: str) -> None:
        if getattr(rank_zero_only, "rank", 0) == 0:
            assert self.job is not None
            log.info("%s; scontrol requeue %s", where, self.job)
            try:
                subprocess.run(["scontrol", "requeue", self.job], check=True)
            except (OSError, subprocess.CalledProcessError) as error:
                raise InputError(
                    f"{where}, but SLURM did not take job {self.job} back ({error}). Submit the same script again."
                ) from None
        raise SystemExit(LEFT)

    def teardown(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        if self._before is not None:
            signal.signal(signal.SIGUSR1, self._before)
            self._before = None


def slurm_job() -> str | None:
    """The batch job that this process is part of, as `scontrol` calls it, or None.

    A run inside somebody's interactive shell on a node is not a job to be queued again.
    """
    job = os.environ.get("SLURM_JOB_ID")
    if job is None or os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive"):
        return None
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    return job if array is None else f"{array}_{os.environ['SLURM_ARRAY_TASK_ID']}"
