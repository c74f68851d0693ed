"""Training API: build and fit what a config describes.

    from r2flow.training import build, compose, fit

    result = fit(build(compose(["data=kitti_raw", "data.root=FOLDER", "trainer.max_steps=1000"])))
    result.metrics["val/loss"], result.checkpoint

The same command, or the same config, resumes from the last checkpoint.
"""

import logging
import re
import signal
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from subprocess import Popen, TimeoutExpired
from typing import Annotated, Any, Literal

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Checkpoint, ProgressBar
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.model_helpers import is_overridden

from r2flow.callbacks import SamplePictures, build_callbacks
from r2flow.callbacks.checkpoints import AtomicCheckpointIO
from r2flow.callbacks.loggers import LOGGERS, log_config, log_figures
from r2flow.callbacks.stopping import Stopping
from r2flow.config import as_override, key_of
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.opening import SOURCES, Layout, Prepared
from r2flow.data.options import MIXED, PAIRS, SIMULATED, DataOptions, SourceOptions
from r2flow.data.reading import AUTO
from r2flow.data.resolving import reflectance_levels, resolve, resolve_reflectance
from r2flow.errors import InputError, check_folder, naming
from r2flow.generators import Generator, build_generator
from r2flow.model.checkpoint import checkpoints_of, step_of
from r2flow.noise import seed_torch
from r2flow.plugins import loaded_plugins, made_with
from r2flow.registry import Bound, Count, Natural, NonNegative, Positive, check_options
from r2flow.reports.training import finish, read_curves
from r2flow.runs.composing import Keys, compose
from r2flow.runs.folder import check_run, open_run, read_config, run_lock
from r2flow.runs.lineage import Parent, find_parent, inherit
from r2flow.signals import LATER, STOPPING, Stopped, listening
from r2flow.stages import build_stage
from r2flow.stages.base import Stage

__all__ = ["Result", "Run", "build", "check", "compose", "fit"]

log = logging.getLogger("r2flow")

EXPECTED_WARNINGS = (
    ".*does not have many workers.*",
    "Total length of .list. across ranks is zero.*",
    ".*smaller than the logging interval.*",
    ".*isinstance.treespec, LeafSpec.*",
    "You passed in a .val_dataloader. but have no .validation_step.*",
    "Be aware that when using .ckpt_path.*",  # a callback's options may change
)

# Errors of gloo and NCCL after a peer process has ended.
PEER_LOST = r"(?i)connection .*(close|reset)|broken pipe|process exited|gloo.*(timed out|(read|write) error)|NCCL"


@dataclass(frozen=True)
class SampleOptions:
    """Samples drawn at the end of a run."""

    num: Natural = 4


@dataclass(frozen=True)
class TrainerRanges:
    """Ranges of options of Lightning's Trainer that r2flow's runs support; Lightning itself accepts more."""

    max_steps: Annotated[int, Bound("of 1 to 10^15", lambda n: 1 <= n <= 10**15)]
    min_steps: Natural | None
    max_epochs: Annotated[Literal[-1], Bound("(trainer.max_steps is the length of a run)", lambda n: True)] | None
    max_time: str | Mapping[str, Any] | None
    num_sanity_val_steps: Annotated[int, Bound("of at least -1", lambda n: n >= -1)] | None
    overfit_batches: Annotated[float, Bound("equal to 0 (data.scenes, data.drives choose few scans)", lambda n: n == 0)]
    limit_train_batches: Annotated[None, Bound("(trainer.max_steps is the length of a run)", lambda n: True)]
    val_check_interval: Positive | str | Mapping[str, Any] | None
    check_val_every_n_epoch: Annotated[None, Bound("(a run is one epoch: give val_check_interval)", lambda n: True)]
    use_distributed_sampler: Annotated[Literal[False], Bound("(each device is given its own scans)", lambda n: True)]
    log_every_n_steps: Count
    accumulate_grad_batches: Count
    gradient_clip_val: NonNegative | None


@dataclass
class Run:
    """A run, ready to be fitted."""

    config: dict[str, Any]  #: the complete config, including values from the parent and the data
    stage: Stage  #: the LightningModule, with initial weights
    data: ScanDataModule  #: the DataModule; no scans have been read yet
    trainer: L.Trainer  #: Lightning's Trainer, with callbacks and loggers

    @property
    def folder(self) -> Path:
        """Folder of config, checkpoints, logs and samples."""
        return Path(self.config["run_dir"])


@dataclass(frozen=True)
class Result:
    """Result of a run."""

    metrics: dict[str, float]  #: the last logged value of each metric, as `train/loss`
    checkpoint: Path | None  #: the last checkpoint, or None
    folder: Path
    step: int  #: total number of optimiser steps
    finished: bool  #: whether `trainer.max_steps` was reached; `trainer.max_time` can stop a run earlier


