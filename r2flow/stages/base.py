"""Base classes of stages: a generator in training, its optimisers, and the notes in its checkpoints."""

import math
from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from typing import Any, ClassVar

import lightning as L
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from r2flow.data.loader import Further
from r2flow.errors import InputError, check, naming
from r2flow.flow.times import golden_sequence
from r2flow.generators import Generator
from r2flow.model.checkpoint import COMPILED, check_weights
from r2flow.noise import seed_torch
from r2flow.processes import average_gradients
from r2flow.registry import Count, Natural, NonNegative, Portion
from r2flow.stages.muon import Muon

Batch = dict[str, Tensor]


class Stage(L.LightningModule):
    """Trains a generator. A subclass defines `training_step`.

    A batch has the keys `x_1`, scans in model space, (B, C, H, W); `x_0`, noise, (B, *noise_shape); `u`, uniform draws
    in [0, 1), (B,); and `k`, the number of each image in the run, (B,), which seeds further draws (`r2flow.noise`).

    A stage with several losses and optimisers sets `automatic_optimization = False`, creates the optimisers by
    `optimizers_for` and, in every `training_step`, calls `take_step(optimizer, loss)` for each of `own_optimizers()`.

    Args:
        generator: The generator to train; commands load it from a checkpoint without the stage.
        learning_rate: AdamW's learning rate; linear warm-up, then a cosine to 0 at the run's last step.
        betas, weight_decay: AdamW's.
        muon: Learning rate of the weight matrices by `Muon`, with the same schedule; None: AdamW for all weights.
        warmup_images: Images seen during the warm-up.
        batch_size: Images per step, to convert images into steps.

    Attributes:
        config: The run's config, which its checkpoints store.
        start: The step that it resumes from.
        gradient_clip_val: Gradient clipping of the run, for a stage with manual optimisation.
        further: Makes additional batch entries of x_1, (C, H, W), its sensor and draws of each image, in the loader.
    """

    learns: ClassVar[type[Generator]] = Generator  # class of the generators that it can train
    generator_name: ClassVar[str | None] = None  # generator to train; None: the parent's, or a rectified flow
    needs_pairs: ClassVar[bool] = False  # whether it trains on pairs of x_0 and x_1
    needs_parent: ClassVar[bool] = False  # whether it must start from another run, even if it trains on scans
    several_sensors: ClassVar[bool] = False  # whether the parts of a mixture may be scans of different sensors
    anneals: ClassVar[bool] = True  # whether the learning rate decays to 0 at the run's last step

    def __init__(
        self,
        generator: Generator,
        learning_rate: NonNegative = 2e-3,
        betas: tuple[Portion, Portion] = (0.9, 0.99),
        weight_decay: NonNegative = 0.0,
        muon: NonNegative | None = None,
        warmup_images: Natural = 400,
        batch_size: Count = 8,
        seed: int = 0,
    ) -> None:
        if not isinstance(generator, self.learns):
            expected, actual = self.learns.__name__, type(generator).__name__
            raise InputError(f"{type(self).__name__} learns a {expected}, found a {actual}: give another stage.")
        super().__init__()
        self.generator = generator
        self.learning_rate, self.betas, self.weight_decay = learning_rate, (betas[0], betas[1]), weight_decay
        self.muon = muon
        self.warmup_steps = warmup_images // batch_size
        self.seed = seed
        self.config: dict[str, Any] = {}
        self.start = 0
        self.gradient_clip_val: float | None = None
        self.further: Further | None = None

    def check_data(self, name: str, data: Mapping[str, Any]) -> None:
        """Refuse a config's `data` that the stage of this name cannot train on."""
        on_pairs = data["name"] == "pairs"
        check(on_pairs or not self.needs_pairs, f"stage={name} learns from pairs: give data=pairs, not {data['name']}.")
        if data.get("scans") is not None:
            raise InputError(f"stage={name} learns from pairs alone: leave data.scans out, or give stage=flow_map.")
        check(self.needs_pairs or not on_pairs, f"stage={name} learns from scans, not data=pairs; give stage=reflow.")

    def setup(self, stage: str) -> None:
        here = self.start, self.config.get("scans")
        alike = self.trainer.strategy.reduce_boolean_decision(here == self.trainer.strategy.broadcast(here))
        start = f"process {self.global_rank} starts from step {self.start}, on {self.config.get('scans')}"
        check(alike, f"{start}, others do not: run_dir and data.root must be folders that all machines share.")

    def on_train_start(self) -> None:
        wrapped = any(COMPILED in name for name, _ in self.generator.named_parameters())
        check(not wrapped, "torch.compile(module) renames the weights in checkpoints: use module.compile() instead.")

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Dropout uses torch's global generator: seeding it by position makes a resumed run draw the same numbers.
        seed_torch(self.seed, "dropout", batch_idx * self.trainer.world_size + self.global_rank)

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.parameters())

    def optimizers_for(self, *groups: Iterable[torch.nn.Parameter]) -> Any:
        """AdamW or `Muon` with a schedule for each group of parameters, in the format of `configure_optimizers`."""
        options: dict[str, Any] = {"lr": self.learning_rate, "betas": self.betas, "weight_decay": self.weight_decay}
        total = max(int(self.trainer.max_steps), 1)
        warmup = min(self.warmup_steps, total)

        def factor(step: int) -> float:
            return learning_rate_factor(step, warmup, total) if self.anneals or step < warmup else 1.0

        optimizers = [
            torch.optim.AdamW(group, **options) if self.muon is None else Muon(group, self.muon, **options)
            for group in groups
        ]
        schedules = [torch.optim.lr_scheduler.LambdaLR(optimizer, factor) for optimizer in optimizers]
        return optimizers, [{"scheduler": schedule, "interval": "step"} for schedule in schedules]

    def own_optimizers(self) -> list[LightningOptimizer]:
        """The optimisers of a stage with manual optimisation, in the order of `optimizers_for`.

        Only steps of the first one advance `global_step`, since a run resumes by it and it must count batches.
        """
        optimizers = self.optimizers()
        as_list = optimizers if isinstance(optimizers, list) else [optimizers]
        for other in as_list[1:]:  # Lightning would count the steps of each
            other._on_before_step = other._on_after_step = lambda: None
        return as_list

    def take_step(self, optimizer: LightningOptimizer, loss: Tensor) -> None:
        """Take one step of one of `own_optimizers` on a loss, with the run's gradient clipping and schedule.

        Gradients of other optimisers' parameters are not cleared here, but before those optimisers' steps.
        """
        optimizer.zero_grad()
        model = self.trainer.strategy.model
        # DDP waits for gradients of all parameters in every backward pass; a loss may have gradients of some only.
        with model.no_sync() if isinstance(model, DistributedDataParallel) else nullcontext():
            self.manual_backward(loss)
        average_gradients(parameter for group in optimizer.param_groups for parameter in group["params"])
        optimizer.step()
        for config in self.trainer.lr_scheduler_configs:
            if config.scheduler.optimizer is optimizer.optimizer:
                config.scheduler.step()  # type: ignore[call-arg]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if not self.automatic_optimization:  # float16 gradients are unscaled only now
            self.clip_gradients(optimizer, self.gradient_clip_val)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["config"] = self.config
        checkpoint |= self.generator.drawing()

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        if "state_dict" in checkpoint:  # a sharded strategy reads its own
            with naming("the checkpoint to resume from"):  # a plug-in may have changed
                check_weights(self, checkpoint["state_dict"])


