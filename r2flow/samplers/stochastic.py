"""The stochastic differential equation of a flow: the ODE's law of x_t, with fresh noise on the way.

A flow's state is a mean and noise, x_t = t x_1hat + (1 - t) x_0hat, with

    x_1hat = x_t + (1 - t) v = E[x_1 | x_t],        x_0hat = x_t - t v = E[x_0 | x_t].

The ODE keeps its noise. The stochastic differential equation with the same density of x_t at every time t replaces a
part of it steadily: of a step from t to s it keeps the share e^(-c h) of x_0hat, with the log-SNR lambda = 2 log(t / (1
- t)) and h = (lambda_s - lambda_t) / 2 (Song et al. 2021, score-based generative modeling through stochastic
differential equations; c = tau^2 in Xue et al. 2023, SA-Solver). c = 0 is the ODE and c = 1 the reversed diffusion. For
the exact v the scans have the same distribution at any c.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.solution import finite, stepped
from r2flow.registry import NonNegative, Portion
from r2flow.samplers.base import Call, Fresh, Generated, Given, Grid, Noise, OnGrid

Estimate = Callable[[Tensor, Tensor], Tensor]  # x_1hat of t, of shape (), and x_t

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


class Step(NamedTuple):
    """x_s = keep x_t + now x_1hat(t) + before x_1hat(t_b) + fresh e, e ~ N(0, 1), from the last two x_1hat."""

    keep: float
    now: float
    before: float
    fresh: float


def sde_step(t: float, s: float, c: float, t_b: float | None = None) -> Step:
    """The step from t to s of the SDE with an x_1hat that is linear in time, known at t and at t_b < t.

    With a = 1 + c and the odds o = t / (1 - t) it has the solution

        x_s = (1 - s) / (1 - t) e^(-ch) x_t + s a int e^(-a(l_s - l)) x_1hat dl + (1 - s) (1 - e^(-2ch))^(1/2) e

    with l = log o from l_t to l_s = l_t + h. The integral of a constant is 1 - e^(-ah), that of (t' - t) is, by parts,
    s - t - int_t^s (o' / o_s)^a dt'. From t = 0, where all is noise, no noise is fresh; at s = 1 none is left, and the
    step goes to x_1hat (Euler's rule).

    Args:
        c: Share of fresh noise, at least 0.
        t_b: None in the first step.
    """
    if s >= 1:
        return Step(0.0, 1.0, 0.0, 0.0)
    c = c if t > 0 else 0.0
    odds = t / (1 - t) / (s / (1 - s))
    kept = odds**c  # e^(-ch)
    constant = 1 - odds ** (1 + c)
    now, before = s * constant, 0.0
    if t_b is not None:
        at = (s - t) / 2 * _NODES + (s + t) / 2
        share = (at / (1 - at) / (s / (1 - s))) ** (1 + c)
        before = -s * ((s - t) - (s - t) / 2 * float(_WEIGHTS @ share)) / (t - t_b)
        now -= before
    return Step((1 - s) / (1 - t) * kept, now, before, (1 - s) * math.sqrt(1 - kept**2))


def sde(estimate: Estimate, x: Tensor, times: Tensor, c: float, noise: Noise | None) -> Iterator[Tensor]:
    """The states after each step, (B, ...); the last one is x_1. One estimate a step.

    Where x_1hat is linear in x the law of x_1 is of order 2 in the steps. `times` rise from 0 to 1, (N + 1,) float64.
    """
    former: tuple[float, Tensor] | None = None
    for j, (t, s) in enumerate(pairwise(times.tolist()), start=1):
        step = sde_step(t, s, c, None if former is None else former[0])
        x_1 = estimate(torch.tensor(t, dtype=torch.float64).to(x), x)
        x = step.keep * x + step.now * x_1
        if former is not None and step.before:
            x = x + step.before * former[1]
        if step.fresh and noise is not None:  # the ODE, c = 0, takes none
            x = x + step.fresh * noise(j)
        former = t, x_1
        yield x


def back(x: Tensor, r: float, s: float, e: Tensor) -> Tensor:
    """x_s in law from x_r, s <= r, by fresh noise: (s / r) x_r + ((1 - s)^2 - (s / r)^2 (1 - r)^2)^(1/2) e."""
    share = s / r
    return share * x + math.sqrt(max((1 - s) ** 2 - (share * (1 - r)) ** 2, 0.0)) * e


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

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        field, x, alive, times = generator.field(condition), noise, finite(noise), self.times()
        if self.finish and self.steps > 1:
            times = torch.cat([self.times(0.0, 1 - self.finish, fewer=1), times[-1:]])

        def estimate(t: Tensor, x: Tensor) -> Tensor:
            return x + (1 - t) * field(t, x).to(x)

        for following in sde(estimate, x, times, self.churn, draws):
            x, alive = stepped(x, following, alive)
            progress()
        return Generated.after(x, self.steps, alive)
