"""Callbacks of a run, as part of the package r2flow."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from lightning.pytorch.callbacks import Callback, GradientAccumulationScheduler, LearningRateMonitor, ModelCheckpoint

from r2flow.errors import InputError
from r2flow.model.checkpoint import FOLDER
from r2flow.registry import Count, Registry, check_options
from r2flow.runs.lineage import drawn_by

from .curvature import Curvature
from .ema import EMA, HalfLifeEMA
from .guard import Guard
from .pictures import SamplePictures
from .progress import Progress
from .reflow_pairs import ReflowPairs
from .stopping import Stopping


class Entry(NamedTuple):
    """Constructor of a callback, or of a list of callbacks, and its positional arguments from a config."""

    constructor: Callable[..., Any]
    given: Callable[[Mapping[str, Any]], tuple[Any, ...]] = lambda config: ()


def build_callbacks(config: Mapping[str, Any]) -> list[Callback]:
    """Build the callbacks of a config's `callbacks`; null disables one."""
    if config["trainer"]["fast_dev_run"]:
        return [Progress()] if config["trainer"]["enable_progress_bar"] else []
    for name in config["callbacks"]:
        CALLBACKS[name]
    wanted = {name: options for name, options in config["callbacks"].items() if options is not None}
    if {"ema", "half_life_ema"} <= wanted.keys():
        raise InputError(
            "a run keeps one average of its weights, found callbacks.ema and callbacks.half_life_ema; leave one out, "
            "as callbacks.ema=null."
        )
    for name, key in (("checkpoint", "enable_checkpointing"), ("progress", "enable_progress_bar")):
        if not config["trainer"][key]:
            wanted.pop(name, None)
    built: list[Callback] = []
    for name, registered in CALLBACKS.items():
        if name in wanted:
            entry = registered if isinstance(registered, Entry) else Entry(registered)  # a class, as from a plug-in
            given = entry.given(config)
            check_options(f"callbacks.{name}", entry.constructor, wanted[name], given=len(given))
            callback = entry.constructor(*given, **wanted[name])
            built += callback if isinstance(callback, list) else [callback]
    if any(isinstance(callback, GradientAccumulationScheduler) for callback in built):  # the loader needs one number
        raise InputError("leave the GradientAccumulationScheduler out, and give trainer.accumulate_grad_batches.")
    if config["loggers"]:
        built.append(LearningRateMonitor("step"))
    return built


class Newest(ModelCheckpoint):
    """A ModelCheckpoint that can resume with a smaller `save_top_k`."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        super().load_state_dict(state_dict)
        newest = sorted(self.best_k_models.items(), key=lambda item: item[1])[-self.save_top_k :]
        self.best_k_models, self.kth_best_model_path = dict(newest), newest[0][0] if newest else ""


def keep_checkpoints(folder: Path, every: Count = 100, keep: Count = 2) -> list[Callback]:
    """A checkpoint every `every` steps and one at the last step; the newest `keep` remain."""
    common: dict[str, Any] = {
        "dirpath": folder,
        "filename": "step-{step:08d}",
        "auto_insert_metric_name": False,
        "enable_version_counter": False,
        "monitor": "step",  # the largest step counts as the best: keeps the newest
        "mode": "max",
    }
    # Without save_on_train_epoch_end, the checkpoint of the last step would wait for a validation that may not happen,
    # and one checkpoint too many would remain.
    regular = Newest(every_n_train_steps=every, save_top_k=keep, save_on_train_epoch_end=True, **common)
    final = Newest(every_n_epochs=1, save_on_train_epoch_end=True, save_top_k=1, **common)
    return [regular, final]


# In the order of execution.
CALLBACKS = Registry(
    "callback",
    reflow_pairs=Entry(ReflowPairs, lambda config: (drawn_by(config),)),
    ema=Entry(EMA),
    half_life_ema=Entry(HalfLifeEMA, lambda config: (config["data"]["batch_size"],)),
    pictures=Entry(SamplePictures, lambda config: (Path(config["run_dir"], "pictures"), config["seed"])),
    curvature=Entry(Curvature, lambda config: (config["seed"],)),
    guard=Entry(Guard, lambda config: (config["run_dir"],)),
    requeue=Entry(Stopping, lambda config: (config["run_dir"],)),
    checkpoint=Entry(keep_checkpoints, lambda config: (Path(config["run_dir"], FOLDER),)),
    progress=Entry(Progress),
)

if __name__ != "r2flow.callbacks":  # callbacks look up each other by class, and a second copy has other classes
    raise ImportError("import r2flow.callbacks, not callbacks: the folder is part of the package r2flow.")