def build(config: Mapping[str, Any], asked: Sequence[str] = ()) -> Run:
    """Build the run of a config, and refuse all errors that can be detected without reading scans.

    Args:
        config: As returned by `compose`.
        asked: Overrides of the command line: only these are refused if they contradict the parent; other keys take the
            parent's values.

    Raises:
        InputError: an invalid value, an unknown name or option, a parent that is missing or not finished.
    """
    check_options("the config", Keys, config)
    if config.get("chain"):
        raise InputError("this config is a chain of runs: train it by `r2flow train`.")
    if config.get("preview"):
        raise InputError("preview is of a chain of runs, such as experiment=demo: leave it out, or give preview=null.")
    with _quiet(), made_with(read_config(config["run_dir"]) or {}, f"the run in {config['run_dir']}"):
        parent = find_parent(config["stage"].get("init"))
        config = _checked(config, asked, parent)
        config["plugins"] = config.get("plugins") or loaded_plugins()
        encoding = config["encoding"]
        encoding["reflectance"] = resolve_reflectance(encoding.get("reflectance", AUTO), config["data"])
        levels = reflectance_levels(config["data"])
        if levels is not None and "encoding.levels" not in map(key_of, asked):
            encoding["levels"] = levels
        seed_torch(config["seed"], "weights")
        generator = build_generator(config)
        if parent and parent.checkpoint:
            generator.start_from(parent.checkpoint.generator)
        return _assembled(config, generator, asked)


def check(config: Mapping[str, Any], asked: Sequence[str] = (), parent: Parent | None = None) -> dict[str, Any]:
    """Check a config by building its run with weights on the meta device; no scans are read, no files written.

    The result is completed with values of its parent; `parent` is one that has not been trained yet.
    """
    check_options("the config", Keys, config)
    config = _checked(config, asked, parent or find_parent(config["stage"].get("init")))
    if config["encoding"].get("reflectance", AUTO) == AUTO:
        config["encoding"]["reflectance"] = True  # decided when the scans are read
    with torch.device("meta"):
        generator = build_generator(config)
    check_run(_assembled(config, generator, asked).folder, config)
    return config


def _checked(config: Mapping[str, Any], asked: Sequence[str], parent: Parent | None) -> dict[str, Any]:
    check_trainer(config["trainer"])
    check_options("samples", SampleOptions, config["samples"])
    with made_with(parent.config if parent else {}, "the run that it starts from"):
        config = inherit(config, asked, parent)
    given = {key_of(text) for text in asked}
    drawn = sorted(key for key in given if f"{key}.".startswith("data.pairs."))
    if drawn and config["data"]["name"] != PAIRS:
        raise InputError(f"data={config['data']['name']} has no pairs (data=pairs has): leave out {', '.join(drawn)}.")
    _refuse_unread(config["data"], given)
    return config


def _refuse_unread(data: Mapping[str, Any], given: Collection[str]) -> None:
    """Refuse options that the run's set of scans would ignore; `resolve` does those of its parts."""
    name, defaults = data["name"], {**asdict(SourceOptions()), **resolve({})}
    options = defaults.keys() - {"name"}
    scenes = {"scenes"} if "data.scenes" in given else set[str]()  # else an experiment's
    if name == SIMULATED:
        what, unread = "simulated scans are not files (data=folder for yours)", options - {"scenes"}
    elif name == PAIRS:
        what, unread = "pairs are drawn, not read", options - {"root", "reading"}
    elif name == MIXED:
        run = DataOptions(**data)
        sets = [one for one in (*run.sets, run.held_out) if one and one.scenes == run.scenes]
        read = any(not isinstance(SOURCES[one.name], Layout | Prepared) for one in sets)
        what, unread = "each of data.parts has its own", {"split", "drives"} | (set() if read else scenes)
    else:
        files = isinstance(SOURCES[name], Layout | Prepared)
        what, unread = "scans in files are no simulated scenes", scenes if files else set()
    if wrong := sorted(f"data.{option}" for option in unread if data.get(option, defaults[option]) != defaults[option]):
        raise InputError(f"{what}: leave {', '.join(wrong)} out.")


