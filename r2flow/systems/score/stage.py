"""Training by denoising score matching."""

from typing import Unpack

import torch
from torch import Tensor

from r2flow.base.registry import Natural, NonNegative
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    Betas,
    ModelArguments,
    SensorLike,
    SingleLoss,
)
from r2flow.systems.score.generator import ScoreModel, score_loss


class MatchScore(SingleLoss):
    """Denoising score matching at all noise levels alike
    (`r2flow.systems.score.generator.score_loss`).

    Args:
        power: Exponent of sigma in the weight of each level.
        learning_rate: Learning rate of AdamW, constant after a linear warm-up.
    """

    learns = ScoreModel
    generator: ScoreModel
    generator_name = "score"
    anneals = False

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        power: NonNegative = 2.0,
        learning_rate: NonNegative = 1e-4,
        betas: Betas = (0.9, 0.999),
        weight_decay: NonNegative = 0.0,
        muon: NonNegative | None = None,
        warmup_images: Natural = 0,
        **options: Unpack[ModelArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            learning_rate=learning_rate,
            betas=betas,
            weight_decay=weight_decay,
            muon=muon,
            warmup_images=warmup_images,
            **options,
        )
        self.power = power

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        network = self.generator.network
        labels = (u * len(network.sigmas)).to(torch.int64)
        return score_loss(
            network, (batch["x_1"] + 1) / 2, batch["x_0"], labels, network.sigmas, self.power
        ).mean()
