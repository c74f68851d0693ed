"""Guard against NaN: skips steps with a non-finite loss or gradient, and stops the run after too
many.
"""

import logging
import math
from typing import NoReturn

import lightning as L
import torch
from torch import Tensor
from torch.nn.utils import get_total_norm

from r2flow.base.errors import InputError
from r2flow.base.registry import Count, NonNegative
from r2flow.base.signals import wait_for_launcher
from r2flow.data.loader import RunSampler
from r2flow.model.paths import checkpoints_of

_log = logging.getLogger(__name__)


class Guard(L.Callback):
    """Skips steps with a non-finite loss or gradient, and stops the run after too many of them.

    A skipped step changes neither weights nor AdamW's averages; learning rate and data advance. The
    decision uses the gradients shared by all devices, so that all devices decide alike. With
    16-mixed, overflowing gradients adjust the
    loss scale: such steps are skipped too, but only count as an error if the scale falls below
    `lowest_scale` or `skips` steps are skipped in a row.

    In a stage with several optimisers, only the optimiser with non-finite gradients skips its step.

    Checkpoints with non-finite weights are not written; the run stops instead.

    Args:
        skips: Number of steps skipped in a row after which the run stops.
        lowest_scale: Smallest valid loss scale of 16-mixed.

    Attributes:
        in_a_row: Steps skipped since the last step taken.
        total: Steps skipped in the run, except those that only adjusted the loss scale.
    """

    def __init__(self, skips: Count = 10, lowest_scale: NonNegative = 1.0) -> None:
        self.skips = skips
        self.lowest_scale = lowest_scale
        self.in_a_row = 0
        self.total = 0
        self._losses: list[Tensor] = []
        self._found: list[bool] = []  # whether the gradients are finite, per optimiser in this step

    def on_before_backward(self, trainer, pl_module, loss):
        value = loss.detach()
        self._losses.append(value)
        # A loss can overflow while its gradient is finite, and on one device only. x - x is 0 or
        # NaN: adding it makes every gradient NaN in that case, and the sum over devices distributes
        # it to all of them.
        loss.register_hook(lambda gradient: gradient + (value - value))

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        gradients = [p.grad for p in parameters if p.grad is not None]
        finite = bool(torch.isfinite(get_total_norm(gradients)))  # the only device synchronisation
        if not finite:
            self._skip(trainer, first=all(self._found))
            for parameter in parameters:
                parameter.grad = None  # AdamW skips it and keeps its averages
        self._found.append(finite)

    def on_train_batch_end(self, *given):
        if self._found:  # else the batch was accumulated
            if all(self._found):
                self.in_a_row = 0
            self._losses.clear()
            self._found.clear()

    def _skip(self, trainer: L.Trainer, first: bool) -> None:
        """Count a skipped step, once for all optimisers, and stop the run after too many."""
        scaler = getattr(trainer.precision_plugin, "scaler", None)
        scale = float(scaler.get_scale()) if scaler else 1.0
        loss = trainer.strategy.reduce(torch.stack(self._losses).sum(), reduce_op="mean").item()
        loss /= scale
        overflow = bool(scaler) and math.isfinite(loss)
        self.in_a_row += first
        self.total += first and not overflow
        step = trainer.global_step + 1
        if self.in_a_row >= self.skips or (scaler and scale < self.lowest_scale):
            self._end(
                trainer,
                f"stopped at step {step}: steps skipped in a row for a non-finite loss or "
                f"gradient: {self.in_a_row}, {self.total} in the run. Loss {loss:g}, loss "
                f"scale {scale:g} of {trainer.precision}; {_describe_batch(trainer)}. "
                f"{_last_good(trainer)} Look at these scans; try trainer.precision=32-true or, in "
                "a run of another name, a lower stage.learning_rate.",
            )
        if trainer.is_global_zero and not overflow:
            _log.warning(
                "step %d skipped: non-finite gradient, loss %g (%d in a row; the run ends at %d)",
                step, loss, self.in_a_row, self.skips,
            )  # fmt: skip

    def on_save_checkpoint(self, trainer, pl_module, checkpoint):
        learned = [name for name, _ in pl_module.named_parameters()]
        for key in ("current_model_state", "state_dict"):
            state = checkpoint.get(key, {})
            weights = [state[name] for name in learned if name in state]
            if not torch.isfinite(get_total_norm(weights, math.inf)):
                self._end(
                    trainer,
                    f"stopped at step {trainer.global_step}: the weights or their average are no "
                    f"longer finite, so no checkpoint was written. {_last_good(trainer)} Start "
                    "under another name with a lower stage.learning_rate.",
                )

    def _end(self, trainer: L.Trainer, message: str) -> NoReturn:
        if not trainer.is_global_zero:
            wait_for_launcher()
        raise InputError(message)

    def state_dict(self):
        return {"in_a_row": self.in_a_row, "total": self.total}

    def load_state_dict(self, state_dict):
        vars(self).update(state_dict)


def _last_good(trainer: L.Trainer) -> str:
    """Sentence about the newest checkpoint of the run."""
    newest = next(iter(checkpoints_of(trainer.default_root_dir)), None)
    if newest is None:
        return "There is no checkpoint to resume from yet."
    return f"The last good checkpoint is {newest}, from which the same command resumes."


def _describe_batch(trainer: L.Trainer) -> str:
    """Describe the images and scans of the current step, on all devices and in all accumulated
    batches.
    """
    sampler = getattr(trainer.train_dataloader, "sampler", None)
    size = getattr(trainer.datamodule, "batch_size", None)  # type: ignore[attr-defined]
    if not isinstance(sampler, RunSampler) or sampler.order is None or size is None:
        return "images unknown to the loader"
    images = range(trainer.global_step * size, (trainer.global_step + 1) * size)
    scans = ", ".join(str(sampler.order[k]) for k in images)
    return f"images k = {images[0]} to {images[-1]}, scans {scans}"
