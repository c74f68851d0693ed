"""The ODE dx/dt = v(t, x) of a flow, by a solver of `r2flow.flow.solvers`."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers import SOLVERS, TORCHDIFFEQ, Solution, method_of, named_grid, solve
from r2flow.registry import Count, Portion, Positive
from r2flow.samplers.base import Call, Fresh, Generated, Given, OnGrid, Progress, Sampler


class ODESampler(Sampler):
    """A sampler that follows the flow's own paths, forward and backward in time."""

    def options(self) -> dict[str, Any]:
        """Options of `r2flow.flow.solvers.solve`."""
        raise NotImplementedError

    def solve(
        self,
        generator: Any,
        x: Tensor,
        t_0: float = 0.0,
        t_1: float = 1.0,
        condition: Given = None,
        progress: Progress = None,
        **options: Any,
    ) -> Solution:
        """The state at t_1 from x at t_0, (B, ...); options are those of `r2flow.flow.solvers.solve`."""
        how = {**self.options(), **options}
        return solve(generator.field(condition), x, t_0, t_1, progress=progress, **how)

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        end = self.solve(generator, noise, condition=condition, progress=progress)
        return Generated(end.x, end.evaluations, end.converged)


@dataclass(frozen=True)
class FixedSteps(OnGrid, ODESampler):
    """Fixed steps of a solver.

    Attributes:
        method: Name of the solver, which is the sampler's name too.
        finish: Length of the last step, by Euler's rule: it smooths surfaces of a flow that was not trained to the end.
    """

    method: str = "euler"
    finish: Portion = 0.0

    @property
    def name(self) -> str:
        return self.method

    def evaluations(self, generator: Any) -> int:
        last = int(bool(self.finish) and self.steps > 1)
        count: int = SOLVERS[self.method].cost(self.steps - last)  # type: ignore[union-attr]
        return count + last

    def options(self) -> dict[str, Any]:
        return {"method": self.method, "steps": self.steps, "grid": self.times_or_name}

    def __call__(self, generator: Any, noise: Tensor, condition: Given, draws: Fresh, progress: Call) -> Generated:
        if not self.finish or self.steps == 1:
            return super().__call__(generator, noise, condition, draws, progress)
        near = self.solve(generator, noise, 0.0, 1 - self.finish, condition, progress, steps=self.steps - 1)
        last = solve(generator.field(condition), near.x, 1 - self.finish, steps=1, progress=progress)
        return Generated(last.x, near.evaluations + last.evaluations, near.converged & last.converged)

    def knot_times(self, knots: int) -> Tensor:
        if self.steps % (knots + 1) or self.finish or not isinstance(self.grid, str):
            raise InputError(
                f"{self} keep no {knots} inner states: the steps must be a multiple of {knots + 1} on a named grid."
            )
        return named_grid(self.grid)(0.0, 1.0, knots + 1)


@dataclass(frozen=True)
class Adaptive(ODESampler):
    """Steps that a solver chooses for each scan.

    Attributes:
        method: Name of the solver, which is the sampler's name too.
        tolerance: Absolute and relative tolerance of the local error (`r2flow.flow.solvers.solve`).
    """

    method: str = "dopri5"
    tolerance: Positive = 1e-5

    @property
    def name(self) -> str:
        return self.method

    def options(self) -> dict[str, Any]:
        return {"method": self.method, "tolerance": self.tolerance}


@dataclass(frozen=True)
class TorchDiffEq(ODESampler):
    """A method of torchdiffeq.

    Attributes:
        method: Its name there.
        tolerance: Of an adaptive method.
        steps: Of a method of fixed steps.
    """

    method: str = "dopri5"
    tolerance: Positive = 1e-5
    steps: Count = 32

    def __post_init__(self) -> None:
        method_of(TORCHDIFFEQ + self.method)

    def evaluations(self, generator: Any) -> None:
        return None

    def options(self) -> dict[str, Any]:
        return {"method": TORCHDIFFEQ + self.method, "steps": self.steps, "tolerance": self.tolerance}