def _assembled(config: dict[str, Any], generator: Generator, asked: Sequence[str]) -> Run:
    space = generator.space
    if not hasattr(generator, "backbone"):
        if wrong := [text for text in asked if key_of(text).partition(".")[0] == "backbone"]:
            raise InputError(f"generator {config['generator']['name']} has its own network: leave {wrong[0]} out.")
        config["backbone"] = None
    data = ScanDataModule(space.sensor, space.encoding, config["seed"], generator.noise_shape, **config["data"])
    stage = build_stage(config, generator)
    data.further = stage.further
    trainer = _build_trainer(config, stage)
    data.check_run(trainer.world_size, trainer.accumulate_grad_batches)
    callbacks: list[L.Callback] = trainer.callbacks  # type: ignore[attr-defined]
    for pictures in [one for one in callbacks if isinstance(one, SamplePictures) and one.every and generator.draws]:
        with naming("callbacks.pictures"):
            pictures.sampler(generator)
    return Run(config, stage, data, trainer)


def _build_trainer(config: Mapping[str, Any], stage: Stage) -> L.Trainer:
    options = dict(config["trainer"])
    check_options("trainer", L.Trainer, options)
    if options["accelerator"] == "auto" and not torch.cuda.is_available():
        options["accelerator"] = "cpu"  # Lightning would choose Apple's GPU, which lacks float64
    if not stage.automatic_optimization:  # Lightning leaves these two to the stage
        if options["accumulate_grad_batches"] != 1:
            name = config["stage"]["name"]
            raise InputError(f"stage={name} takes its own optimiser steps: trainer.accumulate_grad_batches must be 1.")
        stage.gradient_clip_val, options["gradient_clip_val"] = options["gradient_clip_val"], None
    if isinstance(interval := options["val_check_interval"], int):  # a short run is validated once, at its end
        options["val_check_interval"] = min(interval, options["max_steps"]) * options["accumulate_grad_batches"]
    callbacks = build_callbacks(config)
    for key, kind in (("enable_checkpointing", Checkpoint), ("enable_progress_bar", ProgressBar)):
        options[key] = bool(options[key]) and any(isinstance(one, kind) for one in callbacks)  # or Lightning adds one
    loggers = [LOGGERS[name](Path(config["run_dir"])) for name in config["loggers"] or ()]
    try:
        with _quiet():
            trainer = L.Trainer(**options, callbacks=callbacks, logger=loggers, plugins=[AtomicCheckpointIO()])
        rank_zero_only.rank = trainer.global_rank  # type: ignore[attr-defined] # not SLURM_PROCID of a task alone
        if environment := getattr(trainer.strategy, "cluster_environment", None):
            environment.validate_settings(trainer.num_devices, trainer.num_nodes)
        if (tasks := trainer.world_size) != (processes := trainer.num_devices * trainer.num_nodes):
            start = f"srun --ntasks-per-node={trainer.num_devices}, or on one machine by env -u SLURM_NTASKS"
            raise ValueError(f"the cluster starts {tasks} of {processes} processes; under SLURM start it by {start}.")
        if trainer.world_size > 1 and isinstance(interval, str | Mapping):  # Lightning asks each process's clock
            raise ValueError("a val_check_interval in time comes at another step on each device; give it in steps.")
        return trainer
    except (TypeError, ValueError, RuntimeError, ImportError, MisconfigurationException) as error:
        raise InputError(f"trainer: {' '.join(str(error).split())}") from None


def check_trainer(options: Mapping[str, Any]) -> None:
    """Refuse options that Lightning would change silently or answer with a traceback."""
    check_options("trainer", TrainerRanges, {f.name: options.get(f.name) for f in fields(TrainerRanges)})
    precision, accelerator, gpu = str(options["precision"]), options["accelerator"], torch.cuda.is_available()
    on_cpu = accelerator == "cpu" or (accelerator == "auto" and not gpu)
    mixed, cpu_too = precision.replace("true", "mixed"), "bf16-mixed or 32-true"
    for wrong, problem in (
        (precision in ("16-true", "bf16-true"), f"{precision} rounds the times of a flow to three digits; use {mixed}"),
        (accelerator in ("gpu", "cuda") and not gpu, "accelerator=gpu, but torch sees no GPU here; use trainer=cpu"),
        (re.search("spawn|fork|notebook", str(options["strategy"])), "its step is lost at its end; use strategy=ddp"),
        (on_cpu and precision in ("16-mixed", "16"), f"{precision} becomes bfloat16 on a CPU; use {cpu_too}"),
    ):
        if wrong:
            raise InputError(f"trainer: {problem}.")


