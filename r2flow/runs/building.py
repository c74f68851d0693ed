"""From a config to a run: its stage, DataModule and Trainer."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import lightning as L
import torch
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Checkpoint, ProgressBar
from lightning.pytorch.utilities import rank_zero_only

from r2flow.base.config import key_of
from r2flow.base.errors import InputError, naming, one_line
from r2flow.base.plugins import loaded_plugins, made_with
from r2flow.base.registry import Config, Options, construct
from r2flow.callbacks import Progress, SamplePictures, build_callbacks
from r2flow.callbacks.checkpoints import AtomicCheckpointIO
from r2flow.callbacks.loggers import LOGGERS, LearningRates
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.options import MIXED, PAIRS, SIMULATED, DataOptions, ReadingOptions
from r2flow.data.resolving import check_intensities
from r2flow.model.config import ModelConfig, RunConfig
from r2flow.model.lineage import Parent, find_parent, model_options
from r2flow.model.parts import MODEL, config_of
from r2flow.runs.folder import check_run, read_config
from r2flow.stages import STAGES
from r2flow.stages.base import Stage

_log = logging.getLogger("r2flow")

_EXPECTED_WARNINGS = (
    ".*does not have many workers.*",
    "Total length of .list. across ranks is zero.*",
    ".*smaller than the logging interval.*",
    ".*isinstance.treespec, LeafSpec.*",
    "You passed in a .val_dataloader. but have no .validation_step.*",
    "Be aware that when using .ckpt_path.*",  # a callback's options may change
    ".*your dataloader is not resumable.*",  # it resumes by the trainer's step
)


@dataclass
class Run:
    """A run, ready to be fitted."""

    config: RunConfig  #: the complete config, including values from the parent and the data
    stage: Stage  #: the LightningModule, with initial weights
    data: ScanDataModule  #: the DataModule; no scans have been read yet
    trainer: L.Trainer  #: Lightning's Trainer, with callbacks and loggers

    @property
    def folder(self) -> Path:
        """Folder of config, checkpoints, logs and samples."""
        return Path(self.config.run_dir)


def build(
    config: Options | RunConfig, asked: Sequence[str] = (), parent: Parent | None = None
) -> Run:
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
    run = config if isinstance(config, RunConfig) else RunConfig.of(config)
    if run.chain or run.preview:
        raise InputError("this config is a chain of runs: train it by `r2flow train`.")
    before = ModelConfig(read_config(run.run_dir) or {})
    with quiet(), made_with(before.plugins, f"the run in {run.run_dir}"):
        keys = [key_of(text) for text in asked]
        recipe = run.recipe
        stage_class = STAGES[recipe.name]
        if parent is None and recipe.parent:
            parent = find_parent(recipe.parent.path)
        with made_with(parent.config.plugins if parent else (), "the run that it starts from"):
            options = model_options(
                _given(run, keys, parent),
                parent,
                stage_class.generator_name,
                stage_class.needs_pairs,
            )
        data = _build_data(run, options, keys, parent)
        options["encoding"] = data.encoding.described()
        options |= {"parent": parent, "sampler": run.sampler, "few": run.few, "seed": run.seed}
        stage: Stage = construct(
            f"stage '{recipe.name}'", stage_class, {**recipe.options, **options}
        )
        networked = hasattr(stage.generator, "backbone")
        if not networked and any(key.startswith("backbone") for key in keys):
            raise InputError(f"stage={recipe.name} has its own network: leave the backbone out.")
        stage.check_data(data)
        data.adopt(stage.item_format)
        trainer = _build_trainer(run, stage)
        data.share(trainer)  # refuses a batch that cannot be shared before there is a folder
        complete = config_of(stage.hparams, data.hparams, recipe.name)
        complete["data"] = construct("data", DataOptions, complete["data"])
        plugins = list(run.plugins) or loaded_plugins()
        return Run(replace(run, **complete, plugins=plugins), stage, data, trainer)


def check(
    config: Options | RunConfig, asked: Sequence[str] = (), parent: Parent | None = None
) -> RunConfig:
    """Check a config by building its run and looking at a scan; no files are written.

    The result is completed with values of its parent; `parent` is one that has not been trained
    yet.
    """
    run = build(config, asked, parent)
    if run.stage.encoding.reflectance:
        check_intensities(run.data.plan)
    check_run(run.folder, run.config.plain())
    return run.config


def _given(run: RunConfig, keys: Sequence[str], parent: Parent | None) -> Config:
    """Options of the model; next to a parent's, only those of the command line."""
    groups: Config = {group: getattr(run, group) for group in MODEL}
    if parent is not None:
        for group in ("backbone", "sensor", "encoding"):
            if group not in keys:
                options = groups[group] or {}
                groups[group] = {k: options[k] for k in options if f"{group}.{k}" in keys} or None
    return groups


