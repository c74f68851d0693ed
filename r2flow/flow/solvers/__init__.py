"""ODE solvers: dx/dt = v(t, x) from one end of the flow to the other."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.adaptive import LEAST_TOLERANCE, advance
from r2flow.flow.solvers.embedded import EmbeddedMethod, bosh3, dopri5
from r2flow.flow.solvers.exponential import ExponentialMethod, automatic, exprb43, solve_exponential
from r2flow.flow.solvers.external import (
    TORCHDIFFEQ,
    check_torchdiffeq,
    is_fixed,
    solve_torchdiffeq,
    torchdiffeq_methods,
)
from r2flow.flow.solvers.fixed import FixedStep, euler, heun2, heun3, midpoint, rk4, solve_fixed
from r2flow.flow.solvers.grids import build_grid, extended, halved, named_grid, uniform
from r2flow.flow.solvers.multistep import adams
from r2flow.flow.solvers.solution import Evaluations, Solution, Velocity, finite, flat, wide
from r2flow.flow.solvers.step_size import Limits
from r2flow.registry import Registry

__all__ = [
    "LEAST_TOLERANCE", "SOLVERS", "TORCHDIFFEQ", "EmbeddedMethod", "FixedStep", "Solution", "Velocity", "adapts",
    "check_method", "check_tolerance", "fixed_step", "named_grid", "solve", "usual_grid",
]  # fmt: skip

SOLVERS: Registry[FixedStep | EmbeddedMethod | ExponentialMethod] = Registry(
    "solver",
    euler=FixedStep(euler, order=1, evaluations=1),
    midpoint=FixedStep(midpoint, order=2, evaluations=2),
    heun2=FixedStep(heun2, order=2, evaluations=2),
    heun3=FixedStep(heun3, order=3, evaluations=3),
    rk4=FixedStep(rk4, order=4, evaluations=4),
    ab2=adams(2),
    adams2=adams(2, 2),
    adams3=adams(2, 3),
    adams4=adams(3, 4),
    bosh3=bosh3,
    dopri5=dopri5,
    exprb43=exprb43,
    auto=automatic,
)
# The second solution's tolerance is the first's divided by this. At 10, sometimes at 30, its own error is as large as
# the first's where the velocity jumps in time; at 100 more scenes exceed their budget of evaluations.
TIGHTER = 60.0
FALL_BACK = 10.0  # for the scenes whose budget ends before


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
    knots: int = 0,
) -> Solution:
    """Solve dx/dt = v(t, x) from x at t_0 to t_1, forward or backward in time.

    The state and t stay in float32 (float64 when x is) whatever the network computes in; the memory does not grow with
    the number of steps. Our own methods evaluate v only between t_0 and t_1. A scene has its own steps, so that its
    result depends on the others only as far as v's rounding does. A scene that cannot be solved is flagged; no
    exception is raised.

    Args:
        velocity: v(t, x) with t of shape () in a fixed-step method, (B,) in an adaptive one, where B shrinks as scenes
            arrive; a velocity that differs between scenes has a method `select` (see `Evaluations`).
        x: State at t_0, (B, ...).
        method: A name in `SOLVERS`, or `torchdiffeq:NAME` for one of torchdiffeq's. `auto` is dopri5, and exprb43 from
            where a scene turns out to be stiff; exprb43 gives no gradient and does not look for pulses and jumps.
        steps: Steps of a fixed-step method on a named grid; an adaptive one ignores it.
        tolerance: Absolute and relative tolerance of an adaptive method, for the local error e of a step:
            (mean |e / (tolerance + tolerance |x|)|^6)^(1/6) <= 1 over a scene's elements. It does not bound the error
            at t_1. Tolerances below `LEAST_TOLERANCE` of the state's or the velocity's type are raised to it, with a
            warning.
        progress: Called after every evaluation.
        grid: Time grid of a fixed-step method: `uniform`, `power:P` (t = 1 - (1 - u)^P), `power-start:P` (t = u^P),
            or the times themselves, (N + 1,) from t_0 to where `finish` begins.
        finish: Length of the last part of the interval, which one Euler step takes: 1e-3 avoids a velocity that is
            singular at t_1.
        max_evaluations: Budget of a scene in an adaptive method.
        max_step: Longest step of our adaptive methods as a share of the interval. They leave no 0.16 of the interval
            unseen and locate jumps of v in time; a narrower pulse can be missed without a flag. 1/64 finds all that are
            longer than a 128th.
        global_error: Estimate the error at t_1 by a second solution, with half the steps' lengths or a sixtieth of the
            tolerance (a tenth, where the budget ends before) and of `finish`; its evaluations are counted.
        knots: Inner states to keep, of a method of fixed steps on a named grid or of an adaptive one,
            which is solved from each to the next. Not with `finish`.

    Raises:
        InputError: an unknown method or grid, fewer than one step, a number out of its range, or steps that have no
            such knots.
    """
    check_method(method)
    _check_numbers(t_0, t_1, steps, tolerance, finish, max_evaluations, max_step)
    x = wide(x)
    if t_0 == t_1 or not len(x):
        return _at_rest(x, global_error, knots)
    times = build_grid(grid, t_0, t_1 - math.copysign(finish, t_1 - t_0) if finish else t_1, steps)
    run = _Run(method, t_0, t_1, times, Limits(tolerance, max_evaluations, max_step=max_step, finish=finish), progress)
    if knots:
        check_knots(method, len(times) - 1, knots)
        if finish:
            raise InputError("a solution with knots takes no finish: its steps end at equal parts of the way.")
    solution = run.in_pieces(velocity, x, knots) if knots and adapts(method) else run.solve(velocity, x, knots)
    return _with_global_error(solution, run, velocity, x) if global_error else solution


class _Run(NamedTuple):
    """Everything that a solution depends on but the velocity and the state.

    Attributes:
        times: Time grid of a fixed-step method, from t_0 to where `limits.finish` begins.
    """

    method: str
    t_0: float
    t_1: float
    times: Tensor
    limits: Limits
    progress: Callable[[], None] | None

    def solve(self, velocity: Velocity, x: Tensor, knots: int = 0) -> Solution:
        v = velocity if isinstance(velocity, Evaluations) else Evaluations(velocity, len(x), self.progress)
        method = None if self.method.startswith(TORCHDIFFEQ) else SOLVERS[self.method]
        if isinstance(method, EmbeddedMethod):
            return advance(v, x, self.t_0, self.t_1, method, self.limits)[0]
        if isinstance(method, ExponentialMethod):
            return solve_exponential(v, x, self.t_0, self.t_1, method, self.limits)
        finish = torch.tensor(self._signed(self.limits.finish), dtype=torch.float64) if self.limits.finish else None
        if isinstance(method, FixedStep):
            return solve_fixed(v, x, self.times, method, finish, knots)
        return solve_torchdiffeq(v, x, self.times, self.method.removeprefix(TORCHDIFFEQ), self.limits, finish)

    def in_pieces(self, velocity: Velocity, x: Tensor, knots: int) -> Solution:
        """An adaptive solution from each knot to the next; a scene that fails in one piece stays failed."""
        ends = [*uniform(self.t_0, self.t_1, knots + 1).tolist()[1:-1], self.t_1]
        states, pieces, t = [x], [], self.t_0
        v = Evaluations(velocity, len(x), self.progress)  # counts on from piece to piece: a scene has one budget
        for end in ends:
            v.only(np.arange(len(x)))
            times = torch.tensor([t, end], dtype=torch.float64)
            pieces.append(self._replace(t_0=t, t_1=end, times=times).solve(v, states[-1]))
            states.append(pieces[-1].x)
            t = end
        sums = {name: sum(getattr(piece, name) for piece in pieces) for name in ("accepted", "rejected")}
        sums["evaluations"] = pieces[-1].evaluations
        stiff = torch.stack([piece.stiff for piece in pieces]).any(0)
        converged = torch.stack([piece.converged for piece in pieces]).all(0)
        return Solution(states[-1], **sums, stiff=stiff, converged=converged, knots=torch.stack(states[1:-1], 1))

    def tighter(self, by: float) -> "_Run":
        """The run with smaller errors that the estimate of the global error compares with."""
        times = self.times if adapts(self.method) else halved(self.times)
        # The Euler step at the end has an error too: it must be smaller in the second solution.
        finish = max(self.limits.finish / by, min(self.limits.finish, 1e-6 * abs(self.t_1 - self.t_0)))
        if finish:
            times = extended(times, self.t_1, self._signed(finish))
        return self._replace(times=times, limits=self.limits._replace(tighter=by, finish=finish))

    def _signed(self, length: float) -> float:
        return math.copysign(length, self.t_1 - self.t_0)


def _with_global_error(solution: Solution, run: _Run, velocity: Velocity, x: Tensor) -> Solution:
    """The solution with an estimate of its error: the difference to a second, tighter one.

    An adaptive method solves only those scenes again that have converged; where the second solution's budget ends, it
    solves them once more at a tenth of the tolerance.
    """
    scenes = solution.converged.nonzero()[:, 0] if adapts(run.method) else torch.arange(len(x))
    error = torch.full((len(x),), math.inf, dtype=torch.float64)
    extra = torch.zeros_like(solution.evaluations)
    select = getattr(velocity, "select", None)
    for by in (TIGHTER, FALL_BACK) if adapts(run.method) else (TIGHTER,):
        if not len(scenes):
            break
        own = select(scenes) if len(scenes) < len(x) and select is not None else velocity
        here = scenes.to(x.device)
        second = run.tighter(by).solve(own, x[here])
        rms = flat((solution.x[here] - second.x).detach().double().square()).mean(1).sqrt().cpu()
        if not adapts(run.method):
            rms = rms / (1 - 2.0 ** -_order(run.method))  # with h and h/2 the solutions differ by (1 - 2^-p) e_h
        error[scenes] = torch.where(second.converged & solution.converged[scenes], rms, math.inf)
        extra[scenes] += second.evaluations
        scenes = scenes[~second.converged]
    evaluations = solution.evaluations + extra
    return replace(solution, evaluations=evaluations, global_error=error, estimate_evaluations=extra)


def check_method(method: str) -> None:
    """Check the name of a solver.

    Raises:
        InputError: an unknown method.
    """
    if method.startswith(TORCHDIFFEQ):
        check_torchdiffeq(method.removeprefix(TORCHDIFFEQ))
    elif method not in SOLVERS:
        SOLVERS[method]  # which refuses it


def check_knots(method: str, steps: int, knots: int) -> None:
    """Check that a method can keep this many inner states.

    Raises:
        InputError: one of torchdiffeq's methods of fixed steps, or steps that they do not divide.
    """
    if knots < 0:
        raise InputError(f"the number of knots must be at least 0, found {knots}.")
    if not adapts(method) and fixed_step(method) is None:
        raise InputError(f"{method} keeps no knots; take one of our own solvers, such as adams3.")
    if not adapts(method) and steps % (knots + 1):
        raise InputError(f"{steps} steps have no {knots} inner knots: the steps must be a multiple of {knots + 1}.")


def check_tolerance(tolerance: float) -> None:
    """Check a tolerance.

    Raises:
        InputError: it is not positive and finite.
    """
    if not 0 < tolerance < math.inf:
        raise InputError(f"a solver's tolerance must be positive and finite, found {tolerance:g}.")


def adapts(method: str) -> bool:
    """Whether a method chooses its steps by a tolerance; what is no solver does not."""
    if method.startswith(TORCHDIFFEQ):
        return not is_fixed(method.removeprefix(TORCHDIFFEQ))
    return method in SOLVERS and isinstance(SOLVERS[method], EmbeddedMethod | ExponentialMethod)


def fixed_step(method: str) -> FixedStep | None:
    """The method of fixed steps of this name; None where it is one of another kind or of torchdiffeq's."""
    if method not in SOLVERS:
        return None
    found = SOLVERS[method]
    return found if isinstance(found, FixedStep) else None


def usual_grid(method: str) -> str:
    """Where a method's steps fall unless told: denser towards t = 1 for predictor-correctors, else equal.

    P = 1.75 is the best or nearly the best of the flows in docs/results.md.
    """
    found = fixed_step(method)
    return "power:1.75" if found is not None and found.corrects else "uniform"


def _order(method: str) -> int:
    name = method.removeprefix(TORCHDIFFEQ)
    return int(torchdiffeq_methods()[name].order) if name != method else SOLVERS[method].order


def _at_rest(x: Tensor, global_error: bool, knots: int) -> Solution:
    """The solution of an empty interval or an empty batch."""
    solution = Solution.build(x, np.zeros(len(x)), 0, 0, False, finite(x).cpu().numpy())
    if knots:
        solution = replace(solution, knots=torch.stack([x] * knots, 1))
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
        raise InputError(f"finish must be shorter than the interval from {t_0} to {t_1}, found {finish}.")
    if max_evaluations < 1:
        raise InputError(f"a scene needs a budget of at least 1 evaluation, found {max_evaluations}.")
    if not 0 < max_step <= 1:
        raise InputError(f"the longest step is a share of the interval, above 0 and at most 1; found {max_step}.")
