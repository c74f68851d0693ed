"""ODE samplers: solve dx/dt = v(t, x) by a solver of `r2flow.flow.solvers`."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from r2flow.base.errors import InputError
from r2flow.base.registry import Config, Count, Portion, Positive
from r2flow.flow.solvers import SOLVERS, TORCHDIFFEQ, method_of, solve
from r2flow.samplers.base import Generated, Known, Noise, OnGrid, Sampler, Tick


class ODESampler(Sampler):
    """A sampler that solves the flow's ODE (`Flow.solve`), forward or backward in time."""

    @abstractmethod
    def options(self) -> Config:
        """Options of `r2flow.flow.solvers.solve`."""

    def check(self, generator: Any) -> None:
        super().check(generator)
        method = method_of(self.options()["method"])
        if getattr(generator, "singular", False) and getattr(method, "at_end", False):
            raise InputError(
                f"{self.name} needs v at t = 1, which this model lacks: give jump or euler."
            )

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        end = solve(generator.field(condition), noise, progress=progress, **self.options())
        return Generated(end.x, end.evaluations, end.converged)


@dataclass(frozen=True)
class FixedSteps(OnGrid, ODESampler):
    """Fixed steps of a solver."""

    method: str = "euler"  # name of the solver, and of the sampler
    # Length of a last Euler step, which smooths surfaces of a flow undertrained near t = 1.
    finish: Portion = 0.0

    @property
    def name(self) -> str:
        return self.method

    def evaluations(self, generator: Any) -> int:
        each: int = SOLVERS[self.method].evaluations  # type: ignore[union-attr]
        if not self._finishes:
            return self.steps * each
        return (self.steps - 1) * each + 1

    @property
    def _finishes(self) -> bool:
        return self.finish > 0 and self.steps > 1

    def options(self) -> Config:
        return {"method": self.method, "steps": self.steps, "grid": self.grid}

    def __call__(
        self, generator: Any, noise: Tensor, condition: Known, draws: Noise, progress: Tick
    ) -> Generated:
        if not self._finishes:
            return super().__call__(generator, noise, condition, draws, progress)
        v = generator.field(condition)
        t = 1 - self.finish
        options = self.options() | {"steps": self.steps - 1}
        near = solve(v, noise, 0.0, t, progress=progress, **options)
        last = solve(v, near.x, t, steps=1, progress=progress)
        return Generated(
            last.x, near.evaluations + last.evaluations, near.converged & last.converged
        )


@dataclass(frozen=True)
class Adaptive(ODESampler):
    """Adaptive steps of a solver, chosen per scan."""

    method: str = "dopri5"  # name of the solver, and of the sampler
    # Absolute and relative, of the local error (`r2flow.flow.solvers.solve`).
    tolerance: Positive = 1e-5

    @property
    def name(self) -> str:
        return self.method

    def options(self) -> Config:
        return {"method": self.method, "tolerance": self.tolerance}


@dataclass(frozen=True)
class TorchDiffEq(ODESampler):
    """A solver of the package torchdiffeq, which ends at t_1 (`step_t` of its options).

    `fehlberg2` and `adaptive_heun` gain nothing from that: their error is that of the steps before.
    `fehlberg2` estimates it as h (k_3 - k_1) / 512, and errs by tens of tolerances.
    """

    method: str = "dopri5"  # name in torchdiffeq
    tolerance: Positive = 1e-5  # of an adaptive method
    steps: Count = 32  # of a fixed-step method

    def __post_init__(self) -> None:
        method_of(TORCHDIFFEQ + self.method)

    def evaluations(self, generator: Any) -> None:
        return None

    def options(self) -> Config:
        return {
            "method": TORCHDIFFEQ + self.method,
            "steps": self.steps,
            "tolerance": self.tolerance,
        }
