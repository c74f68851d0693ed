"""Base classes of stages: LightningModules that train a generator."""

import inspect
import logging
import math
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from dataclasses import asdict
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypedDict

import lightning as L
import torch
from lightning.pytorch.callbacks import GradientAccumulationScheduler
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from r2flow.backbones.module import ModuleBackbone
from r2flow.base.arguments import NamedArguments
from r2flow.base.errors import InputError, naming
from r2flow.base.noise import seed_torch
from r2flow.base.plugins import loaded_plugins
from r2flow.base.processes import average_gradients
from r2flow.base.registry import (
    Config,
    Natural,
    NonNegative,
    Options,
    Portion,
    Seed,
    construct,
)
from r2flow.data.datamodule import ScanDataModule
from r2flow.data.loader import ItemFormat
from r2flow.data.options import ParentRecord
from r2flow.flow.times import golden_sequence
from r2flow.generators import Generator, build_generator
from r2flow.lidar.encoding import Encoding, ModelSpace
from r2flow.lidar.sensors import Sensor
from r2flow.metrics import METRICS
from r2flow.model.checkpoint import check_weights
from r2flow.model.lineage import Parent, find_parent, model_options, plain
from r2flow.model.parts import COMPILED, HYPER, MODEL, NOTES
from r2flow.model.paths import step_of
from r2flow.model.sampling import draw, sample
from r2flow.samplers import build_sampler
from r2flow.stages.muon import Muon

_BEYOND = 1.1  # largest value of a scan in model space, with some tolerance

_FEW = 32  # held-out scans: a test of fewer is called chance

_PARTS = "accumulate_grad_batches"  # in a checkpoint
_log = logging.getLogger(__name__)

Batch = dict[str, Tensor]
BackboneLike = str | nn.Module | Options | None
SensorLike = str | Sensor | Options | None
EncodingLike = str | Encoding | Options | None
GeneratorLike = str | Generator | Options | None
ParentLike = str | Path | Parent | Options | None
SamplerLike = str | Options | None
TimeLike = str | Options
Betas = tuple[Portion, Portion]


class ModelArguments(TypedDict, total=False):
    """Arguments by keyword of each stage, as in `Stage`."""

    encoding: EncodingLike
    generator: GeneratorLike
    parent: ParentLike
    sampler: SamplerLike
    few: SamplerLike
    seed: Seed


class StageArguments(ModelArguments, total=False):
    """Those of a stage that is optimised as `Stage` is."""

    learning_rate: NonNegative
    betas: Betas
    weight_decay: NonNegative
    muon: NonNegative | None
    warmup_images: Natural


