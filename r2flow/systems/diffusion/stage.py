"""Training of diffusion models."""

from collections.abc import Callable
from typing import Any

import torch.nn.functional as F
from torch import Tensor

from r2flow.registry import Positive, Registry
from r2flow.stages.base import Batch, SingleLoss
from r2flow.systems.diffusion.generator import Diffusion
from r2flow.systems.diffusion.process import noised

ERRORS: Registry[Callable[[Tensor, Tensor], Tensor]] = Registry(
    "error of an element",
    l2=lambda y, target: F.mse_loss(y, target, reduction="none"),
    l1=lambda y, target: F.l1_loss(y, target, reduction="none"),
    huber=lambda y, target: F.smooth_l1_loss(y, target, reduction="none"),
)


class LearnDiffusion(SingleLoss):
    """Regression of the prediction y(z_t, lambda_t) at t ~ Uniform[0, 1] (Kingma et al. 2021).

    Args:
        loss: Name in `ERRORS`.
        min_snr: gamma of the weight min(SNR, gamma) on the error of expected data; None: the SNR, which weights the
            noise's error equally.
        paired: Whether a sample's error has its own weight; False: the batch's mean, as in R2DM's published code.
    """

    learns = Diffusion
    generator: Diffusion
    generator_name = "diffusion"

    def __init__(
        self,
        *model: Any,
        loss: str = "l2",
        min_snr: Positive | None = 5.0,
        paired: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(*model, **options)
        self.error = ERRORS[loss]
        self.min_snr = min_snr
        self.paired = paired

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        """Weighted mean error at t = u (t = 0: data, t = 1: noise)."""
        diffusion, x, eps = self.generator, batch["x_1"], batch["x_0"]
        log_snr = diffusion.schedule(u)
        y = diffusion.predict(noised(x, log_snr, eps), log_snr)
        errors = self.error(y.float(), diffusion.prediction.target(x, eps, log_snr)).flatten(1).mean(1)
        weights = diffusion.prediction.weight(log_snr, self.min_snr)
        return (errors * weights).mean() if self.paired else errors.mean() * weights.mean()
