"""Training API: build and fit what a config describes.

    from r2flow.training import build, compose, fit

    result = fit(build(compose(["data=kitti_raw", "data.root=FOLDER", "trainer.max_steps=1000"])))
    result.metrics["val/loss"], result.checkpoint

A `Run` holds a stage, a `ScanDataModule` and a Trainer, which `fit` gives to `trainer.fit`. The
same command, or the same config, resumes from the last checkpoint.
"""

import logging
import re
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from signal import SIG_DFL
from subprocess import Popen, TimeoutExpired

import lightning as L
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.utilities.model_helpers import is_overridden

from r2flow.base.config import as_override
from r2flow.base.errors import InputError, one_line
from r2flow.base.files import check_folder
from r2flow.base.signals import (
    LATER,
    STOPPING,
    Stopped,
    handling_signals,
    stop_with_torchrun,
)
from r2flow.callbacks.loggers import log_config
from r2flow.callbacks.stopping import Stopping
from r2flow.model.config import RunConfig
from r2flow.model.paths import checkpoints_of, step_of
from r2flow.reports.training import finish, read_curves
from r2flow.runs.building import Run, build, check, quiet
from r2flow.runs.composing import compose
from r2flow.runs.folder import has_ended, open_run, run_lock

__all__ = ["Result", "Run", "RunConfig", "build", "check", "compose", "fit"]

_log = logging.getLogger("r2flow")

# Errors of gloo and NCCL after a peer process has ended.
_PEER_LOST = (
    r"(?i)connection .*(close|reset)|broken pipe|process exited|gloo.*"
    r"(timed out|(read|write) error)|NCCL"
)


@dataclass(frozen=True)
class Result:
    """Result of a run."""

    metrics: dict[str, float]  #: the last logged value of each metric, as `train/loss`
    checkpoint: Path | None  #: the last checkpoint, or None
    folder: Path
    step: int  #: total number of optimiser steps
    finished: bool  #: whether the run reached its end; `trainer.max_time` can stop it earlier


def fit(run: Run) -> Result:
    """Train a run in its folder, resuming from its last checkpoint, and draw its samples.

    SIGTERM, SIGHUP and Ctrl-C stop it after the current step, with a checkpoint; before the first
    step, at once.

    Raises:
        InputError: unreadable scans, another run in its folder, non-finite weights, a full disk.
        r2flow.base.signals.Stopped: a stop signal was received, or another device's process was
            killed.
    """
    callbacks: list[L.Callback] = run.trainer.callbacks  # type: ignore[attr-defined]
    stopping = next(
        (callback for callback in callbacks if isinstance(callback, Stopping)), Stopping()
    )
    stopping.run_dir = run.folder
    stop_with_torchrun()
    first = run.trainer.is_global_zero
    with stopping.handling_signals(), quiet(repeated=False):  # each trains on scans of its own
        if run.config.trainer.fast_dev_run:
            run.trainer.fit(run.stage, run.data)
            return _result(run, run.trainer.global_step, finished=True)
        with quiet():
            run.data.setup()
            run.config = replace(run.config, scans=run.data.fingerprint())
            _log.info("training on %s", run.data.summary())
            if first and not run.folder.exists():
                check_folder(run.folder)
                run.data.read()  # a bad scan leaves no folder
        with run_lock(run.folder) if first else nullcontext():
            # Python hears no signal while it waits for other machines; from its first step on,
            # `Stopping` does.
            with handling_signals(SIG_DFL, STOPPING if run.trainer.num_nodes > 1 else ()):
                step = _fit_in_folder(run, stopping)
            kept = bool(run.trainer.checkpoint_callbacks)
            finished = not kept or has_ended(run.folder)
            if first:
                where = run.trainer.strategy.root_device
                device = str(where) if where.type == "cuda" else "cpu"
                num = run.config.samples.num
                finish(run.folder, num, run.config.seed, device, finished, kept=kept)
    return _result(run, step, finished)


def _fit_in_folder(run: Run, stopping: Stopping) -> int:
    first = run.trainer.is_global_zero
    last = open_run(run.folder, run.config.plain(), locked=first)
    if last is not None and has_ended(run.folder, last):
        if first:
            parent = as_override("stage.parent", run.folder)
            print(f"finished before, at step {step_of(last)}; to learn more: {parent} name=OTHER")
        return step_of(last)  # no training, no pairs
    with quiet():
        run.data.read()
        if last is not None:
            _log.info("resuming from %s", last)
    if first:
        log_config(run.trainer.loggers, run.config.plain())
    try:
        validates = is_overridden("validation_step", run.stage)
        if last is None and run.stage.parent and validates:
            # What the end of the run is compared with.
            run.trainer.validate(run.stage, run.data, verbose=False)
        run.trainer.fit(run.stage, run.data, ckpt_path=last, weights_only=True)
    except (MisconfigurationException, ValueError) as error:
        # As of limit_val_batches, with few scans.
        lightnings = isinstance(error, MisconfigurationException) or re.search(
            "(?i)trainer|val_check", str(error)
        )
        if isinstance(error, InputError) or not lightnings:
            raise
        raise InputError(f"trainer: {one_line(str(error))}") from None
    except RuntimeError as error:
        if isinstance(cause := error.__context__, OSError) and re.search(
            "combined_loader|Too many open", str(error)
        ):
            raise cause from None
        if (
            run.trainer.world_size > 1
            and stopping.received is None
            and re.search(_PEER_LOST, str(error))
        ):
            if any(map(_failed, getattr(run.trainer.strategy.launcher, "procs", ()))):
                raise InputError(
                    "a process of this run on another device ended with an error."
                ) from error
            raise Stopped(
                LATER, "a process of this run on another device ended; the same command resumes."
            ) from error
        raise
    return run.trainer.global_step


def _failed(process: Popen[bytes]) -> bool:
    """Whether a process has ended with an error of its own; a process that hangs has not."""
    with suppress(TimeoutExpired):
        return process.wait(10) in (1, 2)
    return False


def _result(run: Run, step: int, finished: bool) -> Result:
    logged = {name: float(values[-1]) for name, (_, values) in read_curves(run.folder).items()}
    measured = {name: float(value) for name, value in run.trainer.callback_metrics.items()}
    return Result(
        logged | measured, next(iter(checkpoints_of(run.folder)), None), run.folder, step, finished
    )
