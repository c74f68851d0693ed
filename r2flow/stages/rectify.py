"""Velocity regression on straight lines from noise to data: 1-RF, and k-RF and k-TD on pairs of an earlier flow."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from r2flow.errors import check
from r2flow.flow.losses import LOSSES, Loss
from r2flow.flow.path import interpolate
from r2flow.flow.times import build_density
from r2flow.generators import Condition, Flow, Generator
from r2flow.generators.flow import ode_sampler
from r2flow.registry import Count
from r2flow.samplers import FixedSteps
from r2flow.stages.base import Batch, SingleLoss


class Rectify(SingleLoss):
    """1-RF: regress v(t, x_t) onto x_1 - x_0 for independent x_0 ~ N(0, I) and x_1 a scan (paper, eq. 2).

    Args:
        loss: Name in `r2flow.flow.losses.LOSSES`.
        time: Name and options of a density in `r2flow.flow.times.TIMES`.

    Raises:
        InputError: the generator is not a flow or takes a condition; an unknown loss or density.
    """

    learns: ClassVar[type[Generator]] = Flow
    generator: Flow

    def __init__(
        self, generator: Generator, loss: str = "mse", time: Mapping[str, Any] | None = None, **options: Any
    ) -> None:
        super().__init__(generator, **options)
        given = not generator.told or type(self).condition is not Rectify.condition
        check(given, f"a {type(generator).__name__} needs a condition: give stage=transfer, or its own stage.")
        self.loss = LOSSES[loss]
        self.time = build_density(time or {"name": "uniform"})

    def condition(self, batch: Batch) -> Condition | None:
        """Condition of the velocity; None here."""
        return None

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        t = self.time(u)
        x_t, u_t = interpolate(batch["x_0"], batch["x_1"], t)
        return self.loss_of_each(self.loss, self.generator.velocity(t, x_t, self.condition(batch)), u_t).mean()

    def loss_of_each(self, loss: Loss, v_t: Tensor, u_t: Tensor) -> Tensor:
        """The loss of each scan of a batch, (B,); InputError: a loss of another shape."""
        each, b = loss(v_t, u_t), len(v_t)
        check(each.shape == (b,), f"a loss must give one value a scan, ({b},), found {tuple(each.shape)}.")
        return each


class Reflow(Rectify):
    """k-RF: regress v(t, x_t) onto x_1 - x_0 with x_1 the end of the earlier flow's path from x_0 (paper, eq. 3).

    It starts from the earlier flow's averaged weights. The pairs (x_0, x_1) come from `data=pairs`.
    """

    needs_pairs = True

    def __init__(
        self, generator: Generator, loss: str = "pseudo_huber", time: Mapping[str, Any] | None = None, **options: Any
    ) -> None:
        super().__init__(generator, loss, time or {"name": "u_shaped", "a": 4.0}, **options)
        generator.run_by(ode_sampler(self.generator), generator.few)  # fresh noise would break the pairing


class Distill(Reflow):
    """k-TD: the reflow regression at t in {0, 1/k, ..., (k-1)/k}, the times that k Euler steps visit.

    Args:
        steps: k, the number of sampling steps.
        grid: Time grid: uniform as in the paper, or another one of `r2flow.flow.solvers.fixed.named_grid`.
    """

    def __init__(self, generator: Generator, steps: Count = 1, grid: str = "uniform", **options: Any) -> None:
        time = options.pop("time", None)
        check(time is None, f"a distilled flow trains at the {steps} times that its steps visit; leave stage.time out.")
        super().__init__(generator, time={"name": "discrete", "k": steps, "grid": grid}, **options)
        generator.run_by(FixedSteps(steps, grid), fixed=True)
