"""How straight the paths are while a flow is trained."""

import lightning as L
import torch

from r2flow.errors import InputError
from r2flow.flow.straightness import curvature
from r2flow.generators import Flow
from r2flow.noise import Draws

from .ema import averaged_weights


class Curvature(L.Callback):
    """Every `every` steps, and at the end: int s(t) dt (paper, eq. 5) of a few scans from fixed noise.

    Logged as `curvature/s` and, over the squared length of the path, as `curvature/s_normalised`: an untrained
    flow is straight because it goes nowhere. One pass of `steps` Euler steps with the averaged weights; the
    whole of s(t), which takes two, is `r2flow report curvature`.

    Args:
        every: Steps between two measurements; 0 leaves them out.
        num: Scans a measurement.
        steps: Euler steps a scan.

    Raises:
        InputError: `every` is below 0, `num` or `steps` below 1.
    """

    def __init__(self, seed: int, every: int = 500, num: int = 2, steps: int = 16) -> None:
        if every < 0 or num < 1 or steps < 1:
            raise InputError(
                "callbacks.curvature needs every of at least 0, num and steps of at least 1; "
                f"found {every}, {num} and {steps}."
            )
        self.seed = seed
        self.every, self.num, self.steps = every, num, steps
        self._measured = 0

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        step = trainer.global_step
        due = self.every > 0 and step > 0 and (step % self.every == 0 or step == trainer.max_steps)
        # Under accumulation a step lasts several batches: the first one that ends it measures.
        if due and isinstance(pl_module.generator, Flow) and trainer.is_global_zero and step != self._measured:
            self._measured = step
            values = self._measure(trainer, pl_module)
            for logger in trainer.loggers:
                logger.log_metrics(values, step - 1)  # Lightning counts the step that was being taken

    def _measure(self, trainer: L.Trainer, pl_module: L.LightningModule) -> dict[str, float]:
        flow: Flow = pl_module.generator  # type: ignore[assignment]
        x_0 = Draws(self.seed, range(self.num)).start(flow.noise_shape).to(pl_module.device)
        training = pl_module.training
        with averaged_weights(trainer, pl_module), torch.no_grad():
            pl_module.eval()
            found = curvature(flow.velocity, x_0, self.steps)
            pl_module.train(training)
        return {
            "curvature/s": found.total.mean().item(),
            "curvature/s_normalised": found.normalised.mean().item(),
        }
