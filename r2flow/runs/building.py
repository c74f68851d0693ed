"""From a config to a run: its stage, DataModule and Trainer."""

import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Checkpoint, ProgressBar
from lightning.pytorch.utilities import rank_zero_only

from r2flow.base.config import key_of
from r2flow.base.errors import InputError, naming, one_line
from r2flow.base.plugins import loaded_plugins, made_with
from r2flow.base.registry import Bound, Config, Natural, Options, Seed, construct, strict
from r2flow.callbacks import Progress, SamplePictures, build_callbacks
from r2flow.callbacks.checkpoints import AtomicCheckpointIO
from r2flow.callbacks.loggers import LOGGERS, LearningRates
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import MIXED, PAIRS, SIMULATED, DataOptions
from r2flow.model.lineage import Parent, find_parent, model_options
from r2flow.model.parts import MODEL, config_of
from r2flow.runs.folder import check_run, read_config
from r2flow.stages import STAGES
from r2flow.stages.base import Stage

log = logging.getLogger("r2flow")

_EXPECTED_WARNINGS = (
    ".*does not have many workers.*",
    "Total length of .list. across ranks is zero.*",
    ".*smaller than the logging interval.*",
    ".*isinstance.treespec, LeafSpec.*",
    "You passed in a .val_dataloader. but have no .validation_step.*",
    "Be aware that when using .ckpt_path.*",  # a callback's options may change
    ".*your dataloader is not resumable.*",  # it resumes by the trainer's step
)

_Named = Annotated[Options, Bound("a group with a name", lambda group: "name" in group)]
_InRuns = Annotated[
    str, Bound("a folder in runs", lambda name: name.strip("./") and ".." not in Path(name).parts)
]


@strict
@dataclass(frozen=True)
class SampleOptions:
    """Samples drawn at the end of a run."""

    num: Natural = 4


@strict
@dataclass(frozen=True)
class RunConfig:
    """Top-level keys of a run's config. Those of the groups are the options of the classes that
    they are for.
    """

    stage: _Named  # class of `STAGES`, with its options
    backbone: Options | None  # the following four: as in `Stage`
    sensor: Options
    encoding: Options
    data: _Named  # `ScanDataModule`
    trainer: Options  # Lightning's Trainer
    callbacks: Mapping[str, Options | None]  # classes of `CALLBACKS`
    samples: SampleOptions
    run_dir: Annotated[str, Bound("a folder", lambda name: name.strip("/ "))]
    seed: Seed
    name: _InRuns | int | float = "run"
    experiment: str | Sequence[str] | None = None
    generator: Options | str | None = None
    sampler: Options | None = None
    few: Options | None = None
    chain: Options | None = None
    preview: str | None = None
    loggers: Sequence[str] | None = None
    plugins: Sequence[str] = ()
    scans: Any = None  # identity of the scans, filled in by the run


@dataclass
class Run:
    """A run, ready to be fitted."""

    config: Config  #: the complete config, including values from the parent and the data
    stage: Stage  #: the LightningModule, with initial weights
    data: ScanDataModule  #: the DataModule; no scans have been read yet
    trainer: L.Trainer  #: Lightning's Trainer, with callbacks and loggers

    @property
    def folder(self) -> Path:
        """Folder of config, checkpoints, logs and samples."""
        return Path(self.config["run_dir"])