class SingleLoss(Stage):
    """A stage with one loss per batch. A subclass defines `regression_loss`."""

    _sum: Tensor  # of the losses of the step's accumulated batches

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        """Mean loss at the times that the stage computes from uniform draws u in [0, 1), (B,)."""
        raise NotImplementedError

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = self.regression_loss(batch, batch["u"])
        usable = isinstance(loss, Tensor) and loss.numel() == 1 and loss.requires_grad
        check(usable, f"regression_loss of a {type(self).__name__} must be one number with a gradient.")
        part = batch_idx % (self._trainer.accumulate_grad_batches if self._trainer else 1)
        self._sum = loss.detach() + (self._sum if part else 0.0)
        self.log("train/loss", self._sum / (part + 1), prog_bar=True, sync_dist=True)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        # A low-discrepancy sequence over [0, 1) instead of random times reduces the variance over few scans.
        loss = self.regression_loss(batch, golden_sequence(batch["k"]))
        self.log("val/loss", loss, prog_bar=True, batch_size=len(batch["x_1"]), sync_dist=True)


def learning_rate_factor(step: int, warmup: int, total: int) -> float:
    """step / warmup during the warm-up, then (1 + cos(pi s)) / 2 with s from 0 to 1 over the remaining steps."""
    if step < warmup:
        return step / warmup
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(total - warmup, 1)))
