"""Fixed-step solvers, Runge-Kutta and Adams methods, and their time grids."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.flow.solvers.solution import Evaluations, Solution, Velocity, finite, stepped


def uniform(t_0: float, t_1: float, steps: int) -> Tensor:
    """Equal steps; (steps + 1,) float64 on the CPU, even if the default device is meta."""
    return torch.linspace(t_0, t_1, steps + 1, dtype=torch.float64, device="cpu")


def power(t_0: float, t_1: float, steps: int, p: float) -> Tensor:
    """t = 1 - (1 - u)^p at equal steps of u: denser towards t = 1, where a 1-RF is most curved."""
    return 1 - uniform((1 - t_0) ** (1 / p), (1 - t_1) ** (1 / p), steps) ** p


def named_grid(name: str) -> Callable[[float, float, int], Tensor]:
    """A time grid by name, uniform or power:P, 1 <= P <= 10, the same backward in time."""
    if name == "uniform":
        return uniform
    found = re.fullmatch(r"power:(\d+\.?\d*)", name)
    p = float(found[1]) if found else 0.0
    if not 1 <= p <= 10:
        raise InputError(f"a time grid is uniform or power:P with P from 1 to 10; found {name!r}.")
    return partial(power, p=p)


def build_grid(grid: str | Sequence[float] | Tensor, t_0: float, t_1: float, steps: int) -> Tensor:
    """Times from t_0 to t_1, (N + 1,) float64 on the CPU; N = steps unless `grid` has the times."""
    if isinstance(grid, str):
        times = named_grid(grid)(t_0, t_1, steps)
    else:
        times = torch.as_tensor(grid, dtype=torch.float64, device="cpu").clone()
    one_way = len(times) > 1 and (times.diff() * (t_1 - t_0) > 0).all()
    if not one_way or max(abs(times[0] - t_0), abs(times[-1] - t_1)) > 1e-6:
        raise InputError(
            f"a time grid must have times that differ in float64, one way from {t_0:g} to {t_1:g}; "
            f"found {steps} steps on {grid}."
        )
    times[0] = float(t_0)  # undo rounding by float32 or powers
    times[-1] = float(t_1)
    return times


@dataclass(frozen=True)
class FixedStep:
    """A fixed-step method x(t) -> x(t + h)."""

    adapts = False  # whether step sizes follow from a tolerance

    step: Callable[..., Any]  # function of v, t, h and x: the next state
    order: int  # of the global error
    evaluations: int  # of v per step
    at_end: bool = False  # whether a step evaluates v at its end
    # Whether `step` makes such a function from the times of a solution, (N + 1,) float64.
    multistep: bool = False

    def solve(self, v: Evaluations, x: Tensor, times: Tensor) -> Solution:
        """Take the steps of a time grid, (N + 1,) float64.

        A scene whose state becomes non-finite keeps its last finite state; other scenes are not
        affected.
        """
        step = self.step(times) if self.multistep else self.step
        interval = sorted(times[[0, -1]].tolist())

        def inside(t: Tensor, state: Tensor) -> Tensor:
            return v(t.clamp(*interval), state)  # t + h can round to 1 + 1e-7

        alive = finite(x)
        # Times are moved to the device once, not per step.
        for t, h in zip(times[:-1].to(x), times.diff().to(x), strict=True):
            x, alive = stepped(x, step(inside, t, h, x), alive)
        v.accepted[:] = len(times) - 1
        v.converged[:] = alive.cpu()
        return v.solution(x)


def euler(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    """x + h v(t, x) (paper, eq. 4)."""
    return x + h * v(t, x)


def midpoint(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    return x + h * v(t + h / 2, x + h / 2 * v(t, x))


def heun2(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    k_1 = v(t, x)
    k_2 = v(t + h, x + h * k_1)
    return x + h / 2 * (k_1 + k_2)


def rk4(v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
    """Kutta's 3/8 rule, as torchdiffeq's rk4, which published R2Flow samples with."""
    k_1 = v(t, x)
    k_2 = v(t + h / 3, x + h / 3 * k_1)
    k_3 = v(t + h * 2 / 3, x + h * (k_2 - k_1 / 3))
    k_4 = v(t + h, x + h * (k_1 - k_2 + k_3))
    return x + h / 8 * (k_1 + 3 * (k_2 + k_3) + k_4)


class Adams3:
    """Step function of one solution by an Adams method of order 3, one evaluation per step.

    The predictor x_n + integral of P dt, where the line P interpolates the last two velocities,
    gives the point at which v is evaluated next. The corrector repeats the step with this velocity
    included in P (PEC mode: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I,
    III.1 and III.5). The last step is not corrected, which would need v(1, x). The first steps have
    fewer velocities, which preserves the order.

    The state between two steps is predicted: each call evaluates v there, corrects the previous
    step and predicts.
    """

    def __init__(self, times: Tensor) -> None:
        self.times = times.tolist()
        self.taken = 0
        self.velocities: list[Tensor] = []  # at the last times, newest last
        self.corrected: Tensor | None = None  # state at which the last step starts

    def __call__(self, v: Velocity, t: Tensor, h: Tensor, x: Tensor) -> Tensor:
        n = self.taken
        self.velocities = [*self.velocities, v(t, x)][-3:]
        self.taken += 1
        self.corrected = x if self.corrected is None else self._moved(self.corrected, n - 1, 3)
        return self._moved(self.corrected, n, 2)

    def _moved(self, x: Tensor, step: int, nodes: int) -> Tensor:
        """x plus the integral, over a step, of the polynomial through the last velocities."""
        velocities = self.velocities[-nodes:]
        times = self.times[self.taken - len(velocities) : self.taken]
        for weight, velocity in zip(
            _weights(times, *self.times[step : step + 2]), velocities, strict=True
        ):
            x = x + weight * velocity
        return x


def _weights(nodes: Sequence[float], start: float, end: float) -> list[float]:
    """w: sum w_i f_i is the integral of the polynomial through (nodes_i, f_i)."""
    powers = np.arange(1, len(nodes) + 1)
    basis = np.vander(np.subtract(nodes, start), increasing=True)
    return np.linalg.solve(basis.T, (end - start) ** powers / powers).tolist()
