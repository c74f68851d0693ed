"""Solvers of torchdiffeq, applied scene by scene."""

import logging
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import check
from r2flow.flow.solvers.adaptive import attainable
from r2flow.flow.solvers.solution import Evaluations, Limits, Solution, Spent, finite

log = logging.getLogger(__name__)

TORCHDIFFEQ = "torchdiffeq:"
# Its Adams methods need equal steps, which it does not check: on other grids their order drops to 2. At its default
# order of 12, the error of the explicit one grows with every halving of equal steps. SciPy's solver counts no steps.
LEFT_OUT = ("explicit_adams", "implicit_adams", "fixed_adams", "scipy_solver")


def torchdiffeq_methods() -> dict[str, Any]:
    """torchdiffeq's table of solvers without those in `LEFT_OUT`."""
    from torchdiffeq._impl.odeint import SOLVERS

    return {name: method for name, method in SOLVERS.items() if name not in LEFT_OUT}


@dataclass(frozen=True)
class TorchDiffEqMethod:
    name: str
    at_end: ClassVar[bool] = True  # whether a step evaluates v at its end: most do

    def __post_init__(self) -> None:
        names = torchdiffeq_methods()
        check(self.name in names, f"torchdiffeq has no method {self.name!r} here; it has: {', '.join(sorted(names))}.")

    @property
    def adapts(self) -> bool:
        """Whether step sizes follow from a tolerance."""
        from torchdiffeq._impl.solvers import FixedGridODESolver

        return not issubclass(torchdiffeq_methods()[self.name], FixedGridODESolver)

    def solve(self, v: Evaluations, x: Tensor, times: Tensor, limits: Limits) -> Solution:
        """Solve scenes one after another: torchdiffeq's error norm of a whole batch would hide a hard scene.

        An adaptive method uses only the first and last time.
        """
        import torchdiffeq

        grid = times.to(x)
        # From the state's type, since the velocity has not been evaluated yet.
        tolerance = attainable(limits, v.coarsest(x)) if self.adapts else limits.tolerance
        options = {} if self.adapts else {"grid_constructor": lambda field, start, span: grid}
        scenes = [_Scene(v, start, limits if self.adapts else None) for start in x.split(1)]
        v.converged[:] = finite(x).cpu()
        for i in v.converged.nonzero()[0]:
            v.only(np.array([i]))
            try:
                end = torchdiffeq.odeint(
                    scenes[i], scenes[i].last, grid[[0, -1]],
                    rtol=tolerance, atol=tolerance, method=self.name, options=options,
                )[-1]  # fmt: skip
                v.converged[i] = bool(end.isfinite().all())
                scenes[i].last = end if v.converged[i] else scenes[i].last
            except (Spent, AssertionError) as error:  # it asserts on underflowing steps, non-finite values
                v.converged[i] = False
                log.warning("%s%s gave up on scene %d: %s.", TORCHDIFFEQ, self.name, i, error)
        return v.solution(torch.cat([scene.last for scene in scenes]))


class _Scene:
    """One scene's velocity, and the steps that torchdiffeq reports."""

    def __init__(self, v: Evaluations, x: Tensor, limits: Limits | None) -> None:
        self._v, self._limits, self.last = v, limits, x
        if limits:  # adaptive; torchdiffeq warns about callbacks that a method does not call
            self.callback_reject_step = self._reject

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        return self._v.of_one(t, x, self._limits) if self._limits else self._v(t, x)

    def callback_step(self, t: Tensor, x: Tensor, h: Tensor) -> None:
        """Called before each step."""
        self._v.accepted[self._v.scenes] += 1
        self.last = x if torch.isfinite(x).all() else self.last

    def _reject(self, t: Tensor, x: Tensor, h: Tensor) -> None:
        self._v.accepted[self._v.scenes] -= 1
        self._v.rejected[self._v.scenes] += 1
