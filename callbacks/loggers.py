"""Loggers of a run's curves and pictures, by name: `loggers=[csv,wandb]`.

Credentials are read from a service's environment variables only (WANDB_API_KEY,
MLFLOW_TRACKING_URI), never from a config, which the run's folder and its checkpoints store.
"""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import (
    CSVLogger,
    Logger,
    MLFlowLogger,
    TensorBoardLogger,
    WandbLogger,
)

from r2flow.base.errors import InputError, one_line, require
from r2flow.base.registry import Options, Registry

_PROJECT = "r2flow"


def _by_age(folder: Path, pattern: str) -> list[Path]:
    return sorted(folder.glob(pattern), key=lambda path: path.stat().st_mtime)


def _wandb(run_dir: Path) -> Logger:
    """W&B logger; resumes the run of an existing folder `run-DATE-ID`."""
    require("loggers=[wandb]", "wandb", "wandb")
    folders = _by_age(run_dir / "wandb", "*run-*-*")
    run_id = folders[-1].name.rsplit("-", 1)[1] if folders else None
    return WandbLogger(name=run_dir.name, save_dir=run_dir, project=_PROJECT, id=run_id)


def _mlflow(run_dir: Path) -> Logger:
    """MLflow logger at MLFLOW_TRACKING_URI, else in the run's folder, where it resumes an existing
    run.
    """
    require("loggers=[mlflow]", "mlflow", "mlflow")
    uri = os.environ.get("MLFLOW_TRACKING_URI")
    run_id = None
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # otherwise a folder is refused
    if uri is None or uri in _STORES:
        store = run_dir.absolute() / "mlruns"
        uri = store.as_uri()
        # MLflow writes it into the environment, which the next run of this process reads.
        _STORES.add(uri)
        files = _by_age(store, "*/*/meta.yaml")
        run_id = files[-1].parent.name if files else None
    try:
        return MLFlowLogger(_PROJECT, run_dir.name, uri, run_id=run_id)
    except Exception as error:  # as of a scheme that it does not know
        raise InputError(f"loggers=[mlflow]: {one_line(str(error))}") from error


_STORES: set[str] = set()

LOGGERS: Registry[Callable[[Path], Logger]] = Registry(
    "logger",
    csv=lambda run_dir: CSVLogger(run_dir, name="metrics"),
    tensorboard=lambda run_dir: TensorBoardLogger(
        run_dir, name="tensorboard", version="", default_hp_metric=False
    ),
    wandb=_wandb,
    mlflow=_mlflow,
)

# Functions that log a picture, (H, W, 3) uint8, by class of logger; other loggers do not take
# pictures.
_PICTURES: dict[type, Callable[[Any, str, np.ndarray, int], None]] = {
    TensorBoardLogger: lambda log, name, pixels, step: log.experiment.add_image(
        name, pixels, step, dataformats="HWC"
    ),
    WandbLogger: lambda log, name, pixels, step: log.log_image(name, [pixels], step),
    MLFlowLogger: lambda log, name, pixels, step: log.experiment.log_image(
        log.run_id, pixels, key=name, step=step
    ),
}


class LearningRates(LearningRateMonitor):
    """Logs the learning rates of each optimiser step, and keeps the loggers' count of steps."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if batch_idx % trainer.accumulate_grad_batches == 0:
            # Lightning counts one step too many after a stop by `trainer.max_time` at the step of a
            # validation.
            trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step
            super().on_train_batch_start(trainer, pl_module, batch, batch_idx)


def log_picture(loggers: Iterable[Logger], name: str, pixels: np.ndarray, step: int) -> None:
    """Log a picture, (H, W, 3) uint8, to every logger that takes pictures."""
    for logger in loggers:
        if type(logger) in _PICTURES:
            _PICTURES[type(logger)](logger, name, pixels, step)


def log_config(loggers: Iterable[Logger], config: Options) -> None:
    """Log a run's config to the loggers outside its folder."""
    for logger in loggers:
        try:
            if isinstance(logger, MLFlowLogger):
                # Parameters of a resumed run cannot be changed.
                if not logger.experiment.get_run(logger.run_id).data.params:
                    logger.log_hyperparams(dict(config))
            elif isinstance(logger, WandbLogger):
                logger.log_hyperparams(dict(config))
        except Exception as error:  # of many kinds, as without a key or a connection
            raise InputError(f"{type(logger).__name__}: {one_line(str(error))}") from error
