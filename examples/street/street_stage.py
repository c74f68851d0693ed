"""The stage that made the flow map in `street`: `stage=flow_map` with ends learned from scans, and a loss of their own.

r2flow train --plugin examples/street/street_stage.py --config-dir examples/street experiment=street_few stage.parent=MAP
"""

from typing import Any

import torch
from torch import Tensor

from r2flow.base.registry import Portion
from r2flow.data.datamodule import ScanDataModule
from r2flow.flow.losses import LOSSES, absolute
from r2flow.flow.path import expand_time, interpolate
from r2flow.flow.times import plastic_sequence
from r2flow.stages import STAGES
from r2flow.stages.base import Batch
from r2flow.stages.flow_map import LearnFlowMap


def gradient_matching(v_t: Tensor, u_t: Tensor) -> Tensor:
    """mean |r| + mean |dr / d row| + mean |dr / d column| (Li and Snavely 2018, MegaDepth, section 4.1)."""
    r = v_t.float() - u_t.float()
    loss = absolute(v_t, u_t)
    for dim in range(2, r.ndim):
        if r.shape[dim] > 1:
            loss = loss + r.diff(dim=dim).abs().flatten(1).mean(1)
    return loss


class LearnStreetMap(LearnFlowMap):
    """Jumps on the straight lines of pairs; velocities, and from `ends_from` on jumps to s = 1, on scans.

    On scans alone the jumps are those of the flow map that the run starts from.

    Args:
        end_loss: Loss of jumps to the end, in `r2flow.flow.losses.LOSSES`.
        ends_from: First time from which jumps to the end are learned from scans.
    """

    def __init__(
        self,
        *model: Any,
        end_loss: str = "gradient_matching",
        ends_from: Portion = 0.5,
        objective: str = "straight",
        **options: Any,
    ) -> None:
        super().__init__(*model, objective=objective, **options)
        self.end_loss, self.ends_from = LOSSES[end_loss], ends_from

    def check_data(self, data: ScanDataModule) -> None:
        """All data serve: scans, pairs or both."""

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        if not self.training:
            return super().regression_loss(batch, u)
        t, s = self.jumps(torch.cat([u[:, None], plastic_sequence(batch["k"])], 1))
        of_scans = (t == s) | ((s == 1) & (t >= self.ends_from))
        if not self.on_pairs:
            s = torch.where(of_scans, s, t)
        aim = interpolate(batch["x_0"], batch["x_1"], t)
        x_t, v = interpolate(batch.get("noise", batch["x_0"]), batch.get("scan", batch["x_1"]), t)
        here = expand_time(of_scans | (not self.on_pairs), x_t)
        x_t, target = torch.where(here, x_t, aim[0]), torch.where(here, v, aim[1])
        estimate = self.generator.map()(t, x_t, s)  # type: ignore[operator]
        ends = (s == 1) & (t < s)
        of_ends = self.end_loss(estimate, target)
        return torch.where(ends, of_ends, self.loss(estimate, target)).mean()


LOSSES.add("gradient_matching", gradient_matching)
STAGES.add("street_map", LearnStreetMap)
