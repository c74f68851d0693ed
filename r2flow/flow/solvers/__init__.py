"""ODE solvers for dx/dt = v(t, x)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from r2flow.base.registry import Registry
from r2flow.flow.solvers.adaptive import LEAST_TOLERANCE
from r2flow.flow.solvers.embedded import EmbeddedMethod, dopri5
from r2flow.flow.solvers.exponential import ExponentialMethod
from r2flow.flow.solvers.external import TORCHDIFFEQ, TorchDiffEqMethod
from r2flow.flow.solvers.fixed import (
    Adams3,
    FixedStep,
    build_grid,
    euler,
    heun2,
    midpoint,
    named_grid,
    rk4,
    uniform,
)
from r2flow.flow.solvers.solution import (
    Evaluations,
    Limits,
    Solution,
    Velocity,
    finite,
    flat,
    selected,
    wide,
)

__all__ = [
    "LEAST_TOLERANCE",
    "SOLVERS",
    "TORCHDIFFEQ",
    "EmbeddedMethod",
    "FixedStep",
    "Solution",
    "Velocity",
    "default_grid",
    "method_of",
    "named_grid",
    "solve",
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
# For the error estimate, the tolerance is divided by this. At 10, sometimes at 30, the second
# solution's error is as large as the first's if the velocity jumps in time; at 100, more scenes
# exceed their budget of evaluations.
_TIGHTER = 60.0


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

    The state and t are float32 (float64 if x is), whatever the network's precision. v is evaluated
    between t_0 and t_1 alone. Each scene has its own adaptive steps. A scene that cannot be solved
    is flagged (`Solution.converged`).

    Args:
        velocity: v(t, x), with t of shape () in a fixed-step method, (B,) in an adaptive one; B
            shrinks as scenes finish. One that differs between scenes: see `Evaluations`.
        x: State at t_0, (B, ...).
        method: A name in `SOLVERS`, or `torchdiffeq:NAME`. exprb43 is not differentiable.
        steps: Steps of a fixed-step method on a named grid.
        tolerance: Absolute and relative tolerance of an adaptive method, for the local error e of a
            step, not that at t_1: (mean |e / (tolerance + tolerance |x|)|^6)^(1/6) <= 1 over a
            scene's elements. It is raised to `LEAST_TOLERANCE` of the types, with a warning.
        progress: Called after every evaluation.
        grid: Time grid of fixed steps: `uniform`, `power:P` (t = 1 - (1 - u)^P), or (N + 1,) times.
        max_evaluations: Budget of a scene in an adaptive method, for each solution.
        max_step: Longest step of r2flow's adaptive methods as a share of the interval. dopri5 finds
            jumps of v in time, and pulses of 0.16 of the interval; with 1/64 those of 1/128.
        global_error: Estimate an adaptive method's error at t_1, by a second, tighter solution.
    """
    solver = method_of(method)
    x = wide(x)
    limits = Limits(tolerance, max_evaluations, max_step)
    v = Evaluations(velocity, len(x), limits, progress)
    error = torch.zeros(len(x), dtype=torch.float64, device="cpu")
    if t_0 == t_1 or not len(x):
        v.converged[:] = finite(x).cpu()
        return replace(v.solution(x), global_error=error if global_error else None)
    times = uniform(t_0, t_1, 1) if solver.adapts else build_grid(grid, t_0, t_1, steps)
    solution = solver.solve(v, x, times)
    if not (global_error and solver.adapts):
        return solution
    error[~solution.converged] = math.inf
    scenes = solution.converged.nonzero()[:, 0]
    if len(scenes):
        index = scenes.to(x.device)
        limits = limits._replace(tighter=_TIGHTER)
        v = Evaluations(selected(velocity, scenes), len(scenes), limits, progress)
        second = solver.solve(v, x[index], times)
        rms = flat((solution.x[index] - second.x).detach().double().square()).mean(1).sqrt().cpu()
        error[scenes] = torch.where(second.converged, rms, math.inf)
        solution.evaluations[scenes] += second.evaluations
    return replace(solution, global_error=error)


def method_of(name: str) -> FixedStep | EmbeddedMethod | ExponentialMethod | TorchDiffEqMethod:
    """The solver of a name in `SOLVERS`, or `torchdiffeq:NAME`."""
    if name.startswith(TORCHDIFFEQ):
        return TorchDiffEqMethod(name.removeprefix(TORCHDIFFEQ))
    return SOLVERS[name]


def default_grid(name: str) -> str:
    """The default grid of a method: denser towards t = 1 for multistep methods, else uniform."""
    return "power:1.75" if getattr(SOLVERS[name], "multistep", False) else "uniform"
