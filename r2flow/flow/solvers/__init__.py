"""ODE solvers for dx/dt = v(t, x)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from r2flow.errors import check
from r2flow.flow.solvers.adaptive import LEAST_TOLERANCE
from r2flow.flow.solvers.embedded import EmbeddedMethod, dopri5
from r2flow.flow.solvers.exponential import ExponentialMethod
from r2flow.flow.solvers.external import TORCHDIFFEQ, TorchDiffEqMethod
from r2flow.flow.solvers.fixed import Adams3, FixedStep, build_grid, euler, heun2, midpoint, named_grid, rk4, uniform
from r2flow.flow.solvers.solution import Evaluations, Limits, Solution, Velocity, finite, flat, selected, wide
from r2flow.registry import Registry

__all__ = [
    "LEAST_TOLERANCE", "SOLVERS", "TORCHDIFFEQ", "EmbeddedMethod", "FixedStep", "Solution", "Velocity", "method_of",
    "named_grid", "solve", "usual_grid",
]  # fmt: skip

SOLVERS: Registry[FixedStep | EmbeddedMethod | ExponentialMethod] = Registry(
    "solver",
    euler=FixedStep(euler, order=1, evaluations=1),
    midpoint=FixedStep(midpoint, order=2, evaluations=2),
    heun2=FixedStep(heun2, order=2, evaluations=2, at_end=True),
    rk4=FixedStep(rk4, order=4, evaluations=4, at_end=True),
    adams3=FixedStep(Adams3, order=3, evaluations=1, multistep=True),
    dopri5=dopri5,
    exprb43=ExponentialMethod(),
)
# For the error estimate, the tolerance is divided by this. At 10, sometimes at 30, the second solution's error is as
# large as the first's if the velocity jumps in time; at 100, more scenes exceed their budget of evaluations.
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
    grid: str | Sequence[float] | Tensor = "uniform",
    max_evaluations: int = 20_000,
    max_step: float = 1.0,
    global_error: bool = False,
) -> Solution:
    """Solve dx/dt = v(t, x) from x at t_0 to t_1, forward or backward in time.

    The state and t are float32 (float64 if x is), regardless of the network's precision. Methods of r2flow evaluate v
    only between t_0 and t_1. Each scene has its own adaptive steps. A scene that cannot be solved is flagged
    (`Solution.converged`) without an exception.

    Args:
        velocity: v(t, x) with t of shape () in a fixed-step method, (B,) in an adaptive one, where B shrinks as scenes
            finish; a velocity that differs between scenes has a method `select` (see `Evaluations`).
        x: State at t_0, (B, ...).
        method: A name in `SOLVERS`, or `torchdiffeq:NAME`. exprb43 is not differentiable and does not search for pulses
            and jumps.
        steps: Steps of a fixed-step method on a named grid; ignored by adaptive methods.
        tolerance: Absolute and relative tolerance of an adaptive method, for the local error e of a step:
            (mean |e / (tolerance + tolerance |x|)|^6)^(1/6) <= 1 over a scene's elements. It does not bound the error
            at t_1. Tolerances below `LEAST_TOLERANCE` of the state's or the velocity's type are raised to it, with a
            warning.
        progress: Called after every evaluation.
        grid: Time grid of a fixed-step method: `uniform`, `power:P` (t = 1 - (1 - u)^P), or the times
            themselves, (N + 1,) from t_0 to t_1.
        max_evaluations: Budget of a scene in an adaptive method; the second solution of `global_error` has another.
        max_step: Longest step of r2flow's adaptive methods as a share of the interval. They evaluate v in every 0.16 of
            the interval and locate jumps of v in time; a narrower pulse can be missed without a flag. 1/64 finds all
            pulses longer than 1/128.
        global_error: Estimate the error at t_1 of an adaptive method by a second solution at 1/60 of the tolerance; its
            evaluations are counted.
    """
    solver = method_of(method)
    check(math.isfinite(t_1 - t_0), f"a solution needs two times, found {t_0} and {t_1}.")
    check(hasattr(steps, "__index__") and steps >= 1, f"a solver needs at least 1 whole step, found {steps!r}.")
    check(0 < tolerance < math.inf, f"a solver's tolerance must be positive and finite, found {tolerance:g}.")
    check(max_evaluations >= 1, f"a scene needs a budget of at least 1 evaluation, found {max_evaluations}.")
    check(0 < max_step <= 1, f"max_step is a share of the interval, above 0 and at most 1; found {max_step}.")
    x = wide(x)
    v = Evaluations(velocity, len(x), progress)
    if t_0 == t_1 or not len(x):
        v.converged[:] = finite(x).cpu()
        error = torch.zeros(len(x), dtype=torch.float64, device="cpu") if global_error else None
        return replace(v.solution(x), global_error=error)
    times = uniform(t_0, t_1, 1) if solver.adapts else build_grid(grid, t_0, t_1, steps)
    limits = Limits(tolerance, max_evaluations, max_step=max_step)
    solution = solver.solve(v, x, times, limits)
    if not (global_error and solver.adapts):
        return solution
    scenes = solution.converged.nonzero()[:, 0]
    error = torch.full((len(x),), math.inf, dtype=torch.float64, device="cpu")
    extra = torch.zeros_like(solution.evaluations)
    if len(scenes):
        index, v = scenes.to(x.device), Evaluations(selected(velocity, scenes), len(scenes), progress)
        second = solver.solve(v, x[index], times, limits._replace(tighter=TIGHTER))
        rms = flat((solution.x[index] - second.x).detach().double().square()).mean(1).sqrt().cpu()
        error[scenes], extra[scenes] = torch.where(second.converged, rms, math.inf), second.evaluations
    return replace(solution, evaluations=solution.evaluations + extra, global_error=error)


def method_of(name: str) -> FixedStep | EmbeddedMethod | ExponentialMethod | TorchDiffEqMethod:
    return TorchDiffEqMethod(name.removeprefix(TORCHDIFFEQ)) if name.startswith(TORCHDIFFEQ) else SOLVERS[name]


def usual_grid(name: str) -> str:
    """The default grid of a method: denser towards t = 1 for multistep methods, else uniform."""
    return "power:1.75" if getattr(SOLVERS[name], "multistep", False) else "uniform"
