"""TwinFlow: a flow map that learns its single jump from its own draws, without a discriminator."""

from typing import Any

import torch
from torch import Tensor

from r2flow.flow.losses import mse
from r2flow.flow.path import interpolate
from r2flow.registry import NonNegative
from r2flow.stages.base import Batch
from r2flow.stages.flow_map import LearnFlowMap


class Twin(LearnFlowMap):
    """Flow map with two losses of its own draws x_g = z + u(z, 0, 1) besides that of a flow map.

    A second time of -t says that a state lies on a path to a draw, not to a scan:

        fake:    |u(x_t, t, -t) - (x_g - z)|^2,              x_t = (1 - t) z + t x_g
        rectify: |u(z, 0, 1) - sg[u(z, 0, 1) + v - v_g]|^2,  v = u(x', t, t), v_g = u(x', t, -t)

    with x_g without gradient and x' = (1 - t) z' + t x_g of other noise z' (TwinFlow, ICLR 2026).
    The difference of the two velocities is that of the scores of draws and scans; it is zero before
    training. A step costs three forward passes with gradients, and two without.

    Args:
        twin: Weight of both losses.
    """

    def __init__(self, *model: Any, twin: NonNegative = 1.0, **options: Any) -> None:
        super().__init__(*model, **options)
        self.weight = twin

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        loss = super().regression_loss(batch, u)
        if not self.training:
            return loss
        jump = self.generator.map(self.condition(batch))
        z = batch["x_0"]
        start = torch.zeros_like(u)
        step = jump(start, z, start + 1)
        x_g = (z + step).detach()
        x_t, v = interpolate(z, x_g, u)
        fake = mse(jump(u, x_t, -u), v)
        x_t, _ = interpolate(z.roll(1, 0), x_g, u)
        with torch.no_grad():
            target = step + jump(u, x_t, u) - jump(u, x_t, -u)
        return loss + self.weight * (fake + mse(step, target)).mean()