class Stage(L.LightningModule, NamedArguments):
    """Trains a generator. A subclass defines `training_step`.

    A batch has the keys `x_1`, scans in model space, (B, C, H, W); `x_0`, noise, (B, *noise_shape);
    `u`, uniform draws in [0, 1), (B,); and `k`, the number of each image in the run, (B,), which
    seeds further draws (`r2flow.base.noise`). Of a batch without noise, or scans alone, the others
    are drawn by torch's global generator.

    A stage with several losses and optimisers sets `automatic_optimization = False`, creates the
    optimisers by `optimizers_for` and, in every `training_step`, calls `take_step(optimizer, loss)`
    for each of `own_optimizers()`.

    Args:
        backbone: Network v(t, x): a name or options, as in conf/backbone, or a module of one's own;
            None: the parent's, else `hdit_tiny`.
        sensor: Sensor of the images, its name, file or options; None: the parent's, else `hdl64e`.
        encoding: Encoding of the images, a name in conf/encoding, or options; None: the parent's,
            else `logscale`.
        generator: Name and options in `GENERATORS`, or a generator, which replaces the three
            options above; None: the stage's, the parent's, or a rectified flow.
        parent: Run folder, checkpoint or model to start from, with its averaged weights.
        sampler: Name and options of the default sampler; None: the generator's.
        few: Name and options of a sampler for fewer steps than `sampler` has; None: `sampler`.
        seed: Seed of the first weights and of draws in training.
        learning_rate: Learning rate of AdamW; linear warm-up, then a cosine to 0 at the last step.
        betas: Decays of AdamW's averages of the gradient and of its square.
        weight_decay: Weight decay of AdamW.
        muon: Learning rate of the weight matrices by `Muon`, with the same schedule; None: AdamW
            for all weights.
        warmup_images: Images seen during the warm-up of the learning rate.

    Attributes:
        generator: The generator in training.
        parent: The model that it starts from, or None.
        own_network: Whether its network is a module of one's own, which no checkpoint can make.
        gradient_clip_val: Gradient clipping of a stage with manual optimisation, which Lightning
            leaves to it.

    Raises:
        InputError: an unknown name or option, a parent that is missing, unfinished, or of another
            model.
    """

    learns: ClassVar[type[Generator]] = Generator  # class of the generators that it can train
    # Generator to train; None: the parent's, or a rectified flow.
    generator_name: ClassVar[str | None] = None
    needs_pairs = False  # whether it trains on pairs of x_0 and x_1
    takes_pairs = False  # whether it can
    takes_scans = False  # whether it can on scans next to pairs
    needs_parent = False  # whether it must start from another run
    # Whether the parts of a mixture may be scans of different sensors.
    several_sensors = False
    anneals = True  # whether the learning rate decays to 0 at the last step

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        encoding: EncodingLike = None,
        generator: GeneratorLike = None,
        parent: ParentLike = None,
        sampler: SamplerLike = None,
        few: SamplerLike = None,
        seed: Seed = 0,
        learning_rate: NonNegative = 2e-3,
        betas: Betas = (0.9, 0.99),
        weight_decay: NonNegative = 0.0,
        muon: NonNegative | None = None,
        warmup_images: Natural = 400,
    ) -> None:
        super().__init__()
        self.save_hyperparameters(ignore=["parent", *MODEL])
        if inspect.getfullargspec(type(self).__init__).varkw:
            # `load_from_checkpoint` would give it those that it sets for its base, too.
            for name in self.hparams.keys() - inspect.signature(type(self)).parameters:
                del self.hparams[name]
        self.seed = seed
        self.learning_rate = learning_rate
        self.betas = betas[0], betas[1]
        self.weight_decay = weight_decay
        self.muon = muon
        self.warmup_images = warmup_images
        self.own_network = isinstance(backbone, nn.Module)
        source = None
        if parent is not None and not isinstance(parent, Mapping):
            source = find_parent(parent, backbone)
        if isinstance(generator, Generator):
            self.generator = generator
            options: Config = dict.fromkeys(MODEL)
        elif parent is None and (self.needs_parent or self.needs_pairs):
            raise InputError(f"{type(self).__name__} starts from a trained model: give parent=RUN.")
        else:
            groups = {
                "backbone": backbone,
                "sensor": sensor,
                "encoding": encoding,
                "generator": generator,
            }
            options = model_options(groups, source, self.generator_name, self.needs_pairs)
            seed_torch(seed, "weights")  # also of networks that a subclass adds
            self.generator = build_generator(options)
        if not isinstance(self.generator, self.learns):
            raise InputError(
                f"{type(self).__name__} learns a {self.learns.__name__}, found a "
                f"{type(self.generator).__name__}: give another stage."
            )
        if not hasattr(self.generator, "backbone"):  # it has its own network
            options["backbone"] = None
        if source and source.checkpoint:
            self.generator.start_from(source.checkpoint.generator)
        self.prepare_generator()
        fields = {"name": sampler} if isinstance(sampler, str) else sampler or {}
        default = self.generator.choose(**fields)
        if default.completes:
            raise InputError(
                f"sampler {default.name} completes scans: give it to r2flow complete by --sampler."
            )
        if few is not None:
            self.generator.few = build_sampler(few)
            self.generator.few.check(self.generator)
        self.generator.sampler = default
        self.parent: ParentRecord | None = source.record() if source else None
        if isinstance(parent, Mapping):
            self.parent = construct("parent", ParentRecord, parent)
        record = asdict(self.parent) if self.parent else None
        # kept, since a subclass may save its own arguments over them
        self._built_with = plain({**options, "parent": record, "sampler": default.asdict()})
        self.save_hyperparameters({**plain(dict(self.hparams)), **self._built_with})
        self.gradient_clip_val: float | None = None

    def prepare_generator(self) -> None:
        """Set the sampler that this stage trains the generator for; it may be replaced by the
        options `sampler`.
        """

    @property
    def space(self) -> ModelSpace:
        """Model space of the images."""
        return self.generator.space

    @property
    def backbone(self) -> nn.Module:
        """The network v(t, x); a module of one's own as it was given."""
        network: Any = self.generator.backbone
        return network.network if isinstance(network, ModuleBackbone) else network

    @property
    def encoding(self) -> Encoding:
        """Encoding between model space and metres."""
        return self.space.encoding

    @property
    def sensor(self) -> Sensor:
        """Sensor of the images."""
        return self.space.sensor

    @property
    def item_format(self) -> ItemFormat:
        """What the items of a batch are, as `ScanDataModule` makes them."""
        return ItemFormat(
            self.encoding, self.generator.noise_shape, several_sensors=self.several_sensors
        )

    @property
    def images_per_step(self) -> int:
        """Images of an optimiser step, on all devices."""
        data = getattr(self.trainer, "datamodule", None)
        if data is not None and hasattr(data, "batch_size"):
            return int(data.batch_size)
        if self.trainer.train_dataloader is None:  # as `estimated_stepping_batches` does
            self.trainer.fit_loop.setup_data()
        loader: Any = self.trainer.train_dataloader
        sampler = getattr(loader, "batch_sampler", None)
        # Loaders of other kinds do not say it.
        batch: int = (
            getattr(loader, "batch_size", None) or getattr(sampler, "batch_size", None) or 1
        )
        return batch * self.trainer.world_size * self.trainer.accumulate_grad_batches

    @property
    def total_steps(self) -> float:
        """Optimiser steps of the run; infinite if only time limits it."""
        return self.trainer.estimated_stepping_batches

    @property
    def progress(self) -> float:
        """Share of the run's steps that were taken; 0 without an end."""
        return min(self.global_step / self.total_steps, 1.0)

    def whole_batch(self, batch: Any) -> Batch:
        """A batch with all its keys; torch's global generator draws those that a loader did not
        give.
        """
        if isinstance(batch, list | tuple):
            batch = batch[0]
        if isinstance(batch, Tensor):
            batch = {"x_1": batch}
        if "x_0" not in batch:
            x_1 = batch["x_1"]
            if x_1.shape[1:] != self.space.shape or not x_1.abs().amax() <= _BEYOND:
                raise InputError(
                    f"x_1 must be scans (B, C, H, W) of {self.space.shape} in [-1, 1], found "
                    f"{tuple(x_1.shape)} up to {x_1.abs().amax():g}: encode metres by "
                    "module.encoding.encode."
                )
            batch["x_0"] = torch.randn(len(x_1), *self.generator.noise_shape, device=x_1.device)
            batch["u"] = torch.rand(len(x_1), device=x_1.device)
            batch["k"] = torch.randint(2**31, (len(x_1),), device=x_1.device)
        return batch

    def check_data(self, data: ScanDataModule) -> None:
        from r2flow.stages import STAGES  # the registry of the classes of this module

        name = STAGES.name_of(type(self)) or type(self).__name__
        if self.needs_pairs and data.pairs is None:
            raise InputError(
                f"stage={name} learns from pairs: give data=pairs, not {data.options.name}."
            )
        if data.pairs is not None and not self.takes_pairs:
            raise InputError(f"stage={name} learns from scans, not data=pairs; give stage=reflow.")
        if data.plan.scans is not None and not self.takes_scans:
            raise InputError(f"stage={name} learns from pairs alone: leave data.scans out.")
        if data.augment.roll and self.generator.learns_directions:
            raise InputError(
                "data.augment.roll makes all directions alike, but backbone.position=learnable "
                "(the paper's APE) "
                "learns one vector per direction; give backbone.position=none, whose attention "
                "sees only differences "
                "in azimuth, or leave roll out."
            )

    def setup(self, stage: str) -> None:
        data = getattr(self.trainer, "datamodule", None)
        if stage == "fit" and isinstance(data, ScanDataModule):
            self.check_data(data)
        callbacks: list[L.Callback] = self.trainer.callbacks  # type: ignore[attr-defined]
        for callback in callbacks if stage == "fit" else ():
            monitor = getattr(callback, "monitor", None)
            if monitor in ("val_loss", "train_loss"):
                raise InputError(
                    f"{type(callback).__name__} monitors '{monitor}', which no stage logs. Did you "
                    f"mean '{monitor.replace('_', '/')}'?"
                )

    def on_fit_start(self) -> None:
        data = getattr(self.trainer, "datamodule", None)
        if self.trainer.world_size > 1 and isinstance(data, ScanDataModule):
            self._refuse_other_starts(data.fingerprint())

    def _refuse_other_starts(self, scans: str) -> None:
        """Refuse machines whose folders of the run or of the scans differ."""
        path = self.trainer.ckpt_path  # known after `setup`
        step = step_of(Path(path)) if path else 0
        strategy = self.trainer.strategy
        if not strategy.reduce_boolean_decision((step, scans) == strategy.broadcast((step, scans))):
            raise InputError(
                f"process {self.global_rank} starts from step {step}, on {scans}, others do not: "
                "the folders of the run and of its scans must be those that all machines share."
            )

    def on_train_start(self) -> None:
        if any(COMPILED in name for name, _ in self.generator.named_parameters()):
            raise InputError(
                "torch.compile(module) renames the weights in checkpoints: use module.compile() "
                "instead."
            )

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Dropout uses torch's global generator: seeding it by position makes a resumed run draw the
        # same numbers.
        parts = self.trainer.accumulate_grad_batches
        position = self.global_step * parts + batch_idx % parts
        seed_torch(self.seed, "dropout", position * self.trainer.world_size + self.global_rank)

    def sample(self, num: int = 1, seed: int = 0, **how: Any) -> Tensor:
        """Scans 0 to num - 1 of a seed by the present weights, (num, 2 or 1, H, W): range in metres
        and reflectance, 0 without a return.

        Args:
            how: Options of `r2flow.model.sampling.sample`: sampler, steps, batch_size, ...
        """
        training = self.training
        self.eval()
        images = [drawn.images for drawn in sample(self.generator, num, seed, **how)]
        self.train(training)
        return torch.cat(images)

    def predict_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> Tensor:
        """Scans of the numbers `k`: range in metres and reflectance, (B, 2 or 1, H, W), 0 without a
        return.
        """
        numbers = self.whole_batch(batch)["k"].tolist()
        return draw(self.generator, numbers, self.seed).images

    def log_mean(self, name: str, value: Tensor, batch: Batch, **options: Any) -> None:
        """Log a mean over the scans of a batch, whose mean over all devices has equal weights."""
        devices = self._trainer.world_size if self._trainer else 1
        # Lightning's mean of the devices' counts is cut to a whole number: 2 of 3 and 2.
        self.log(name, value, batch_size=devices * len(batch["x_1"]), sync_dist=True, **options)

    def on_test_start(self) -> None:
        data = getattr(self.trainer, "datamodule", None)
        alone = isinstance(data, ScanDataModule) and not data.shares_held_out
        self.panel = METRICS["panel"](sensor=self.sensor, sync_on_compute=not alone)
        if self.trainer.world_size > 1:  # a group of GPUs exchanges no tensors of the CPU
            self.panel.to(self.device)

    def test_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        batch = self.whole_batch(batch)
        self.panel.update(self.space.decode(batch["x_1"]).cpu(), real=True)
        self.panel.update(self.predict_step(batch, batch_idx).cpu(), real=False)

    def on_test_epoch_end(self) -> None:
        """Log the panel's distances of held-out to generated scans, `test/panel` their mean."""
        found = {f"test/{name}": value for name, value in self.panel.compute().items()}
        real = int(self.panel.counts[0, 0])
        if self.trainer.is_global_zero and real < _FEW:
            _log.warning("%d held-out scans are too few: distances to so few are chance", real)
        self.log_dict(found, sync_dist=True)

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.parameters())

    def optimizers_for(self, *groups: Iterable[torch.nn.Parameter]) -> Any:
        """AdamW or `Muon` with a schedule for each group of parameters, in the format of
        `configure_optimizers`.
        """
        kind: Any = torch.optim.AdamW
        if self.muon is not None:
            kind = partial(Muon, rate=self.muon)
        optimizers = [
            kind(group, lr=self.learning_rate, betas=self.betas, weight_decay=self.weight_decay)
            for group in groups
        ]
        warmup = self.warmup_images // self.images_per_step

        def factor(step: int) -> float:
            # The number of steps is known when training has begun.
            total = self.total_steps if step and self.anneals else math.inf
            return learning_rate_factor(step, warmup, total)

        schedules = [
            torch.optim.lr_scheduler.LambdaLR(optimizer, factor) for optimizer in optimizers
        ]
        return optimizers, [{"scheduler": schedule, "interval": "step"} for schedule in schedules]

    def own_optimizers(self) -> list[LightningOptimizer]:
        """The optimisers of a stage with manual optimisation, in the order of `optimizers_for`.

        Only steps of the first one advance `global_step`, since a run resumes by it and it must
        count batches.
        """
        optimizers = self.optimizers()
        as_list = optimizers if isinstance(optimizers, list) else [optimizers]
        for other in as_list[1:]:  # Lightning would count the steps of each
            other._on_before_step = other._on_after_step = lambda: None
        return as_list

    def take_step(self, optimizer: LightningOptimizer, loss: Tensor) -> None:
        """Take one step of one of `own_optimizers` on a loss, with the run's gradient clipping and
        schedule.

        Gradients of other optimisers' parameters are not cleared here, but before those optimisers'
        steps.
        """
        optimizer.zero_grad()
        model = self.trainer.strategy.model
        # DDP waits for gradients of all parameters in every backward pass; a loss may have
        # gradients of some only.
        with model.no_sync() if isinstance(model, DistributedDataParallel) else nullcontext():
            self.manual_backward(loss)
        average_gradients(p for group in optimizer.param_groups for p in group["params"])
        optimizer.step()
        for config in self.trainer.lr_scheduler_configs:
            if config.scheduler.optimizer is optimizer.optimizer:
                config.scheduler.step()  # type: ignore[call-arg]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if not self.automatic_optimization:  # float16 gradients are unscaled only now
            self.clip_gradients(optimizer, self.gradient_clip_val)

    def on_save_checkpoint(self, checkpoint: Config) -> None:
        from r2flow.stages import STAGES  # the registry of the classes of this module

        checkpoint.setdefault(HYPER, {}).update(self._built_with)
        checkpoint[NOTES] = {
            "stage": STAGES.name_of(type(self)),
            "plugins": loaded_plugins(),
            "total_steps": self.total_steps if self._trainer else None,
            **self.generator.drawing(),
        }
        if self._trainer:
            checkpoint[_PARTS] = self._trainer.accumulate_grad_batches

    def on_load_checkpoint(self, checkpoint: Config) -> None:
        """Count the parts of batches so far in those of now, which a resumed run may change."""
        trainer: Any = self._trainer
        if not trainer or not {_PARTS, "loops"} <= checkpoint.keys():
            return
        if any(isinstance(one, GradientAccumulationScheduler) for one in trainer.callbacks):
            return
        ratio = Fraction(trainer.accumulate_grad_batches, checkpoint[_PARTS])
        progress = checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]
        for counts in (progress["total"], progress["current"]):
            late = counts["processed"] - counts["completed"]  # 1: saved by a callback after a batch
            counts.update({key: int(count * ratio) for key, count in counts.items()})
            counts["completed"] = counts["processed"] - late

    def load_state_dict(self, state_dict: Any, strict: bool = True, assign: bool = False) -> Any:
        """Load weights; with `strict`, those that do not fit are refused in one line."""
        if strict:
            with naming("the checkpoint"):  # a plug-in may have changed
                check_weights(self, state_dict)
        return super().load_state_dict(state_dict, strict, assign)


