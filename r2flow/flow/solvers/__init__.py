"""From one end of the flow to the other: dx = v(t, x) dt."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.adaptive import FLOOR, solve_adaptive
from r2flow.flow.solvers.clock import Limits
from r2flow.flow.solvers.external import (
    TORCHDIFFEQ,
    check_torchdiffeq,
    is_fixed,
    solve_torchdiffeq,
    torchdiffeq_methods,
)
from r2flow.flow.solvers.fixed import AB2, FixedStep, euler, heun2, heun3, midpoint, rk4, solve_fixed
from r2flow.flow.solvers.grids import GRIDS, build_grid, calibrated_grid, extended, halved
from r2flow.flow.solvers.pairs import Pair, bosh3, dopri5
from r2flow.flow.solvers.solution import Evaluations, Solution, Velocity, finite
from r2flow.registry import Registry

__all__ = [
    "FLOOR", "GRIDS", "SOLVERS", "TORCHDIFFEQ", "FixedStep", "Pair", "Solution", "Velocity",
    "adapts", "calibrated_grid", "check_method", "check_tolerance", "solve",
]  # fmt: skip

SOLVERS: Registry[FixedStep | Pair] = Registry(
    "solver",
    euler=FixedStep(euler, order=1, evaluations=1),
    midpoint=FixedStep(midpoint, order=2, evaluations=2),
    heun2=FixedStep(heun2, order=2, evaluations=2),
    heun3=FixedStep(heun3, order=3, evaluations=3),
    rk4=FixedStep(rk4, order=4, evaluations=4),
    ab2=FixedStep(AB2, order=2, evaluations=1),
    bosh3=bosh3,
    dopri5=dopri5,
)
# By so much is the second solution's tolerance below the first one's. At 10, and now and then at 30, its own error is
# as large as the first one's where the velocity jumps in time; at 100 more scenes run out of their budget.
TIGHTER = 60.0


def solve(
    velocity: Velocity,
    x: Tensor,
    t_0: float = 0.0,
    t_1: float = 1.0,
    method: str = "euler",
    steps: int = 32,
    tolerance: float = 1e-5,
    progress: Callable[[], None] | None = None,
    *,
    grid: str | Tensor = "uniform",
    finish: float = 0.0,
    max_evaluations: int = 20_000,
    max_step: float = 1.0,
    global_error: bool = False,
) -> Solution:
    """Solve dx/dt = v(t, x) from x at t_0 to t_1, forward or backward in time.

    The state and t stay in float32 (float64 when x is) whatever the network computes in; the memory does not grow
    with the number of steps. Our own methods evaluate nothing outside t_0 to t_1, and with the adaptive ones a scene's
    result does not depend on its neighbours. A scene that cannot be solved is flagged, never raised.

    Args:
        velocity: v(t, x) with t of shape () in a fixed-step method, (B,) in an adaptive one, where B shrinks as scenes
            arrive; a velocity that differs between scenes has a method `select` (see `Evaluations`).
        x: State at t_0, (B, ...).
        method: A name in `SOLVERS`, or `torchdiffeq:NAME` for one of torchdiffeq's.
        steps: Steps of a fixed-step method on a named grid; an adaptive one ignores it.
        tolerance: Absolute and relative tolerance of an adaptive method. Ours hold each step to it by the sixth-power
            mean over a scene's elements, (mean |e / (tolerance + tolerance |x|)|^6)^(1/6) <= 1: between the root mean
            square, in which the few elements that are hard at a time go under, and the largest. Floored, with a
            warning, at what the state's type and that of the velocity can hold (`FLOOR`). It does not bound the error
            at t_1. A fixed-step method ignores it.
        progress: Called after every evaluation.
        grid: `uniform`, `quadratic` (denser towards t = 1) or the times themselves, (N + 1,) from t_0 to where
            `finish` begins; for fixed steps.
        finish: Length of a last stretch, before t_1, that is left to one Euler step: 1e-3 keeps clear of a velocity
            that is singular at t_1.
        max_evaluations: An adaptive method's budget for a scene, at least 2: the start's, and one to feel for the
            first step.
        max_step: Longest step of our adaptive methods, as a share of the interval: 1/64 looks for what is narrow in
            time, at 64 steps at least.
        global_error: Estimate it by a second solution, with twice the steps or a sixtieth of the tolerance, and
            about a sixtieth of `finish`; its evaluations are counted.

    Raises:
        InputError: an unknown method or grid, fewer than one step, or a number out of its range.
    """
    check_method(method)
    _check_numbers(t_0, t_1, steps, tolerance, finish, max_evaluations, max_step)
    x = x if x.dtype == torch.float64 else x.float()
    if t_0 == t_1 or not len(x):
        return _at_rest(x, global_error)
    sign = math.copysign(1.0, t_1 - t_0)
    times = build_grid(grid, t_0, t_1 - sign * finish if finish else t_1, steps)
    entry = None if method.startswith(TORCHDIFFEQ) else SOLVERS[method]
    limits = Limits(tolerance, max_evaluations, max_step=max_step, finish=finish)

    def once(velocity: Velocity, x: Tensor, times: Tensor, limits: Limits) -> Solution:
        v = Evaluations(velocity, len(x), progress)
        if isinstance(entry, Pair):
            return solve_adaptive(v, x, t_0, t_1, entry, limits)
        last = torch.tensor(sign * limits.finish, dtype=torch.float64) if finish else None
        if isinstance(entry, FixedStep):
            return solve_fixed(v, x, times, entry, last)
        return solve_torchdiffeq(v, x, times, method.removeprefix(TORCHDIFFEQ), limits, last)

    solution = once(velocity, x, times, limits)
    if not global_error:
        return solution
    # The Euler step at the end errs as well: the second solution must not share it.
    closing = max(finish / TIGHTER, min(finish, 1e-6 * abs(t_1 - t_0)))
    limits = limits._replace(tighter=TIGHTER, finish=closing)
    times = extended(times if adapts(method) else halved(times), t_1, sign * closing) if finish else halved(times)
    if not adapts(method):
        # Two solutions whose steps differ by 2 differ by 1 - 2^-p of the coarser one's error.
        tighter = once(velocity, x, times, limits)
        return _estimated(solution, tighter, np.arange(len(x)), 1 - 2.0 ** -_order(method))
    scenes = solution.converged.nonzero()[:, 0]
    if not len(scenes):
        nowhere = torch.full((len(x),), math.inf, dtype=torch.float64)
        return replace(solution, global_error=nowhere, estimate_evaluations=torch.zeros_like(solution.evaluations))
    select = getattr(velocity, "select", None)
    if len(scenes) < len(x) and select is not None:
        velocity = select(scenes)
    tighter = once(velocity, x[scenes.to(x.device)], times, limits)
    return _estimated(solution, tighter, scenes.numpy(), 1.0)


def check_method(method: str) -> None:
    """Know a solver by its name before it is needed.

    Raises:
        InputError: an unknown method.
    """
    if method.startswith(TORCHDIFFEQ):
        check_torchdiffeq(method.removeprefix(TORCHDIFFEQ))
    else:
        SOLVERS[method]


def check_tolerance(tolerance: float) -> None:
    """Know a tolerance before it is needed.

    Raises:
        InputError: it is not positive and finite.
    """
    if not 0 < tolerance < math.inf:
        raise InputError(f"a solver's tolerance must be positive and finite, found {tolerance:g}.")


def adapts(method: str) -> bool:
    """Whether a method chooses its steps by a tolerance."""
    if method.startswith(TORCHDIFFEQ):
        return not is_fixed(method.removeprefix(TORCHDIFFEQ))
    return isinstance(SOLVERS[method], Pair)


def _order(method: str) -> int:
    name = method.removeprefix(TORCHDIFFEQ)
    return int(torchdiffeq_methods()[name].order) if name != method else SOLVERS[method].order


def _estimated(solution: Solution, tighter: Solution, scenes: np.ndarray, share: float) -> Solution:
    """The error of the first solution, as far as the second one, of these scenes, can tell."""
    difference = torch.full((len(solution.x),), math.inf, dtype=torch.float64)
    extra = torch.zeros_like(solution.evaluations)
    extra[scenes] = tighter.evaluations
    first = solution.x[torch.from_numpy(scenes).to(solution.x.device)]
    rms = (first - tighter.x).detach().double().square().flatten(1).mean(1).sqrt().cpu() / share
    difference[scenes] = torch.where(tighter.converged & solution.converged[scenes], rms, math.inf)
    evaluations = solution.evaluations + extra
    return replace(solution, evaluations=evaluations, global_error=difference, estimate_evaluations=extra)


def _at_rest(x: Tensor, global_error: bool) -> Solution:
    """The solution where there is nowhere to go."""
    solution = Solution.build(x, np.zeros(len(x)), 0, 0, False, finite(x).cpu().numpy())
    if not global_error:
        return solution
    nothing = torch.zeros(len(x), dtype=torch.float64)
    return replace(solution, global_error=nothing, estimate_evaluations=nothing.long())


def _check_numbers(
    t_0: float, t_1: float, steps: int, tolerance: float, finish: float, max_evaluations: int, max_step: float
) -> None:
    if not (math.isfinite(t_0) and math.isfinite(t_1)):
        raise InputError(f"a solution needs two times, found {t_0} and {t_1}.")
    if steps < 1:
        raise InputError(f"a solver needs at least 1 step, found {steps}.")
    check_tolerance(tolerance)
    if not (finish == 0 or 0 < finish < abs(t_1 - t_0)):
        raise InputError(f"the last stretch must be shorter than the whole way from {t_0} to {t_1}, found {finish}.")
    if max_evaluations < 2:
        raise InputError(f"a scene needs a budget of at least 2 evaluations, found {max_evaluations}.")
    if not 0 < max_step <= 1:
        raise InputError(f"the longest step is a share of the interval, above 0 and at most 1; found {max_step}.")
