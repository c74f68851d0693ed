"""Flow map training: jumps of any length, from the paths of an earlier flow, its pairs or scans."""

from typing import Unpack

import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Options, Positive, construct
from r2flow.data.datamodule import ScanDataModule
from r2flow.flow.maps import OBJECTIVES, Aim, JumpTimes, straight
from r2flow.flow.path import expand_time, interpolate
from r2flow.flow.times import plastic_sequence
from r2flow.generators import FlowMap
from r2flow.samplers import Jump
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    SensorLike,
    StageArguments,
)
from r2flow.stages.rectify import Reflow


class LearnFlowMap(Reflow):
    """Flow map: regress u(x_t, t, s) onto the target of an objective of `r2flow.flow.maps`.

    The data are scans, or pairs of a 1-RF or 2-RF. With additional scans (`data.scans`) and the
    objective `straight`, velocities (s = t) are learned from the scans, as in `Rectify`, and jumps
    from the pairs.

    Args:
        objective: Name in `r2flow.flow.maps.OBJECTIVES`.
        jumps: Options of `r2flow.flow.maps.JumpTimes`.
        rho: Final value of rho, the share of the path in the target of a bootstrapped objective; it
            decays exponentially from 1 over the run. rho is always 1 for s = t and, on pairs, for
            the jump from 0 to 1.
    """

    learns = FlowMap
    generator: FlowMap
    generator_name = "flow_map"
    needs_pairs = False
    takes_scans = True

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        objective: str = "consistency",
        jumps: Options | None = None,
        rho: Positive = 0.01,
        loss: str = "pseudo_huber",
        **options: Unpack[StageArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            loss=loss,
            **options,
        )
        self.objective = OBJECTIVES[objective]
        self.rho = rho

    def prepare_generator(self) -> None:
        self.jumps = construct("stage.jumps", JumpTimes, self.hparams["jumps"])
        self.generator.run_by(Jump(grid=self.jumps.grid))

    def setup(self, stage: str) -> None:
        super().setup(stage)
        data = getattr(self.trainer, "datamodule", None)
        self.on_pairs = getattr(data, "pairs", None) is not None

    def check_data(self, data: ScanDataModule) -> None:
        super().check_data(data)
        if data.plan.scans is not None and self.objective is not straight:
            name = OBJECTIVES.name_of(self.objective)
            raise InputError(
                f"objective={name} learns jumps from velocities of pairs, which are not those of "
                "scans: leave data.scans out, or give stage.objective=straight."
            )

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        t, s = self.jumps(torch.cat([u[:, None], plastic_sequence(batch["k"])], 1))
        if not (self.training or self.on_pairs):
            t = s = self.jumps.velocities(u)  # scans have velocities only
        diagonal = t == s
        x_0 = batch["x_0"]
        x_1 = batch["x_1"]
        u_ts = self.generator.map(self.condition(batch))
        if self.training:
            # With independent noise, x_1 is not the end of x_0's path.
            exact = diagonal | (self.on_pairs & (s - t == 1))
            rho = torch.where(exact, 1.0, self.rho**self.progress)
            aim = self.objective(u_ts, x_0, x_1, t, torch.where(diagonal, t, s), rho)
        else:  # the same validation loss for all objectives
            aim = straight(u_ts, x_0, x_1, t, s, torch.ones_like(t))
        if "scan" in batch:
            x_t, v = interpolate(batch["noise"], batch["scan"], t)
            mask = expand_time(diagonal, x_t)
            aim = Aim(torch.where(mask, x_t, aim.x_t), torch.where(mask, v, aim.target))
        return self.loss(u_ts(t, aim.x_t, s), aim.target).mean()
