"""Training by denoising score matching."""

from typing import Any

import torch
from torch import Tensor

from r2flow.base.registry import NonNegative
from r2flow.stages.base import Batch, SingleLoss
from r2flow.systems.score.generator import ScoreModel, score_loss


class MatchScore(SingleLoss):
    """Denoising score matching at all noise levels alike
    (`r2flow.systems.score.generator.score_loss`).

    Args:
        power: Exponent of sigma in the weight of each level.
        options: Those of `Stage`. The learning rate does not fall.
    """

    learns = ScoreModel
    generator: ScoreModel
    generator_name = "score"
    anneals = False

    def __init__(self, *model: Any, power: NonNegative = 2.0, **options: Any) -> None:
        super().__init__(*model, **options)
        self.power = power

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        network = self.generator.network
        labels = (u * len(network.sigmas)).to(torch.int64)
        return score_loss(
            network, (batch["x_1"] + 1) / 2, batch["x_0"], labels, network.sigmas, self.power
        ).mean()
