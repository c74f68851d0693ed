"""1-RF: a velocity learned on straight lines from noise to data."""

import math
from collections.abc import Mapping
from typing import Any

import lightning as L
import torch
from torch import Tensor, nn

from r2flow.flow.losses import LOSSES
from r2flow.flow.path import interpolate
from r2flow.flow.times import TIMES
from r2flow.noise import seed_torch

Batch = dict[str, Tensor]

GOLDEN_RATIO = (math.sqrt(5) - 1) / 2


class RectifiedFlow(L.LightningModule):
    """1-RF: regress v(t, x_t) onto x_1 - x_0 for independent x_0 ~ N(0, I) and x_1 a scan (paper, eq. 2).

    Args:
        velocity: The backbone, v(t, x) with t (B,) and x (B, C, H, W).
        loss: Name in `r2flow.flow.losses.LOSSES`.
        time: Name and options of a density in `r2flow.flow.times.TIMES`.
        learning_rate: AdamW's; warmed up linearly, then a cosine to 0 at the run's last step.
        betas: AdamW's.
        weight_decay: AdamW's.
        warmup_images: Images seen during the warm-up.
        batch_size: Images a step, which turns images into steps.
        seed: Run seed.
    """

    needs_pairs = False  # a batch's x_0 and x_1 are independent

    def __init__(
        self,
        velocity: nn.Module,
        loss: str = "mse",
        time: Mapping[str, Any] | None = None,
        learning_rate: float = 1e-4,
        betas: tuple[float, float] = (0.9, 0.99),
        weight_decay: float = 0.0,
        warmup_images: int = 80_000,
        batch_size: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.velocity = velocity
        self.loss = LOSSES[loss]
        self.time = TIMES.build(time or {"name": "uniform"})
        self.learning_rate, self.betas, self.weight_decay = learning_rate, betas, weight_decay
        self.warmup_steps = warmup_images // batch_size
        self.seed = seed
        self.config: dict[str, Any] = {}

    def coupling(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """(x_0, x_1) as the data bring them: independent noise of image k, or the pair's own."""
        return batch["x_0"], batch["x_1"]

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        x_0, x_1 = self.coupling(batch)
        t = self.time(batch["u"])
        x_t, u_t = interpolate(x_0, x_1, t)
        loss = self.loss(self.velocity(t, x_t), u_t).mean()
        self.log("train/loss", loss, prog_bar=True, sync_dist=True)
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        x_0, x_1 = self.coupling(batch)
        # A low-discrepancy sequence over [0, 1) instead of random times: a steadier figure from few scans.
        t = self.time(((batch["k"] + 0.5) * GOLDEN_RATIO % 1).to(x_1.dtype))
        x_t, u_t = interpolate(x_0, x_1, t)
        loss = self.loss(self.velocity(t, x_t), u_t).mean()
        self.log("val/loss", loss, prog_bar=True, batch_size=len(x_1), sync_dist=True)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        # Dropout draws from torch's own generator: seeded by position, a resumed run draws the same.
        position = batch_idx * self.trainer.world_size + self.global_rank
        seed_torch(self.seed, "dropout", position)

    def configure_optimizers(self) -> Any:
        optimizer = torch.optim.AdamW(
            self.velocity.parameters(),
            lr=self.learning_rate,
            betas=(self.betas[0], self.betas[1]),
            eps=1e-8,
            weight_decay=self.weight_decay,
        )
        total = max(int(self.trainer.max_steps), 1)
        warmup = min(self.warmup_steps, total)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: learning_rate_factor(step, warmup, total))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        checkpoint["config"] = self.config


def learning_rate_factor(step: int, warmup: int, total: int) -> float:
    """step / warmup during the warm-up, then (1 + cos(pi s)) / 2 with s the share of the rest done."""
    if step < warmup:
        return step / warmup
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(total - warmup, 1)))