# LightningCLI describes arguments by it.
ModelArguments.__doc__ = StageArguments.__doc__ = Stage.__doc__


class SingleLoss(Stage):
    """A stage with one loss per batch. A subclass defines `regression_loss`."""

    _sum: Tensor  # of the losses of the step's accumulated batches

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        """Mean loss at the times that the stage computes from uniform draws u in [0, 1), (B,)."""
        raise NotImplementedError

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        batch = self.whole_batch(batch)
        loss = self.regression_loss(batch, batch["u"])
        part = batch_idx % (self._trainer.accumulate_grad_batches if self._trainer else 1)
        self._sum = loss.detach() + (self._sum if part else 0.0)
        self.log(
            "train/loss",
            self._sum / (part + 1),
            prog_bar=True,
            sync_dist=True,
            batch_size=len(batch["x_1"]),
        )
        return loss

    def validation_step(self, batch: Batch, batch_idx: int, dataloader_idx: int = 0) -> None:
        # A low-discrepancy sequence over [0, 1) instead of random times reduces the variance over
        # few scans.
        batch = self.whole_batch(batch)
        loss = self.regression_loss(batch, golden_sequence(batch["k"]))
        self.log_mean("val/loss", loss, batch, prog_bar=True)


def learning_rate_factor(step: int, warmup: int, total: float) -> float:
    """step / warmup during the warm-up, then (1 + cos(pi s)) / 2 with s from 0 to 1 over the
    remaining steps.
    """
    if step < warmup:
        return step / warmup
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(total - warmup, 1)))
