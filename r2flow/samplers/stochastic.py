"""The stochastic differential equation of a flow: the ODE's law of x_t, with fresh noise (`r2flow.flow.stochastic`)."""

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from r2flow.flow.solvers.solution import finite, stepped
from r2flow.flow.stochastic import sde
from r2flow.registry import NonNegative, Portion
from r2flow.samplers.base import Condition, Generated, Grid, Noise, OnGrid, Progress


@dataclass(frozen=True)
class SDE(OnGrid):
    """Second order in law, one evaluation a step.

    Attributes:
        finish: Length of the last step, to the mean of x_1.
        churn: Noise that is replaced: 1 for the reversed diffusion, 0 for the ODE.
    """

    paired: ClassVar[bool] = False

    grid: Grid = "power:2.5"
    finish: Portion = 1 / 128
    churn: NonNegative = 1.0

    @property
    def draws(self) -> bool:  # type: ignore[override]
        return self.churn > 0

    def __call__(
        self,
        generator: Any,
        noise: Tensor,
        condition: Condition | None = None,
        draws: Noise | None = None,
        progress: Progress = None,
    ) -> Generated:
        assert draws is not None
        field, x, alive, times = generator.field(condition), noise, finite(noise), self.times()
        if self.finish and self.steps > 1:
            times = torch.cat([self.times(0.0, 1 - self.finish, fewer=1), times[-1:]])

        def estimate(t: Tensor, x: Tensor) -> Tensor:
            return x + (1 - t) * field(t, x).to(x)

        for following in sde(estimate, x, times, self.churn, draws):
            x, alive = stepped(x, following, alive)
            if progress is not None:
                progress()
        return Generated.after(x, self.steps, alive)
