"""Solvers that take the steps of a time grid."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple, cast

import torch
from torch import Tensor

from r2flow.flow.solvers.solution import Evaluations, Solution, Velocity, finite, stepped

Step = Callable[[Velocity, Tensor, Tensor, Tensor], Tensor]


class FixedStep(NamedTuple):
    """One step x(t) -> x(t + h).

    Attributes:
        step: A function of v, t, h and x; in a multistep method, whose steps remember the earlier ones, what makes
            that function from the times of a solution, (N + 1,) float64.
        order: Of the global error.
        evaluations: Of the velocity, in a step.
        start: Further ones in the first step.
        multistep: Whether `step` makes the step function.
        corrects: Whether that function has a corrector.
    """

    step: Step | Callable[[Tensor], Step]
    order: int
    evaluations: int
    start: int = 0
    multistep: bool = False
    corrects: bool = False

    def begin(self, times: Tensor) -> Step:
        """The step function of a solution on these times."""
        return cast(Callable[[Tensor], Step], self.step)(times) if self.multistep else cast(Step, self.step)

    def cost(self, steps: int) -> int:
        """Evaluations of a number of steps."""
        return self.start + steps * self.evaluations


def euler(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    """x + h v(t, x) (paper, eq. 4)."""
    return x + h * v(t, x)


def midpoint(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    return x + h * v(t + h / 2, x + h / 2 * v(t, x))


def heun2(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    k_1 = v(t, x)
    k_2 = v(t + h, x + h * k_1)
    return x + h / 2 * (k_1 + k_2)


def heun3(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    k_1 = v(t, x)
    k_2 = v(t + h / 3, x + h / 3 * k_1)
    k_3 = v(t + 2 * h / 3, x + 2 * h / 3 * k_2)
    return x + h / 4 * (k_1 + 3 * k_3)


def rk4(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    """The classical Runge-Kutta method."""
    k_1 = v(t, x)
    k_2 = v(t + h / 2, x + h / 2 * k_1)
    k_3 = v(t + h / 2, x + h / 2 * k_2)
    k_4 = v(t + h, x + h * k_3)
    return x + h / 6 * (k_1 + 2 * k_2 + 2 * k_3 + k_4)


def solve_fixed(
    v: Evaluations, x: Tensor, times: Tensor, method: FixedStep, finish: Tensor | None, knots: int = 0
) -> Solution:
    """Take the steps of a time grid, (N + 1,) float64, then an Euler step of length `finish` if there is one.

    `knots` inner states are kept, equally many steps apart.

    A scene whose state is no longer finite keeps its last finite one; the others are not affected.
    """
    step = method.begin(times)
    steps = [(t, following - t, step) for t, following in pairwise(times)]
    if finish is not None:
        steps.append((times[-1], finish, euler))
    low, high = sorted((float(times[0]), float(times[-1])))

    def inside(t: Tensor, state: Tensor) -> Tensor:
        return v(t.clamp(low, high), state)  # t + h can round to 1 + 1e-7

    alive = finite(x)
    kept = []
    for n, (t, h, advance) in enumerate(steps):
        if knots and n and n % (len(steps) // (knots + 1)) == 0:
            kept.append(x)
        x, alive = stepped(x, advance(inside, t.to(x), h.to(x), x), alive)
    solution = Solution.build(x, v.counts, len(times) - 1, 0, False, alive.cpu().numpy())
    return replace(solution, knots=torch.stack(kept, 1)) if knots else solution
