"""Stop of a run by a signal: writes a checkpoint and exits; SLURM requeues the job first."""

import logging
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import lightning as L
from lightning.fabric.plugins.environments import LightningEnvironment
from lightning.pytorch.utilities import rank_zero_only

from r2flow.base.registry import Count
from r2flow.base.signals import (
    LATER,
    STOPPING,
    Stopped,
    code_of,
    handling_signals,
    install_handlers,
    wait_for_launcher,
)
from r2flow.model.paths import checkpoints_of

from .checkpoints import Checkpoints

_log = logging.getLogger(__name__)


class Stopping(L.Callback):
    """On SIGTERM, SIGHUP, Ctrl-C and, in a SLURM job, SIGUSR1: writes a checkpoint after the step
    and raises `Stopped`.

    SLURM sends SIGUSR1 before a time limit: the job is requeued by `scontrol requeue`. Until
    training starts, a run stops at once without a checkpoint; on several machines it ends, since
    Python hears nothing while it waits for them.

    Lightning's handlers exit with code 0, or save from within the signal handler, in the middle of
    a step, to a file that a resumed run ignores; they are therefore replaced when training starts.
    A validation due at the step of the
    stop is skipped: the curves lack a point, the weights are the same.

    Args:
        every: Steps between two checks whether any device received a signal; a single device checks
            every step.
    """

    def __init__(self, every: Count = 10) -> None:
        self.every = every
        self.run_dir = Path()  # of the trainer
        self.job = slurm_job()
        self.received: int | None = None
        self._process = os.getpid()
        self._training = False

    @property
    def signals(self) -> tuple[int, ...]:
        return STOPPING if self.job is None else (*STOPPING, signal.SIGUSR1)

    @contextmanager
    def handling_signals(self) -> Iterator[None]:
        """Context that handles the signals and restores the previous handlers."""
        with handling_signals(self.on_signal, self.signals):
            try:
                yield
            except Exception:
                # Other errors, as of a killed worker, follow from the signal.
                if self.received is None:
                    raise
            if self.received is not None:
                self._leave("stopped")

    def on_signal(self, number: int, frame: FrameType | None = None) -> None:
        if os.getpid() != self._process:  # a loader's worker with an inherited handler
            return
        again = self.received is not None
        self.received = self.received or number
        if not self._training and not again:
            self._leave("stopped")

    def on_train_start(self, trainer, pl_module):
        self._training = True
        self.run_dir = Path(trainer.default_root_dir)
        with suppress(ValueError):  # only the main thread can set handlers
            install_handlers(self.on_signal, self.signals)

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx):
        if (batch_idx + 1) % trainer.accumulate_grad_batches:
            return
        stopped = self.received is not None
        if trainer.world_size > 1:
            if trainer.global_step % self.every:
                return
            stopped = trainer.strategy.reduce_boolean_decision(stopped, all=False)
            for number in self.signals if stopped else ():  # all devices stop for the same signal
                if trainer.strategy.reduce_boolean_decision(self.received == number, all=False):
                    self.received = number
        if stopped and trainer.global_step < trainer.estimated_stepping_batches:
            if trainer.checkpoint_callbacks:
                # A plug-in's own callback does not save where the run stops.
                ours = [c for c in trainer.checkpoint_callbacks if isinstance(c, Checkpoints)]
                next(iter(ours), Checkpoints(keep=sys.maxsize)).save(trainer)
            self._training = False
            # as Lightning does after the callbacks
            trainer._logger_connector.update_train_step_metrics()
            environment = getattr(trainer.strategy, "cluster_environment", None)
            if not trainer.is_global_zero and isinstance(environment, LightningEnvironment):
                wait_for_launcher()
            self._leave(f"stopped at step {trainer.global_step}")

    def on_train_end(self, *given):
        self._training = False

    def on_exception(self, *given):
        self._training = False

    def _leave(self, where: str) -> None:
        assert self.received is not None
        code = code_of(self.received)
        first = getattr(rank_zero_only, "rank", 0) == 0
        if self.received == signal.SIGUSR1:
            code = LATER
            if first:
                _log.info("%s; scontrol requeue %s", where, self.job)
                try:
                    subprocess.run(["scontrol", "requeue", str(self.job)], check=True)
                except (OSError, subprocess.CalledProcessError) as error:
                    raise Stopped(
                        2,
                        f"error: {where}, but SLURM did not take job {self.job} back ({error}). "
                        "Submit the same script again.",
                    ) from None
        consequence = "starts it again: no checkpoint yet"
        if checkpoints_of(self.run_dir):
            consequence = "resumes from the last checkpoint"
        raise Stopped(code, f"{where}; the same command {consequence}" if first else "") from None


def slurm_job() -> str | None:
    """ID of this process's batch job, as used by `scontrol`, or None.

    A run in an interactive shell on a node does not count, since it must not be requeued.
    """
    job = os.environ.get("SLURM_JOB_ID")
    if job is None or os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive"):
        return None
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    return job if array is None else f"{array}_{os.environ['SLURM_ARRAY_TASK_ID']}"
