"""Solvers that take the steps of a time grid."""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.solution import Evaluations, Solution, Velocity, finite

Step = Callable[[Velocity, Tensor, Tensor, Tensor], Tensor]


class FixedStep(NamedTuple):
    """One step x(t) -> x(t + h), the order of its global error, and its evaluations of the velocity.

    A multistep method is a class: every solution makes an instance, which remembers the earlier steps.
    """

    step: Step | type
    order: int
    evaluations: int


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


class AB2:
    """Two-step Adams-Bashforth, x + h ((1 + w/2) v_n - w/2 v_(n-1)) with w = h_n / h_(n-1); Euler first.

    Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, III.5: steps may differ in length. The one Euler
    step has an error of second order, so that the order stays 2.
    """

    def __init__(self) -> None:
        self.before: tuple[Tensor, Tensor] | None = None

    def __call__(self, v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
        k = v(t, x)
        if self.before is None:
            following = x + h * k
        else:
            k_before, h_before = self.before
            w = h / h_before
            following = x + h * ((1 + w / 2) * k - w / 2 * k_before)
        self.before = k, h
        return following


def solve_fixed(v: Evaluations, x: Tensor, times: Tensor, method: FixedStep, finish: Tensor | None) -> Solution:
    """Take the steps of a time grid, (N + 1,) float64, then an Euler step of length `finish` if there is one.

    A scene whose state is no longer finite keeps its last finite one; the others are not affected.
    """
    step = method.step() if isinstance(method.step, type) else method.step
    steps = [(t, following - t, step) for t, following in pairwise(times)]
    if finish is not None:
        steps.append((times[-1], finish, euler))
    low, high = sorted((float(times[0]), float(times[-1])))

    def inside(t: Tensor, state: Tensor) -> Tensor:
        return v(t.clamp(low, high), state)  # t + h can round to 1 + 1e-7

    alive = finite(x)
    for t, h, advance in steps:
        following = advance(inside, t.to(x), h.to(x), x)
        alive = alive & finite(following)
        x = torch.where(expand_time(alive, x), following, x)
    return Solution.build(x, v.counts, len(times) - 1, 0, False, alive.cpu().numpy())
