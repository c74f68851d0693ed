"""Adams methods: one evaluation a step, and the velocities of earlier steps."""

import math
from collections.abc import Sequence
from functools import partial

from torch import Tensor

from r2flow.flow.solvers.fixed import FixedStep
from r2flow.flow.solvers.solution import Velocity


def adams(predictor: int, corrector: int = 0) -> FixedStep:
    """An Adams method for steps of any lengths, with one evaluation a step.

    The predictor x_n + integral of P dt, where the polynomial P passes through the last velocities, gives the point at
    which v is evaluated next. The corrector takes the step again, with that velocity among those of P (PEC mode:
    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, III.1 and III.5; UniPC does the same in
    lambda: Zhao and others, 2023). The last step is not corrected, which would take v(1, x): another step is worth
    more. With k velocities the predictor has order k and the corrector order k, from velocities at points of order
    k - 1: so the order is the greater of the two numbers.

    The first steps have fewer velocities. Up to order 3 the order survives that. A corrector of 4 takes Heun's step
    first, with one evaluation more, and corrects the first two steps together.

    Args:
        predictor: Velocities in the predictor.
        corrector: Velocities in the corrector, the new one included; 0 for no corrector (Adams-Bashforth).
    """
    return FixedStep(
        partial(_Adams, predictor, corrector), max(predictor, corrector), evaluations=1, start=int(corrector > 3),
        multistep=True, corrects=corrector > 0,
    )  # fmt: skip


class _Adams:
    """The steps of one solution.

    The state between two steps is a predicted one: each call evaluates v there, corrects the step before and predicts.
    """

    def __init__(self, predictor: int, corrector: int, times: Tensor) -> None:
        self.predictor, self.corrector, self.times = predictor, corrector, times.tolist()
        self.heun_first = corrector > 3
        self.taken = 0
        self.velocities: list[Tensor] = []  # at the last times, the newest at the end
        self.corrected: tuple[int, Tensor] | None = None  # a step and its state, from which the next correction starts

    def __call__(self, v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
        n = self.taken
        self.velocities = [*self.velocities, v(t, x)][-max(self.predictor, self.corrector) :]
        self.taken += 1
        if self.corrector and self.corrected is None:
            self.corrected = 0, x
        elif self.corrected is not None and not (self.heun_first and n == 1):
            start, before = self.corrected
            x = self._moved(before, start, n, self.corrector)
            self.corrected = n, x
        if self.heun_first and n == 0:
            k = self.velocities[0]
            return x + h / 2 * (k + v(t + h, x + h * k))
        return self._moved(x, n, n + 1, self.predictor)

    def _moved(self, x: Tensor, first: int, last: int, nodes: int) -> Tensor:
        """x and the integral over the steps from `first` to `last` of the polynomial through the last velocities."""
        known = self.velocities[-nodes:]
        at = self.times[self.taken - len(known) : self.taken]
        for weight, velocity in zip(weights(at, self.times[first], self.times[last]), known, strict=True):
            x = x + weight * velocity
        return x


def weights(nodes: Sequence[float], start: float, end: float) -> list[float]:
    """w such that sum w_i f_i is the integral from start to end of the polynomial through the (nodes_i, f_i).

    For up to 4 nodes: Gauss-Legendre's rule of two points is exact for cubic polynomials.
    """
    middle, half = (start + end) / 2, (end - start) / 2
    points = (middle - half / math.sqrt(3), middle + half / math.sqrt(3))

    def basis(i: int, t: float) -> float:
        return math.prod((t - other) / (nodes[i] - other) for j, other in enumerate(nodes) if j != i)

    return [half * sum(basis(i, t) for t in points) for i in range(len(nodes))]
