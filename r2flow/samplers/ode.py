"""The ODE dx/dt = v(t, x) of a flow, by a solver of `r2flow.flow.solvers`."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers import TORCHDIFFEQ, FixedStep, Solution, check_method, fixed_step, named_grid, solve
from r2flow.registry import Count, Portion, Positive
from r2flow.samplers.base import Condition, Generated, Noise, OnGrid, Progress, Sampler


class ODESampler(Sampler):
    """A sampler that follows the flow's own paths, forward and backward in time."""

    @abstractmethod
    def solve(
        self,
        generator: Any,
        x: Tensor,
        t_0: float = 0.0,
        t_1: float = 1.0,
        condition: Condition | None = None,
        progress: Progress = None,
        **options: Any,
    ) -> Solution:
        """The state at t_1 from x at t_0, (B, ...); options are those of `r2flow.flow.solvers.solve`."""

    def __call__(
        self,
        generator: Any,
        noise: Tensor,
        condition: Condition | None = None,
        draws: Noise | None = None,
        progress: Progress = None,
    ) -> Generated:
        end = self.solve(generator, noise, condition=condition, progress=progress)
        return Generated(end.x, end.evaluations, end.converged)

    def knot_times(self, knots: int) -> Tensor:
        """Times from 0 to 1 of both ends and of the inner states that a solution keeps, (knots + 2,) float64.

        Raises:
            InputError: this sampler keeps no such states.
        """
        raise InputError(f"{self.name} keeps no inner states; give a solver of r2flow, such as adams3.")


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

    @property
    def solver(self) -> FixedStep:
        """The method of steps."""
        solver = fixed_step(self.method)
        assert solver is not None
        return solver

    def evaluations(self, generator: Any) -> int:
        last = int(bool(self.finish) and self.steps > 1)
        return self.solver.cost(self.steps - last) + last

    def solve(
        self,
        generator: Any,
        x: Tensor,
        t_0: float = 0.0,
        t_1: float = 1.0,
        condition: Condition | None = None,
        progress: Progress = None,
        **options: Any,
    ) -> Solution:
        how = {"method": self.method, "steps": self.steps, "grid": self.times_or_name, **options}
        return solve(generator.field(condition), x, t_0, t_1, progress=progress, **how)

    def __call__(
        self,
        generator: Any,
        noise: Tensor,
        condition: Condition | None = None,
        draws: Noise | None = None,
        progress: Progress = None,
    ) -> Generated:
        last = {"finish": self.finish, "steps": self.steps - 1} if self.finish and self.steps > 1 else {}
        end = self.solve(generator, noise, condition=condition, progress=progress, **last)
        return Generated(end.x, end.evaluations, end.converged)

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

    def solve(
        self,
        generator: Any,
        x: Tensor,
        t_0: float = 0.0,
        t_1: float = 1.0,
        condition: Condition | None = None,
        progress: Progress = None,
        **options: Any,
    ) -> Solution:
        how = {"method": self.method, "tolerance": self.tolerance, **options}
        return solve(generator.field(condition), x, t_0, t_1, progress=progress, **how)

    def knot_times(self, knots: int) -> Tensor:
        return torch.linspace(0, 1, knots + 2, dtype=torch.float64)


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
        check_method(TORCHDIFFEQ + self.method)

    def evaluations(self, generator: Any) -> None:
        return None

    def solve(
        self,
        generator: Any,
        x: Tensor,
        t_0: float = 0.0,
        t_1: float = 1.0,
        condition: Condition | None = None,
        progress: Progress = None,
        **options: Any,
    ) -> Solution:
        how = {"method": TORCHDIFFEQ + self.method, "steps": self.steps, "tolerance": self.tolerance, **options}
        return solve(generator.field(condition), x, t_0, t_1, progress=progress, **how)