def build(config: Options, asked: Sequence[str] = (), parent: Parent | None = None) -> Run:
    """Build the stage, the data and the Trainer of a config; scans are listed, not read.

    Args:
        config: As returned by `compose`.
        asked: Overrides of the command line: only these are refused if they contradict the parent;
            other keys take the parent's values.
        parent: The parent, if it is not the one that the config names.

    Raises:
        InputError: an invalid value, an unknown name or option, a parent that is missing or not
            finished.
    """
    run = construct("the config", RunConfig, config)
    if run.chain or run.preview:
        raise InputError("this config is a chain of runs: train it by `r2flow train`.")
    with quiet(), made_with(read_config(run.run_dir) or {}, f"the run in {run.run_dir}"):
        keys = [key_of(text) for text in asked]
        stage_options = dict(run.stage)
        stage_class = STAGES[stage_options.pop("name")]
        named = stage_options.pop("parent", None)
        if parent is None and named is not None:
            parent = find_parent(named["path"] if isinstance(named, Mapping) else named)
        with made_with(parent.config if parent else {}, "the run that it starts from"):
            options = model_options(
                _given(config, keys, parent),
                parent,
                stage_class.generator_name,
                stage_class.needs_pairs,
            )
        data = _build_data(run, options, keys, parent)
        options["encoding"] = data.encoding.described()
        options |= {"parent": parent, "sampler": run.sampler, "few": run.few, "seed": run.seed}
        stage: Stage = construct(
            f"stage '{run.stage['name']}'", stage_class, {**stage_options, **options}
        )
        if stage.hparams["backbone"] is None and any(key.startswith("backbone") for key in keys):
            raise InputError(
                f"stage={run.stage['name']} has its own network: leave the backbone out."
            )
        stage.check_data(data)
        data.adopt(stage.item_format)
        trainer = _build_trainer(run, stage)
        data.share(trainer)  # refuses a batch that cannot be shared before there is a folder
        complete = {**config, **config_of(stage.hparams, data.hparams, run.stage["name"])}
        complete["plugins"] = list(run.plugins) or loaded_plugins()
        return Run(complete, stage, data, trainer)


def check(config: Options, asked: Sequence[str] = (), parent: Parent | None = None) -> Config:
    """Check a config by building its run; no files are written.

    The result is completed with values of its parent; `parent` is one that has not been trained
    yet.
    """
    run = build(config, asked, parent)
    check_run(run.folder, run.config)
    return run.config


def _given(config: Options, keys: Sequence[str], parent: Parent | None) -> Config:
    """Options of the model; next to a parent's, only those of the command line."""
    given = {group: config.get(group) for group in MODEL}
    if parent is None:
        return given
    for group in ("backbone", "sensor", "encoding"):
        if group not in keys:
            options = config[group] or {}
            asked_for = {key.split(".")[1] for key in keys if key.startswith(f"{group}.")}
            own = {key: options[key] for key in options if key in asked_for}
            given[group] = own or None
    return given


def _build_data(
    run: RunConfig, options: Options, keys: Sequence[str], parent: Parent | None
) -> ScanDataModule:
    """The DataModule of a config, for the model's sensor and encoding."""
    data = dict(run.data)
    chosen = construct("data", DataOptions, data)
    _refuse_unread(data["name"], keys)
    of_simulated = all(part.get("name") == SIMULATED for part in chosen.parts or [data])
    drawer = parent
    if data["name"] == PAIRS:
        if parent is None:
            raise InputError("data=pairs are drawn by a trained run: give stage.parent=RUN.")
        drawer = find_parent(chosen.pairs.of) if chosen.pairs.of else parent
    theirs = (drawer.config.get("data") or {}).get("reading") if drawer else None
    if data["name"] == PAIRS:
        data["reading"] = theirs
    elif theirs and not of_simulated:  # the rays of simulated scans are given
        data["reading"] = {
            "projection": theirs["projection"],
            "convention": theirs["convention"],
            **chosen.chosen,
        }
    encoding = dict(options["encoding"])
    if parent is None:
        encoding["reflectance"] = run.encoding.get("reflectance", True)  # `auto` looks at the scans
    if "encoding.levels" not in keys:
        encoding["levels"] = None  # those of the scans, else of the parent
    module = ScanDataModule(**data, sensor=options["sensor"], encoding=encoding, seed=run.seed)
    if module.encoding.levels is None:
        module.encoding.levels = options["encoding"].get("levels")
    if parent and drawer and module.pairs:
        for group in ("sensor", "encoding"):
            if drawer.config[group] != parent.config[group]:
                raise InputError(
                    f"data.pairs.of={module.pairs.of} has another {group} than {parent.path}."
                )
        module.drawn_by(drawer.record())
    return module


def _refuse_unread(name: str, keys: Sequence[str]) -> None:
    """Refuse keys of the command line that this kind of data does not read."""
    given = {".".join(key.split(".")[:2]) for key in keys}
    if name not in (SIMULATED, MIXED, PAIRS) and "data.scenes" in given:
        raise InputError("scans in files are no simulated scenes: leave data.scenes out.")
    if name == SIMULATED and "data.reading" in given:
        raise InputError("simulated scans are not read from files: leave data.reading out.")
    if name == PAIRS and "data.reading" in given:
        raise InputError("data.reading is that of the flow that draws the pairs: leave it out.")
    if name != PAIRS and "data.pairs" in given:
        raise InputError(f"data={name} has no pairs (data=pairs has): leave data.pairs out.")


