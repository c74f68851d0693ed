"""1-RF training: velocity regression on straight lines from noise to data."""

from collections.abc import Mapping
from typing import Any, ClassVar

from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.losses import LOSSES
from r2flow.flow.path import interpolate
from r2flow.flow.times import TIMES
from r2flow.generators import Condition, Flow, Generator
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
        if generator.told and type(self).condition is Rectify.condition:
            raise InputError(
                f"a {type(generator).__name__} needs a condition, and this stage gives none: give "
                "stage=transfer, or the stage that it was trained with."
            )
        self.loss = LOSSES[loss]
        self.time = TIMES.build(time or {"name": "uniform"})

    def condition(self, batch: Batch) -> Condition | None:
        """Condition of the velocity; None here."""
        return None

    def regression_loss(self, batch: Batch, u: Tensor) -> Tensor:
        t = self.time(u)
        x_t, u_t = interpolate(batch["x_0"], batch["x_1"], t)
        return self.loss(self.generator.velocity(t, x_t, self.condition(batch)), u_t).mean()
