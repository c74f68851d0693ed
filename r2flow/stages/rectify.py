"""Velocity regression on straight lines from noise to data: 1-RF, and k-RF and k-TD on pairs of an
earlier flow.
"""

from typing import ClassVar, Unpack

from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Count
from r2flow.flow.losses import LOSSES
from r2flow.flow.path import interpolate
from r2flow.flow.times import TIMES
from r2flow.generators import Condition, Flow, Generator
from r2flow.generators.flow import ode_sampler
from r2flow.samplers import FixedSteps
from r2flow.stages.base import (
    BackboneLike,
    Batch,
    SensorLike,
    SingleLoss,
    StageArguments,
    TimeLike,
)


class Rectify(SingleLoss):
    """1-RF: regress v(t, x_t) onto x_1 - x_0 for independent x_0 ~ N(0, I) and x_1 a scan (paper,
    eq. 2).

    Args:
        loss: Loss of the velocity, a name in `r2flow.flow.losses.LOSSES`.
        time: Name and options of the density of t, in `r2flow.flow.times.TIMES`.

    Raises:
        InputError: the generator is not a flow or takes a condition; an unknown loss or density.
    """

    learns: ClassVar[type[Generator]] = Flow
    generator: Flow

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        loss: str = "mse",
        time: TimeLike = "uniform",
        **options: Unpack[StageArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            **options,
        )
        if self.generator.takes_condition and type(self).condition is Rectify.condition:
            name = type(self.generator).__name__
            raise InputError(f"a {name} needs a condition: give stage=transfer, or its own stage.")
        self.loss = LOSSES[loss]
        self.time = TIMES.build(time)

    def forward(self, t: Tensor, x: Tensor) -> Tensor:
        """v(t, x), (B, C, H, W), at times t of shape () or (B,)."""
        return self.generator.velocity(t, x)

    def condition(self, batch: Batch) -> Condition | None:
        """Condition of the velocity; None here."""
        return None

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        t = self.time(u)
        x_t, u_t = interpolate(batch["x_0"], batch["x_1"], t)
        v_t = self.generator.velocity(t, x_t, self.condition(batch))
        return self.loss(v_t, u_t).mean()


class Reflow(Rectify):
    """k-RF: regress v(t, x_t) onto x_1 - x_0 with x_1 the end of the earlier flow's path from x_0
    (paper, eq. 3).

    It starts from the earlier flow's averaged weights (`parent`). Its pairs (x_0, x_1) are those of
    `data=pairs`.
    """

    needs_pairs = True
    takes_pairs = True

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        loss: str = "pseudo_huber",
        time: TimeLike = "u_shaped",
        **options: Unpack[StageArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            loss=loss,
            time=time,
            **options,
        )

    def prepare_generator(self) -> None:
        # The ODE alone: fresh noise on the way would break the pairing.
        self.generator.run_by(ode_sampler(self.generator), self.generator.few)


class Distill(Reflow):
    """k-TD: the reflow regression at t in {0, 1/k, ..., (k-1)/k}, the times that k Euler steps
    visit.

    Args:
        steps: k, the number of sampling steps.
        grid: Time grid: uniform as in the paper, or another one of
            `r2flow.flow.solvers.fixed.named_grid`.
    """

    def __init__(
        self,
        backbone: BackboneLike = None,
        sensor: SensorLike = None,
        *,
        steps: Count = 2,
        grid: str = "uniform",
        loss: str = "pseudo_huber",
        **options: Unpack[StageArguments],
    ) -> None:
        super().__init__(
            backbone,
            sensor,
            loss=loss,
            time={"name": "discrete", "k": steps, "grid": grid},
            **options,
        )

    def prepare_generator(self) -> None:
        self.generator.run_by(FixedSteps(self.hparams["steps"], self.hparams["grid"]), fixed=True)
