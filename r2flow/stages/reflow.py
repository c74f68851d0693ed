"""k-RF and k-TD training: velocity regression on pairs drawn from an earlier flow."""

from collections.abc import Mapping
from typing import Any

from r2flow.errors import InputError
from r2flow.generators import Generator
from r2flow.generators.flow import ode_sampler
from r2flow.registry import Count
from r2flow.samplers import FixedSteps
from r2flow.stages.rectify import Rectify


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
        grid: Time grid: uniform as in the paper, or another one of `r2flow.flow.solvers.grids.named_grid`.
    """

    def __init__(
        self,
        generator: Generator,
        steps: Count = 1,
        grid: str = "uniform",
        **options: Any,
    ) -> None:
        if options.pop("time", None) is not None:
            raise InputError(
                f"a distilled flow trains at the {steps} times that its steps visit; leave stage.time out."
            )
        super().__init__(generator, time={"name": "discrete", "k": steps, "grid": grid}, **options)
        generator.run_by(FixedSteps(steps, grid), fixed=True)
