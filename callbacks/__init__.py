"""What happens during a run, and when; what it does is r2flow's."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.callbacks import Callback, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from callbacks.ema import EMA
from callbacks.pictures import SamplePictures
from callbacks.progress import Progress
from r2flow.checkpoints import FOLDER
from r2flow.errors import InputError
from r2flow.registry import Registry, check_options
from r2flow.stages import Parts


def build_callbacks(config: Mapping[str, Any], parts: Parts) -> list[Callback]:
    """The callbacks that a config's `callbacks` names; null leaves one out."""
    run_dir = Path(config["run_dir"])
    if config["trainer"]["fast_dev_run"]:
        return [Progress()] if config["trainer"]["enable_progress_bar"] else []
    wanted = {name: options for name, options in (config["callbacks"] or {}).items() if options is not None}
    built: list[Callback] = []
    if "ema" in wanted:
        check_options("callbacks.ema", EMA, wanted["ema"])
        at_least_one("callbacks.ema.every", wanted["ema"].get("every", 1))
        built.append(EMA(**wanted["ema"]))
    if "pictures" in wanted:
        check_options("callbacks.pictures", SamplePictures, wanted["pictures"], given=4)
        folder = run_dir / "pictures"
        pictures = SamplePictures(folder, parts.sensor, parts.encoding, config["seed"], **wanted["pictures"])
        built.append(pictures)
    if "checkpoint" in wanted and config["trainer"]["enable_checkpointing"]:
        check_options("callbacks.checkpoint", keep_checkpoints, wanted["checkpoint"], given=1)
        at_least_one("callbacks.checkpoint.every", wanted["checkpoint"].get("every", 1))
        built += keep_checkpoints(run_dir / FOLDER, **wanted["checkpoint"])
    if "progress" in wanted and config["trainer"]["enable_progress_bar"]:
        built.append(Progress(**wanted["progress"]))
    if config["loggers"]:
        built.append(LearningRateMonitor("step"))
    return built


def at_least_one(key: str, value: int) -> None:
    """Refuse a period of no steps."""
    if value < 1:
        raise InputError(f"{key} must be at least 1, found {value}.")


def keep_checkpoints(folder: Path, every: int = 1000) -> list[Callback]:
    """A checkpoint every `every` steps and one at the last step; the newest two are kept."""
    common: dict[str, Any] = {
        "dirpath": folder,
        "filename": "step-{step:08d}",
        "auto_insert_metric_name": False,
        "enable_version_counter": False,
        "monitor": "step",  # the largest step is the best: keeps the newest
        "mode": "max",
    }
    regular = ModelCheckpoint(every_n_train_steps=every, save_top_k=2, **common)
    final = ModelCheckpoint(every_n_epochs=1, save_on_train_epoch_end=True, save_top_k=1, **common)
    return [regular, final]


def _csv(run_dir: Path) -> Logger:
    return CSVLogger(run_dir, name="metrics")


def _tensorboard(run_dir: Path) -> Logger:
    return TensorBoardLogger(run_dir, name="tensorboard", version="", default_hp_metric=False)


LOGGERS = Registry("logger", csv=_csv, tensorboard=_tensorboard)


def build_loggers(names: Sequence[str] | None, run_dir: Path) -> list[Logger]:
    """CSV and TensorBoard logs below the run's folder."""
    if isinstance(names, str):
        raise InputError(f"loggers must be a list, found {names!r}; write loggers=[{names}].")
    return [LOGGERS[name](run_dir) for name in names or []]


__all__ = ["EMA", "Progress", "SamplePictures", "build_callbacks", "build_loggers", "keep_checkpoints"]