def _build_data(
    run: RunConfig, options: Options, keys: Sequence[str], parent: Parent | None
) -> ScanDataModule:
    """The DataModule of a config, for the model's sensor and encoding."""
    _refuse_unread(run.data.name, keys)
    drawer = _drawer(run.data, parent)
    data = replace(run.data, reading=_reading(run.data, drawer))
    encoding = dict(options["encoding"])
    levels = encoding.get("levels")
    if parent is None:
        encoding["reflectance"] = run.encoding.get("reflectance", True)  # `auto` looks at the scans
    if "encoding.levels" not in keys:
        encoding["levels"] = None  # those of the scans, else of the parent
    module = ScanDataModule(
        **vars(data), sensor=options["sensor"], encoding=encoding, seed=run.seed
    )
    if module.encoding.levels is None:
        module.encoding.levels = levels
    if drawer and module.pairs:
        module.drawn_by(drawer.record())
    return module


def _drawer(data: DataOptions, parent: Parent | None) -> Parent | None:
    """The model whose images the data must be like: the one that draws pairs, else the parent."""
    if data.name != PAIRS:
        return parent
    if parent is None:
        raise InputError("data=pairs are drawn by a trained run: give stage.parent=RUN.")
    if not data.pairs.of:
        return parent
    drawer = find_parent(data.pairs.of)
    for group in ("sensor", "encoding"):
        if drawer.config.model[group] != parent.config.model[group]:
            raise InputError(
                f"data.pairs.of={data.pairs.of} has another {group} than {parent.path}."
            )
    return drawer


def _reading(data: DataOptions, like: Parent | None) -> ReadingOptions | None:
    """How scans become images: as those of another model where the config does not say it."""
    theirs = like.reading if like else None
    if data.name == PAIRS:
        return theirs
    simulated = all(part.get("name") == SIMULATED for part in data.parts or [vars(data)])
    if theirs is None or simulated:  # the rays of simulated scans are given
        return data.reading
    inherited = {"projection": theirs.projection, "convention": theirs.convention}
    return ReadingOptions(**{**inherited, **data.reading_fields})


def _refuse_unread(name: str, keys: Sequence[str]) -> None:
    """Refuse keys of the command line that this kind of data does not read."""
    groups = {".".join(key.split(".")[:2]) for key in keys}
    if name not in (SIMULATED, MIXED, PAIRS) and "data.scenes" in groups:
        raise InputError("scans in files are no simulated scenes: leave data.scenes out.")
    if name == SIMULATED and "data.reading" in groups:
        raise InputError("simulated scans are not read from files: leave data.reading out.")
    if name == PAIRS and "data.reading" in groups:
        raise InputError("data.reading is that of the flow that draws the pairs: leave it out.")
    if name != PAIRS and "data.pairs" in groups:
        raise InputError(f"data={name} has no pairs (data=pairs has): leave data.pairs out.")


def _build_trainer(run: RunConfig, stage: Stage) -> L.Trainer:
    options = run.trainer
    if options.accelerator == "auto" and not torch.cuda.is_available():
        options = replace(options, accelerator="cpu")  # Apple's GPU lacks float64
    if options.accelerator == "cpu" and options.precision in (16, "16", "16-mixed"):
        raise InputError("trainer.precision=16-mixed needs a GPU: give bf16-mixed or 32-true.")
    if not stage.automatic_optimization:  # Lightning leaves these two to the stage
        if options.accumulate_grad_batches != 1:
            raise InputError(
                f"stage={run.recipe.name} takes its own optimiser steps: "
                "trainer.accumulate_grad_batches must be 1."
            )
        stage.gradient_clip_val = options.gradient_clip_val
        options = replace(options, gradient_clip_val=None)
    interval = options.val_check_interval
    if interval == 0:
        raise InputError(
            "trainer.val_check_interval must be above 0; "
            "trainer.limit_val_batches=0 leaves validation out."
        )
    if isinstance(interval, int) and options.check_val_every_n_epoch is None:
        if options.max_steps > 0:  # a short run is validated once, at its end
            interval = min(interval, options.max_steps)
        parts = options.accumulate_grad_batches
        options = replace(options, val_check_interval=interval * parts)
    callbacks = _callbacks(run, stage)
    options = replace(  # without such a callback, Lightning would add its own
        options,
        enable_checkpointing=any(isinstance(one, Checkpoint) for one in callbacks),
        enable_progress_bar=any(isinstance(one, ProgressBar) for one in callbacks),
    )
    loggers = [LOGGERS[name](Path(run.run_dir)) for name in run.loggers or ()]
    if loggers:
        callbacks.insert(0, LearningRates("step"))
    try:
        with quiet():
            trainer = L.Trainer(
                **vars(options), callbacks=callbacks, logger=loggers, plugins=[AtomicCheckpointIO()]
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


def _callbacks(run: RunConfig, stage: Stage) -> list[L.Callback]:
    """The callbacks of a config, without those that options of the Trainer leave out."""
    callbacks: list[L.Callback] = [Progress()]
    if not run.trainer.fast_dev_run:
        callbacks = build_callbacks(run.callbacks)
    for callback in callbacks:
        if isinstance(callback, SamplePictures):
            with naming("callbacks.pictures"):
                callback.check(stage.generator)  # before there is a folder
    if not run.trainer.enable_checkpointing:
        callbacks = [one for one in callbacks if not isinstance(one, Checkpoint)]
    if not run.trainer.enable_progress_bar:
        callbacks = [one for one in callbacks if not isinstance(one, ProgressBar)]
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
