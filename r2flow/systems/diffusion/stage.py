"""Training of diffusion models."""

from typing import Unpack

import torch.nn.functional as F
from torch import Tensor

from r2flow.base.registry import Positive, Registry
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    SensorLike,
    SingleLoss,
    StageArguments,
)
from r2flow.systems.diffusion.generator import Diffusion
from r2flow.systems.diffusion.process import noised

_ERRORS = Registry("error of an element", l2=F.mse_loss, l1=F.l1_loss, huber=F.smooth_l1_loss)


class LearnDiffusion(SingleLoss):
    """Regression of the prediction y(z_t, lambda_t) at t ~ Uniform[0, 1] (Kingma et al. 2021).

    Args:
        loss: Name in `_ERRORS`.
        min_snr: gamma of the weight min(SNR, gamma) on the error of expected data; None: the SNR,
            which weights the noise's error equally.
        paired: Whether a sample's error has its own weight; False: the batch's mean, as in R2DM's
            published code.
    """

    learns = Diffusion
    generator: Diffusion
    generator_name = "diffusion"

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        loss: str = "l2",
        min_snr: Positive | None = 5.0,
        paired: bool = True,
        **options: Unpack[StageArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            **options,
        )
        self.error = _ERRORS[loss]
        self.min_snr = min_snr
        self.paired = paired

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        """Weighted mean error at t = u (t = 0: data, t = 1: noise)."""
        x = batch["x_1"]
        eps = batch["x_0"]
        prediction = self.generator.prediction
        log_snr = self.generator.schedule(u)
        y = self.generator.predict(noised(x, log_snr, eps), log_snr)
        target = prediction.target(x, eps, log_snr)
        errors = self.error(y.float(), target, reduction="none").flatten(1).mean(1)
        weights = prediction.weight(log_snr, self.min_snr)
        return (errors * weights).mean() if self.paired else errors.mean() * weights.mean()
