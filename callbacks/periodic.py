"""Base class of periodic callbacks."""

from abc import ABC, abstractmethod

import lightning as L
import torch

from .ema import averaged_weights


class Periodic(L.Callback, ABC):
    """Calls `act` every `every` steps and at the end, in the first process, with averaged weights in eval mode.

    Args:
        every: Steps between two calls; 0 for none.
    """

    def __init__(self, every: int) -> None:
        self.every, self._last = every, 0

    @abstractmethod
    def act(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Action of a subclass."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._last = trainer.global_step  # a resumed run has already acted at this step

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        step = trainer.global_step
        due = self.every > 0 and step > 0 and (step % self.every == 0 or step == trainer.max_steps)
        # With gradient accumulation a step spans several batches: act once per step.
        if due and trainer.is_global_zero and step != self._last:
            self._last, training = step, pl_module.training
            with averaged_weights(trainer, pl_module), torch.no_grad():
                pl_module.eval()
                self.act(trainer, pl_module)
                pl_module.train(training)
