"""Where a run's curves and pictures go, by name: `loggers=[csv,wandb]`.

What a service needs to know of its user stands in its own environment variables (WANDB_API_KEY, MLFLOW_TRACKING_URI),
never in a config, which is kept in the run's folder and its checkpoints.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.pytorch.loggers import CSVLogger, Logger, MLFlowLogger, TensorBoardLogger, WandbLogger

from r2flow.errors import InputError, require
from r2flow.registry import Registry

PROJECT = "r2flow"
Picture = Callable[[Any, str, np.ndarray, int], None]


def _csv(run_dir: Path) -> Logger:
    return CSVLogger(run_dir, name="metrics")


def _tensorboard(run_dir: Path) -> Logger:
    return TensorBoardLogger(run_dir, name="tensorboard", version="", default_hp_metric=False)


def _wandb(run_dir: Path) -> Logger:
    """W&B, which names a folder of a run `run-DATE-ID`: the same run resumes where there is one."""
    require("loggers=[wandb]", "wandb", "wandb")
    before = sorted((run_dir / "wandb").glob("*run-*-*"), key=lambda folder: folder.stat().st_mtime)
    run_id = before[-1].name.rsplit("-", 1)[1] if before else None
    return WandbLogger(name=run_dir.name, save_dir=run_dir, project=PROJECT, id=run_id)


def _mlflow(run_dir: Path) -> Logger:
    """MLflow at MLFLOW_TRACKING_URI, else in the run's folder, where the same run goes on."""
    require("loggers=[mlflow]", "mlflow", "mlflow")
    uri, run_id = os.environ.get("MLFLOW_TRACKING_URI"), None
    if uri is None or uri in _STORES:
        store = run_dir.absolute() / "mlruns"
        uri = store.as_uri()
        _STORES.add(uri)  # MLflow writes it into the environment, where the next run of this process would find it
        os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")  # it would rather have a data base
        before = sorted(store.glob("*/*/meta.yaml"), key=lambda file: file.stat().st_mtime)
        run_id = before[-1].parent.name if before else None
    return MLFlowLogger(PROJECT, run_dir.name, uri, run_id=run_id)


_STORES: set[str] = set()

LOGGERS: Registry[Callable[[Path], Logger]] = Registry(
    "logger", csv=_csv, tensorboard=_tensorboard, wandb=_wandb, mlflow=_mlflow
)

# How a kind of logger takes a picture, (H, W, 3) uint8; the others take none.
PICTURES: dict[type, Picture] = {
    TensorBoardLogger: lambda log, name, pixels, step: log.experiment.add_image(name, pixels, step, dataformats="HWC"),
    WandbLogger: lambda log, name, pixels, step: log.log_image(name, [pixels], step),
    MLFlowLogger: lambda log, name, pixels, step: log.experiment.log_image(log.run_id, pixels, key=name, step=step),
}
ELSEWHERE = (WandbLogger, MLFlowLogger)  # they may be looked at where the run's folder is not


def build_loggers(names: Sequence[str] | None, run_dir: Path) -> list[Logger]:
    """The loggers of a run."""
    if isinstance(names, str):
        raise InputError(f"loggers must be a list, found {names!r}; write loggers=[{names}].")
    return [LOGGERS[name](run_dir) for name in names or []]


def log_picture(loggers: Iterable[Logger], name: str, pixels: np.ndarray, step: int) -> None:
    """A picture, (H, W, 3) uint8, to every logger that takes one."""
    for logger in loggers:
        if type(logger) in PICTURES:
            PICTURES[type(logger)](logger, name, pixels, step)


def log_config(loggers: Iterable[Logger], config: Mapping[str, Any]) -> None:
    """A run's config, to the loggers that are not in its folder."""
    for logger in loggers:
        if isinstance(logger, MLFlowLogger) and logger.experiment.get_run(logger.run_id).data.params:
            continue  # they cannot be changed when a run resumes
        if isinstance(logger, ELSEWHERE):
            logger.log_hyperparams(dict(config))


def log_figures(loggers: Iterable[Logger], run_dir: Path, step: int) -> None:
    """The loss curve and the samples of a run that has ended, to the loggers that are not in its folder."""
    from matplotlib.image import imread

    there = [logger for logger in loggers if isinstance(logger, ELSEWHERE)]
    for path in (run_dir / "loss.png", run_dir / "samples" / "samples.png"):
        if there and path.is_file():
            log_picture(there, path.stem, np.round(255 * imread(path)[..., :3]).astype(np.uint8), step)
