"""Loggers of a run's curves and pictures, by name: `loggers=[csv,wandb]`.

Credentials are read from a service's environment variables only (WANDB_API_KEY,
MLFLOW_TRACKING_URI), never from a config, which the run's folder and its checkpoints store.
"""

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.loggers import (
    CSVLogger,
    Logger,
    MLFlowLogger,
    TensorBoardLogger,
    WandbLogger,
)
from matplotlib.image import imread

from r2flow.errors import InputError, require
from r2flow.registry import Registry

PROJECT = "r2flow"


def _wandb(run_dir: Path) -> Logger:
    """W&B logger; resumes the run of an existing folder `run-DATE-ID`."""
    require("loggers=[wandb]", "wandb", "wandb")
    folders = sorted(
        (run_dir / "wandb").glob("*run-*-*"), key=lambda folder: folder.stat().st_mtime
    )
    run_id = folders[-1].name.rsplit("-", 1)[1] if folders else None
    return WandbLogger(name=run_dir.name, save_dir=run_dir, project=PROJECT, id=run_id)


def _mlflow(run_dir: Path) -> Logger:
    """MLflow logger at MLFLOW_TRACKING_URI, else in the run's folder, where it resumes an existing
    run.
    """
    require("loggers=[mlflow]", "mlflow", "mlflow")
    uri, run_id = os.environ.get("MLFLOW_TRACKING_URI"), None
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # otherwise a folder is refused
    if uri is None or uri in _STORES:
        store = run_dir.absolute() / "mlruns"
        uri = store.as_uri()
        _STORES.add(
            uri
        )  # MLflow writes it into the environment, which the next run of this process reads
        files = sorted(store.glob("*/*/meta.yaml"), key=lambda file: file.stat().st_mtime)
        run_id = files[-1].parent.name if files else None
    try:
        return MLFlowLogger(PROJECT, run_dir.name, uri, run_id=run_id)
    except Exception as error:  # as of a scheme that it does not know
        raise InputError(f"loggers=[mlflow]: {' '.join(str(error).split())[:300]}") from error


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
PICTURES: dict[type, Callable[[Any, str, np.ndarray, int], None]] = {
    TensorBoardLogger: lambda log, name, pixels, step: log.experiment.add_image(
        name, pixels, step, dataformats="HWC"
    ),
    WandbLogger: lambda log, name, pixels, step: log.log_image(name, [pixels], step),
    MLFlowLogger: lambda log, name, pixels, step: log.experiment.log_image(
        log.run_id, pixels, key=name, step=step
    ),
}
ELSEWHERE = (WandbLogger, MLFlowLogger)  # may be viewed without access to the run's folder


class LearningRates(LearningRateMonitor):
    """Logs the learning rates of each optimiser step, and keeps the loggers' count of steps."""

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        if batch_idx % trainer.accumulate_grad_batches == 0:
            # Lightning counts one step too many after a stop by `trainer.max_time` at the step of a
            # validation.
            trainer.fit_loop.epoch_loop._batches_that_stepped = trainer.global_step
            super().on_train_batch_start(trainer, pl_module, batch, batch_idx)


def log_picture(loggers: Iterable[Logger], name: str, pixels: np.ndarray, step: int) -> None:
    """Log a picture, (H, W, 3) uint8, to every logger that takes pictures."""
    for logger in loggers:
        if type(logger) in PICTURES:
            PICTURES[type(logger)](logger, name, pixels, step)


def log_config(loggers: Iterable[Logger], config: Mapping[str, Any]) -> None:
    """Log a run's config to the loggers outside its folder."""
    for logger in (one for one in loggers if isinstance(one, ELSEWHERE)):
        try:
            if (
                isinstance(logger, MLFlowLogger)
                and logger.experiment.get_run(logger.run_id).data.params
            ):
                continue  # parameters of a resumed run cannot be changed
            logger.log_hyperparams(dict(config))
        except (
            Exception
        ) as error:  # the services raise many kinds, as without a key or a connection
            text = " ".join(str(error).split())[:300]
            raise InputError(f"{type(logger).__name__}: {type(error).__name__}: {text}") from error


def log_figures(loggers: Iterable[Logger], run_dir: Path, step: int) -> None:
    """Log the loss curve and the samples of a finished run to the loggers outside its folder."""
    external = [logger for logger in loggers if isinstance(logger, ELSEWHERE)]
    for path in (run_dir / "loss.png", run_dir / "samples" / "samples.png"):
        if external and path.is_file():
            log_picture(
                external, path.stem, np.round(255 * imread(path)[..., :3]).astype(np.uint8), step
            )
