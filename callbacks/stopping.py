"""A run that is told to stop: a checkpoint, one line, the end; under SLURM the job goes back into the queue first."""

import logging
import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import lightning as L
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.pytorch.utilities import rank_zero_only

from r2flow.errors import InputError
from r2flow.model.checkpoint import FOLDER, checkpoints_of
from r2flow.registry import Count
from r2flow.signals import LATER, STOPPING, Stopped, code_of, listening, outlive_parent

log = logging.getLogger(__name__)


class Stopping(L.Callback):
    """On SIGTERM, Ctrl-C and, in a SLURM job, SIGUSR1: a checkpoint at the end of the step, and `Stopped`.

    SIGUSR1 is SLURM's word before a time limit: the job is queued again by `scontrol requeue`. While scans are read or
    pairs drawn there is nothing to save, and the end is at once.

    Lightning's own ways end a run with exit code 0, or save from within the signal handler, in the middle of a step, to
    a file that a resumption passes over; so its handlers are replaced when training starts. A validation
    that is due at the step at which a run is stopped is left out: its curves lack a point, its weights are the same.

    Args:
        run_dir: The run's folder.
        every: Steps between two questions to all devices whether one of them was told to stop; a single device
            asks itself at every step.
    """

    def __init__(self, run_dir: str | Path, every: Count = 10) -> None:
        self.run_dir, self.every = Path(run_dir), every
        self.job = slurm_job()
        self.told: int | None = None
        self._process = os.getpid()
        self._training = False

    @property
    def signals(self) -> tuple[int, ...]:
        return STOPPING if self.job is None else (*STOPPING, signal.SIGUSR1)

    @contextmanager
    def listening(self) -> Iterator[None]:
        """Hear the signals for the length of a block, and leave their handlers afterwards as they were.

        Raises:
            Stopped: one came.
        """
        with listening(self.hear, self.signals):
            try:
                yield
            except Exception:
                if self.told is None:
                    raise
                self._leave("stopped")  # what else went wrong then, as a killed worker, is the signal's doing
            if self.told is not None:
                self._leave("stopped")

    def hear(self, number: int, frame: FrameType | None = None) -> None:
        if os.getpid() != self._process:  # a loader's worker, which has inherited the handler
            return
        again = self.told is not None
        self.told = self.told or number
        if not self._training and not again:
            self._leave("stopped")

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._training = True
        for number in self.signals:
            if signal.getsignal(number) is not signal.SIG_IGN:
                try:
                    signal.signal(number, self.hear)
                except ValueError:  # not the main thread, which alone hears signals
                    return

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if (batch_idx + 1) % trainer.accumulate_grad_batches:
            return
        told = self.told is not None
        if trainer.world_size > 1:
            if trainer.global_step % self.every:
                return
            told = trainer.strategy.reduce_boolean_decision(told, all=False)
            for number in self.signals if told else ():  # all leave for the same reason
                if trainer.strategy.reduce_boolean_decision(self.told == number, all=False):
                    self.told = number
        if told and trainer.global_step < trainer.max_steps:
            if trainer.checkpoint_callbacks:
                trainer.save_checkpoint(
                    self.run_dir / FOLDER / f"step-{trainer.global_step:08d}.ckpt", weights_only=False
                )
                self._keep_two(trainer)
            self._training = False
            environment = getattr(trainer.strategy, "cluster_environment", None)
            if not trainer.is_global_zero and isinstance(environment, LightningEnvironment):
                outlive_parent()
            self._leave(f"stopped at step {trainer.global_step}")

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._training = False
        self._keep_two(trainer)

    def on_exception(self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException) -> None:
        self._training = False

    def _keep_two(self, trainer: L.Trainer) -> None:
        """What is saved here, the callback that saves regularly does not know of and would leave behind."""
        if trainer.is_global_zero:
            for old in checkpoints_of(self.run_dir)[2:]:
                old.unlink(missing_ok=True)

    def _leave(self, where: str) -> None:
        assert self.told is not None
        code, first = code_of(self.told), getattr(rank_zero_only, "rank", 0) == 0
        if self.told == signal.SIGUSR1:
            code = LATER
            if first:
                self._requeue(where)
        begun = bool(checkpoints_of(self.run_dir))
        kept = "resumes from the last checkpoint" if begun else "starts it again: no checkpoint yet"
        raise Stopped(code, f"{where}; the same command {kept}" if first else "") from None

    def _requeue(self, where: str) -> None:
        assert self.job is not None
        log.info("%s; scontrol requeue %s", where, self.job)
        try:
            subprocess.run(["scontrol", "requeue", self.job], check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise InputError(
                f"{where}, but SLURM did not take job {self.job} back ({error}). Submit the same script again."
            ) from None


def slurm_job() -> str | None:
    """The batch job that this process is part of, as `scontrol` calls it, or None.

    A run inside somebody's interactive shell on a node is not a job to be queued again.
    """
    job = os.environ.get("SLURM_JOB_ID")
    if job is None or os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive"):
        return None
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    return job if array is None else f"{array}_{os.environ['SLURM_ARRAY_TASK_ID']}"
