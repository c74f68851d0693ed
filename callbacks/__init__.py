"""Callbacks of a run, as part of the package r2flow."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from lightning.pytorch.callbacks import Callback, EarlyStopping, GradientAccumulationScheduler

from r2flow.errors import check
from r2flow.registry import Registry, construct
from r2flow.runs.lineage import drawn_by

from .checkpoints import Checkpoints
from .curvature import Curvature
from .ema import EMA, HalfLifeEMA
from .guard import Guard
from .loggers import LearningRates
from .periodic import SamplePictures
from .progress import Progress
from .reflow_pairs import ReflowPairs
from .stopping import Stopping


class Entry(NamedTuple):
    """Constructor of a callback, and its positional arguments from a config."""

    constructor: Callable[..., Any]
    given: Callable[[Mapping[str, Any]], tuple[Any, ...]] = lambda config: ()


def build_callbacks(config: Mapping[str, Any]) -> list[Callback]:
    """Build the callbacks of a config's `callbacks`; null disables one."""
    if config["trainer"]["fast_dev_run"]:
        return [Progress()] if config["trainer"]["enable_progress_bar"] else []
    for name in config["callbacks"]:
        CALLBACKS[name]
    keys = {"checkpoint": "enable_checkpointing", "progress": "enable_progress_bar"}
    off = {name for name, key in keys.items() if not config["trainer"][key]}
    wanted = {name: options for name, options in config["callbacks"].items() if options is not None and name not in off}
    averages = "callbacks.ema and callbacks.half_life_ema"
    both = {"ema", "half_life_ema"} <= wanted.keys()
    check(not both, f"a run keeps one average of its weights, found {averages}; leave one out, as callbacks.ema=null.")
    built: list[Callback] = []
    for name, registered in CALLBACKS.items():
        if name in wanted:
            entry = registered if isinstance(registered, Entry) else Entry(registered)  # a class, as from a plug-in
            made = construct(f"callbacks.{name}", entry.constructor, wanted[name], *entry.given(config))
            check(isinstance(made, Callback), f"callbacks.{name} must make a Lightning callback, found {made!r}.")
            built.append(made)
    for kind, instead in (
        (GradientAccumulationScheduler, "trainer.accumulate_grad_batches"),  # the loader needs one number
        (EarlyStopping, "callbacks.checkpoint.keep: runs end at trainer.max_steps; take the file of least val/loss"),
    ):
        check(not any(isinstance(one, kind) for one in built), f"leave the {kind.__name__} out, and give {instead}.")
    if config["loggers"]:
        built.append(LearningRates("step"))
    return sorted(built, key=lambda one: isinstance(one, Stopping))  # it saves the state of all others, plug-ins' too


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
    checkpoint=Entry(Checkpoints, lambda config: (config["run_dir"],)),
    progress=Entry(Progress),
)

if __name__ != "r2flow.callbacks":  # callbacks look up each other by class, and a second copy has other classes
    raise ImportError("import r2flow.callbacks, not callbacks: the folder is part of the package r2flow.")
