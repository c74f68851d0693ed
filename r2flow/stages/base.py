"""What every stage has in common: a generator that learns, its optimiser, and what a checkpoint says of it."""

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
from r2flow.errors import InputError
from r2flow.flow.times import golden_sequence
from r2flow.generators import Generator
from r2flow.noise import seed_torch
from r2flow.processes import average_gradients
from r2flow.registry import Count, Natural, NonNegative, Portion
from r2flow.stages.muon import Muon

Batch = dict[str, Tensor]


class Stage(L.LightningModule):
    """How a generator is learned. A subclass gives `training_step`.

    A batch is what the DataModule brings: `x_1` the scans in model space, (B, C, H, W); `x_0` noise, (B, *noise_shape);
    `u` uniform draws in [0, 1), (B,); `k` the number of each image in the run, (B,), from which further draws are
    counted (`r2flow.noise`).

    A stage of several losses and optimisers sets `automatic_optimization = False`, makes them by `optimizers_for` and
    takes a step of each in every `training_step`: `take_step(optimizer, loss)` for each of `own_optimizers()`.

    Args:
        generator: What learns. Its weights, and no others, are those of a checkpoint.
        learning_rate: AdamW's; warmed up linearly, then a cosine to 0 at the run's last step.
        betas: AdamW's.
        weight_decay: AdamW's.
        muon: Learning rate of the weight matrices by `Muon`, scheduled as AdamW's; None leaves them to AdamW.
        warmup_images: Images seen during the warm-up.
        batch_size: Images a step, which turns images into steps.
        seed: Run seed.

    Attributes:
        learns: Class of the generators that it can train.
        config: The run's, which goes into its checkpoints.
        gradient_clip_val: The run's, for a stage with manual optimisation, which clips for itself.
        further: What a batch holds beside, made of x_1, (C, H, W), and draws of each image by the loader's workers.
    """

    learns: ClassVar[type[Generator]] = Generator
    generator_name: ClassVar[str | None] = None  # what it trains; None: the parent's, or a rectified flow
    needs_pairs: ClassVar[bool] = False  # whether a batch's x_0 and x_1 belong together
    needs_parent: ClassVar[bool] = False  # whether it starts from another run, also where it learns from scans
    anneals: ClassVar[bool] = True  # whether the learning rate falls to 0 at the run's last step

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
            wanted, found = self.learns.__name__, type(generator).__name__
            raise InputError(f"{type(self).__name__} learns a {wanted}, found a {found}: give another stage.")
        super().__init__()
        self.generator = generator
        self.learning_rate, self.betas, self.weight_decay = learning_rate, betas, weight_decay
        self.muon = muon
        self.warmup_steps = warmup_images // batch_size
        self.seed = seed
        self.config: dict[str, Any] = {}
        self.gradient_clip_val: float | None = None
        self.further: Further | None = None

    def check_data(self, name: str, data: Mapping[str, Any]) -> None:
        """Refuse a config's `data` that the stage of this name cannot learn from."""
        on_pairs = data["name"] == "pairs"
        if self.needs_pairs and not on_pairs:
            raise InputError(f"stage={name} learns from pairs: give data=pairs, found {data['name']}.")
        if data.get("scans") is not None:
            raise InputError(f"stage={name} learns from pairs alone: leave data.scans out, or give stage=flow_map.")
        if on_pairs and not self.needs_pairs:
            raise InputError(f"stage={name} learns from scans, and data=pairs has none; give stage=reflow.")

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Dropout draws from torch's own generator: seeded by position, a resumed run draws the same.
        position = batch_idx * self.trainer.world_size + self.global_rank
        seed_torch(self.seed, "dropout", position)

    def configure_optimizers(self) -> Any:
        return self.optimizers_for(self.generator.parameters())

    def optimizers_for(self, *groups: Iterable[torch.nn.Parameter]) -> Any:
        """AdamW or `Muon` with its schedule for each group of parameters, as `configure_optimizers` returns them."""
        options: dict[str, Any] = {
            "lr": self.learning_rate,
            "betas": (self.betas[0], self.betas[1]),
            "eps": 1e-8,
            "weight_decay": self.weight_decay,
        }
        total = max(int(self.trainer.max_steps), 1)
        warmup = min(self.warmup_steps, total)

        def factor(step: int) -> float:
            return learning_rate_factor(step, warmup, total) if self.anneals or step < warmup else 1.0

        optimizers = [
            torch.optim.AdamW(group, **options) if self.muon is None else Muon(group, self.muon, **options)
            for group in groups
        ]
        schedules = [torch.optim.lr_scheduler.LambdaLR(one, factor) for one in optimizers]
        return optimizers, [{"scheduler": schedule, "interval": "step"} for schedule in schedules]

    def own_optimizers(self) -> list[LightningOptimizer]:
        """The optimisers of a stage with manual optimisation, in the order of `optimizers_for`.

        A step of the first advances `global_step`, at which a run resumes and which therefore must count batches.
        """
        found = self.optimizers()
        several = found if isinstance(found, list) else [found]
        for other in several[1:]:  # Lightning would count a step of each
            other._on_before_step = other._on_after_step = lambda: None
        return several

    def take_step(self, optimizer: LightningOptimizer, loss: Tensor) -> None:
        """One step of one of `own_optimizers` down the gradient of a loss, clipped and scheduled as the run says.

        Gradients of the loss by other optimisers' parameters are left; they are cleared before their own step.
        """
        optimizer.zero_grad()
        model = self.trainer.strategy.model
        # DDP waits for gradients of all parameters in every backward pass, and a loss has those of some.
        with model.no_sync() if isinstance(model, DistributedDataParallel) else nullcontext():
            self.manual_backward(loss)
        average_gradients(parameter for group in optimizer.param_groups for parameter in group["params"])
        optimizer.step()
        schedules = self.lr_schedulers() or []
        for schedule in schedules if isinstance(schedules, list) else [schedules]:
            if schedule.optimizer is optimizer.optimizer:
                schedule.step()  # type: ignore[call-arg]

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        if not self.automatic_optimization:  # gradients of float16 have been scaled back only now
            self.clip_gradients(optimizer, self.gradient_clip_val)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["config"] = self.config
        checkpoint |= self.generator.drawing()


class SingleLoss(Stage):
    """A stage with one loss of a batch. A subclass gives `regression_loss`."""

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        """The mean loss at the times that the stage makes of uniform draws u in [0, 1), (B,)."""
        raise NotImplementedError

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = self.regression_loss(batch, batch["u"])
        self.log("train/loss", loss, prog_bar=True, sync_dist=True)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        # A low-discrepancy sequence over [0, 1) instead of random times: a steadier figure from few scans.
        u = golden_sequence(batch["k"])
        loss = self.regression_loss(batch, u)
        self.log("val/loss", loss, prog_bar=True, batch_size=len(batch["x_1"]), sync_dist=True)


def learning_rate_factor(step: int, warmup: int, total: int) -> float:
    """step / warmup during the warm-up, then (1 + cos(pi s)) / 2 with s the share of the rest done."""
    if step < warmup:
        return step / warmup
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(total - warmup, 1)))