def fit(run: Run) -> Result:
    """Train a run in its folder, resuming from its last checkpoint, and draw its samples.

    SIGTERM, SIGHUP and Ctrl-C stop it after the current step, with a checkpoint; before the first step, at once.

    Raises:
        InputError: unreadable scans, another run in its folder, non-finite weights, a full disk.
        r2flow.signals.Stopped: a stop signal was received, or another device's process was killed.
    """
    callbacks: list[L.Callback] = run.trainer.callbacks  # type: ignore[attr-defined]
    stopping = next((callback for callback in callbacks if isinstance(callback, Stopping)), Stopping(run.folder))
    with stopping.listening(), _quiet(repeated=False):  # each trains on scans of its own
        with _quiet():
            run.data.setup()
            run.config["scans"] = run.data.fingerprint()
            log.info("training on %s", run.config["scans"].partition(",")[0])
            if run.trainer.is_global_zero and not (run.folder.exists() or run.config["trainer"]["fast_dev_run"]):
                check_folder(run.folder)
                run.data.read()  # a bad scan leaves no folder
        run.stage.config = dict(run.config)
        if run.config["trainer"]["fast_dev_run"]:
            run.trainer.fit(run.stage, run.data)
            return _result(run, run.trainer.global_step, finished=True)
        with run_lock(run.folder) if run.trainer.is_global_zero else nullcontext():
            # Python hears no signal while it waits for other machines; from its first step on, `Stopping` does.
            with listening(signal.SIG_DFL, STOPPING if run.trainer.num_nodes > 1 else ()):
                step = _fit_in_folder(run, stopping)
            if run.trainer.is_global_zero:
                where, kept = run.trainer.strategy.root_device, bool(run.trainer.checkpoint_callbacks)
                device = str(where) if where.type == "cuda" else "cpu"
                finish(run.folder, run.config["samples"], run.config["seed"], device, run.trainer.max_steps, kept=kept)
                log_figures(run.trainer.loggers, run.folder, step)
    return _result(run, step, finished=step >= run.trainer.max_steps)


def _fit_in_folder(run: Run, stopping: Stopping) -> int:
    last = open_run(run.folder, run.config, locked=run.trainer.is_global_zero)
    if last is not None and step_of(last) >= run.trainer.max_steps:
        if run.trainer.is_global_zero:
            init = as_override("stage.init", run.folder)
            print(f"finished before, at step {step_of(last)}; to learn more: {init} name=OTHER")
        return step_of(last)  # no training, no pairs
    with _quiet():
        run.data.read()
        if last is not None:
            run.stage.start = step_of(last)
            log.info("resuming from %s", last)
    if run.trainer.is_global_zero:
        log_config(run.trainer.loggers, run.config)
    try:
        if last is None and run.config["stage"].get("init") and is_overridden("validation_step", run.stage):
            run.trainer.validate(run.stage, run.data, verbose=False)  # what the end of the run is compared with
        run.trainer.fit(run.stage, run.data, ckpt_path=last, weights_only=True)
    except MisconfigurationException as error:  # as of limit_val_batches, with few scans
        raise InputError(f"trainer: {' '.join(str(error).split())}") from None
    except RuntimeError as error:
        if isinstance(cause := error.__context__, OSError) and re.search("combined_loader|Too many open", str(error)):
            raise cause from None
        if run.trainer.world_size > 1 and stopping.told is None and re.search(PEER_LOST, str(error)):
            if any(map(_failed, getattr(run.trainer.strategy.launcher, "procs", ()))):
                raise InputError("a process of this run on another device ended with an error.") from error
            again = "resumes" if checkpoints_of(run.folder) else "starts it again: no checkpoint yet"
            raise Stopped(LATER, f"a process of this run on another device ended; the same command {again}.") from error
        raise
    return run.trainer.global_step


def _failed(process: Popen[bytes]) -> bool:
    """Whether a process has ended with an error of its own; a process that hangs has not."""
    with suppress(TimeoutExpired):
        return process.wait(10) in (1, 2)
    return False


def _result(run: Run, step: int, finished: bool) -> Result:
    logged = {name: float(values[-1]) for name, (_, values) in read_curves(run.folder).items()}
    metrics = {**logged, **{name: float(value) for name, value in run.trainer.callback_metrics.items()}}
    return Result(metrics, next(iter(checkpoints_of(run.folder)), None), run.folder, step, finished)


@contextmanager
def _quiet(repeated: bool = True) -> Iterator[None]:
    """Suppress Lightning's messages, its warnings about intended choices, and logs that further devices repeat."""
    levels = dict.fromkeys(("lightning.pytorch", "lightning.fabric"), logging.WARNING)
    if getattr(rank_zero_only, "rank", 0) and repeated:
        levels["r2flow"] = logging.ERROR
    before = {name: logging.getLogger(name).level for name in levels}
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)
    try:
        with warnings.catch_warnings():
            for message in EXPECTED_WARNINGS:
                warnings.filterwarnings("ignore", message=message)
            yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
