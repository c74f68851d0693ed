"""SDE sampler of a flow: the density of x_t is that of the ODE, with fresh noise in each step.

A flow's state is a mean and noise, x_t = t x_1hat + (1 - t) x_0hat, with

    x_1hat = x_t + (1 - t) v = E[x_1 | x_t],        x_0hat = x_t - t v = E[x_0 | x_t].

The ODE keeps its noise; the SDE replaces a part of it. A step from t to s keeps the share e^(-c h)
of x_0hat, with the log-SNR lambda = 2 log(t / (1 - t)) and h = (lambda_s - lambda_t) / 2 (Song et
al. 2021, score-based generative modeling through stochastic differential equations; c = tau^2 in
Xue et al. 2023, SA-Solver). c = 0 is the ODE, c = 1 the reverse-time SDE. For the exact v of
independent x_0 and x_1 (a 1-RF's), the distribution does not depend on c.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from r2flow.base.registry import NonNegative, Portion
from r2flow.flow.solvers.fixed import build_grid
from r2flow.flow.solvers.solution import finite, stepped
from r2flow.samplers.base import Generated, Grid, Known, Noise, OnGrid, Tick

_Estimate = Callable[[Tensor, Tensor], Tensor]  # x_1hat(t, x_t) with t of shape ()

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


class Step(NamedTuple):
    """Coefficients of x_s = keep x_t + now x_1hat(t) + before x_1hat(t_b) + fresh e."""

    keep: float
    now: float
    before: float
    fresh: float


def sde_step(t: float, s: float, c: float, t_b: float | None = None) -> Step:
    """Exact step of the SDE from t to s for an x_1hat linear in time, from its values at t, t_b.

    With a = 1 + c and the odds o = t / (1 - t) the solution is

        x_s = (1 - s) / (1 - t) e^(-ch) x_t + s a int e^(-a(l_s - l)) x_1hat dl
            + (1 - s) (1 - e^(-2ch))^(1/2) e

    with l = log o from l_t to l_s = l_t + h. The integral of a constant is 1 - e^(-ah), that of (t'
    - t) is, by parts, s - t - int_t^s (o' / o_s)^a dt'. A step from t = 0 adds no fresh noise; a
    step to s = 1 ends at x_1hat (Euler). c is the churn, t_b the time of the previous step; the
    first step has none.
    """
    if s >= 1:
        return Step(0.0, 1.0, 0.0, 0.0)
    if t <= 0:
        c = 0.0
    odds = t / (1 - t) / (s / (1 - s))
    kept = odds**c  # e^(-ch)
    now = s * (1 - odds ** (1 + c))
    before = 0.0
    if t_b is not None:
        at = (s - t) / 2 * _NODES + (s + t) / 2
        share = (at / (1 - at) / (s / (1 - s))) ** (1 + c)
        before = -s * ((s - t) - (s - t) / 2 * float(_WEIGHTS @ share)) / (t - t_b)
        now -= before
    return Step((1 - s) / (1 - t) * kept, now, before, (1 - s) * math.sqrt(1 - kept**2))


def sde(estimate: _Estimate, x: Tensor, times: Tensor, c: float, noise: Noise) -> Iterator[Tensor]:
    """Yield the state after each step, (B, ...); the last one is x_1. One estimate per step.

    Order 2 in distribution if x_1hat is linear in x. `times` increase from 0 to 1, (N + 1,)
    float64.
    """
    previous: tuple[float, Tensor] | None = None
    for j, (t, s) in enumerate(pairwise(times.tolist()), start=1):
        step = sde_step(t, s, c, None if previous is None else previous[0])
        x_1 = estimate(x.new_full((), t), x)
        x = step.keep * x + step.now * x_1
        if previous is not None and step.before:
            x = x + step.before * previous[1]
        if step.fresh:  # c > 0
            x = x + step.fresh * noise(j)
        previous = t, x_1
        yield x


def back(x: Tensor, r: float, s: float, e: Tensor) -> Tensor:
    """A sample of x_s given x_r, s <= r, with fresh noise e ~ N(0, 1):

    x_s = (s / r) x_r + ((1 - s)^2 - (s / r)^2 (1 - r)^2)^(1/2) e
    """
    share = s / r
    return share * x + math.sqrt(max((1 - s) ** 2 - (share * (1 - r)) ** 2, 0.0)) * e


@dataclass(frozen=True)
class SDE(OnGrid):
    """SDE sampler of order 2 in distribution, one evaluation per step."""

    paired = False

    grid: Grid = "power:2.5"
    # Length of the last step, which ends at the mean of x_1; 0: as in the grid.
    finish: Portion = 1 / 128
    churn: NonNegative = 1.0  # noise replacement: 1 is the reverse-time SDE, 0 the ODE

    @property
    def draws(self) -> bool:  # type: ignore[override]
        return self.churn > 0

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        field = generator.field(condition)
        x = noise
        alive = finite(x)
        times = self.times()
        if self.finish and self.steps > 1:
            times[:-1] = build_grid(self.grid, 0.0, 1 - self.finish, self.steps - 1)

        def estimate(t: Tensor, x: Tensor) -> Tensor:
            return x + (1 - t) * field(t, x).to(x)

        for following in sde(estimate, x, times, self.churn, draws):
            x, alive = stepped(x, following, alive)
            progress()
        return Generated.after(x, self.steps, alive)
