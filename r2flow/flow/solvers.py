"""From one end of the flow to the other: dx = v(t, x) dt."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.registry import Registry

Velocity = Callable[[Tensor, Tensor], Tensor]
Step = Callable[[Velocity, Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Solution:
    """The end of the path and what it cost.

    Attributes:
        x: State at t_1, (B, ...), float32 (float64 when the start was).
        evaluations: Network evaluations per scene, (B,) int64.
    """

    x: Tensor
    evaluations: Tensor


class FixedStep(NamedTuple):
    """One step x(t) -> x(t + h), the order of its global error, and its evaluations of the velocity."""

    step: Step
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


SOLVERS = Registry(
    "solver",
    euler=FixedStep(euler, 1, 1),
    midpoint=FixedStep(midpoint, 2, 2),
    heun2=FixedStep(heun2, 2, 2),
    heun3=FixedStep(heun3, 3, 3),
    rk4=FixedStep(rk4, 4, 4),
)
TORCHDIFFEQ = "torchdiffeq:"


def solve(
    velocity: Velocity,
    x: Tensor,
    t_0: float = 0.0,
    t_1: float = 1.0,
    method: str = "euler",
    steps: int = 32,
    tolerance: float = 1e-5,
    progress: Callable[[], None] | None = None,
) -> Solution:
    """Solve dx/dt = v(t, x) from x at t_0 to t_1, forward or backward in time.

    The state and t stay in float32 whatever the network computes in; the memory does not grow with the
    number of steps.

    Args:
        velocity: v(t, x) with t of shape ().
        x: State at t_0, (B, ...).
        method: A name in `SOLVERS`, or `torchdiffeq:NAME` for one of torchdiffeq's.
        steps: Equal steps of a fixed-step method; an adaptive one ignores it.
        tolerance: Absolute and relative tolerance of an adaptive method; a fixed-step one ignores it.
        progress: Called after every evaluation.

    Raises:
        InputError: an unknown method, fewer than one step, or a tolerance that is not positive.
    """
    check_method(method)
    if steps < 1:
        raise InputError(f"a solver needs at least 1 step, found {steps}.")
    if not (tolerance > 0 and math.isfinite(tolerance)):
        raise InputError(f"a solver's tolerance must be positive, found {tolerance}.")
    x = x if x.dtype == torch.float64 else x.float()
    count = 0

    def counted(t: Tensor, state: Tensor) -> Tensor:
        nonlocal count
        count += 1
        v = velocity(t, state).to(state.dtype)
        if progress is not None:
            progress()
        return v

    if not method.startswith(TORCHDIFFEQ):
        end = _fixed(counted, x, t_0, t_1, SOLVERS[method].step, steps)
        return Solution(end, torch.full((len(x),), count, dtype=torch.int64))
    # torchdiffeq takes a batch for one state with one error norm, in which a hard scene among easy ones goes
    # under; one scene at a time, a result does not depend on its neighbours.
    ends, evaluations = [], []
    for scene in x.split(1):
        count = 0
        ends.append(_torchdiffeq(counted, scene, t_0, t_1, method.removeprefix(TORCHDIFFEQ), steps, tolerance))
        evaluations.append(count)
    return Solution(torch.cat(ends), torch.tensor(evaluations))


def check_method(method: str) -> None:
    """Know a solver by its name before it is needed.

    Raises:
        InputError: an unknown method.
    """
    if not method.startswith(TORCHDIFFEQ):
        SOLVERS[method]
        return
    from torchdiffeq._impl.odeint import SOLVERS as known

    name = method.removeprefix(TORCHDIFFEQ)
    if name not in known:
        raise InputError(f"torchdiffeq has no method {name!r}; it knows: {', '.join(sorted(known))}.")


def _fixed(v: Velocity, x: Tensor, t_0: float, t_1: float, step: Step, steps: int) -> Tensor:
    grid = torch.linspace(t_0, t_1, steps + 1, dtype=torch.float64)
    for t, following in pairwise(grid):
        x = step(v, t.to(x), (following - t).to(x), x)
    return x


def _torchdiffeq(v: Velocity, x: Tensor, t_0: float, t_1: float, method: str, steps: int, tolerance: float) -> Tensor:
    import torchdiffeq
    from torchdiffeq._impl.odeint import SOLVERS as known

    options = {} if _is_adaptive(known[method]) else {"step_size": abs(t_1 - t_0) / steps}
    span = torch.tensor([t_0, t_1], dtype=x.dtype, device=x.device)
    return torchdiffeq.odeint(v, x, span, rtol=tolerance, atol=tolerance, method=method, options=options)[-1]


def _is_adaptive(solver: type) -> bool:
    from torchdiffeq._impl.solvers import AdaptiveStepsizeODESolver

    return issubclass(solver, AdaptiveStepsizeODESolver)