def _build_trainer(run: RunConfig, stage: Stage) -> L.Trainer:
    options = dict(run.trainer)
    if options["accelerator"] == "auto" and not torch.cuda.is_available():
        options["accelerator"] = "cpu"  # Lightning would choose Apple's GPU, which lacks float64
    if not stage.automatic_optimization:  # Lightning leaves these two to the stage
        if options["accumulate_grad_batches"] != 1:
            name = run.stage["name"]
            raise InputError(
                f"stage={name} takes its own optimiser steps: trainer.accumulate_grad_batches must "
                "be 1."
            )
        stage.gradient_clip_val = options["gradient_clip_val"]
        options["gradient_clip_val"] = None
    interval = options["val_check_interval"]
    if interval == 0:
        raise InputError(
            "trainer.val_check_interval must be above 0; "
            "trainer.limit_val_batches=0 leaves validation out."
        )
    if isinstance(interval, int) and options["check_val_every_n_epoch"] is None:
        if options["max_steps"] > 0:  # a short run is validated once, at its end
            interval = min(interval, options["max_steps"])
        options["val_check_interval"] = interval * options["accumulate_grad_batches"]
    callbacks = _callbacks(run, stage, options)
    loggers = [LOGGERS[name](Path(run.run_dir)) for name in run.loggers or ()]
    if loggers:
        callbacks.insert(0, LearningRates("step"))
    try:
        with quiet():
            trainer = L.Trainer(
                **options, callbacks=callbacks, logger=loggers, plugins=[AtomicCheckpointIO()]
            )
        rank_zero_only.rank = trainer.global_rank  # type: ignore[attr-defined] # not SLURM_PROCID of a task alone
        if environment := getattr(trainer.strategy, "cluster_environment", None):
            environment.validate_settings(trainer.num_devices, trainer.num_nodes)
    except (TypeError, ValueError, RuntimeError, ImportError, MisconfigurationException) as error:
        raise InputError(f"trainer: {one_line(str(error))}") from None
    tasks = trainer.world_size
    processes = trainer.num_devices * trainer.num_nodes
    if tasks != processes:
        raise InputError(
            f"trainer: the cluster starts {tasks} of {processes} processes; under SLURM start it "
            "by srun "
            f"--ntasks-per-node={trainer.num_devices}, or on one machine by env -u SLURM_NTASKS."
        )
    if tasks > 1 and isinstance(interval, str):  # Lightning asks the clock of each process
        raise InputError(
            "a trainer.val_check_interval in time comes at another step on each device; give steps."
        )
    return trainer


def _callbacks(run: RunConfig, stage: Stage, options: Config) -> list[L.Callback]:
    """The callbacks of a config; `options` of the Trainer may leave some out."""
    callbacks: list[L.Callback] = [Progress()]
    if not options["fast_dev_run"]:
        callbacks = build_callbacks(run.callbacks)
    for callback in callbacks:
        if isinstance(callback, SamplePictures):
            with naming("callbacks.pictures"):
                callback.check(stage.generator)  # before there is a folder
    for key, kind in (("enable_checkpointing", Checkpoint), ("enable_progress_bar", ProgressBar)):
        if not options[key]:
            callbacks = [callback for callback in callbacks if not isinstance(callback, kind)]
        # Without one, Lightning would add its own.
        options[key] = any(isinstance(callback, kind) for callback in callbacks)
    return callbacks


@contextmanager
def quiet(repeated: bool = True) -> Iterator[None]:
    """Suppress Lightning's messages, its warnings about intended choices, and logs that further
    devices repeat.
    """
    levels = dict.fromkeys(("lightning.pytorch", "lightning.fabric"), logging.WARNING)
    if getattr(rank_zero_only, "rank", 0) and repeated:
        levels["r2flow"] = logging.ERROR
    before = {name: logging.getLogger(name).level for name in levels}
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)
    try:
        with warnings.catch_warnings():
            for message in _EXPECTED_WARNINGS:
                warnings.filterwarnings("ignore", message=message)
            yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
