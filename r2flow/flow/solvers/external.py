"""Solvers of torchdiffeq, applied scene by scene."""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.base.registry import Config, Registry
from r2flow.flow.solvers.adaptive import attainable
from r2flow.flow.solvers.solution import Evaluations, Solution, Spent, finite

_log = logging.getLogger(__name__)

TORCHDIFFEQ = "torchdiffeq:"
# Its Adams methods need equal steps, which it does not check: on other grids their order drops to
# 2. At its default order of 12, the error of the explicit one grows with every halving of equal
# steps. SciPy's solver counts no steps.
_LEFT_OUT = {"explicit_adams", "implicit_adams", "fixed_adams", "scipy_solver"}


@dataclass(frozen=True)
class TorchDiffEqMethod:
    """A method of torchdiffeq by its name there."""

    name: str
    at_end = True  # whether a step evaluates v at its end: most do

    def __post_init__(self) -> None:
        self._solver()

    def _solver(self) -> Any:
        from torchdiffeq._impl.odeint import SOLVERS

        known = {name: SOLVERS[name] for name in SOLVERS.keys() - _LEFT_OUT}
        return Registry("method of torchdiffeq", **known)[self.name]

    @property
    def adapts(self) -> bool:
        from torchdiffeq._impl.solvers import FixedGridODESolver

        return not issubclass(self._solver(), FixedGridODESolver)

    def solve(self, v: Evaluations, x: Tensor, times: Tensor) -> Solution:
        """Solve scenes one after another: torchdiffeq's error norm of a whole batch would hide a
        hard scene. It computes in float64, since its interpolant at the end cancels.

        An adaptive method uses only the first and last time, and ends at the last one.
        """
        import torchdiffeq

        grid = times.to(x)
        if self.adapts:
            # From the state's type, since the velocity has not been evaluated yet.
            tolerance = attainable(v.limits, v.coarsest(x))
            # Without it, the last step passes the end, and the state there is interpolated.
            options: Config = {"step_t": grid[-1:]}
        else:
            tolerance = v.limits.tolerance
            options = {"grid_constructor": lambda field, start, span: grid}
        ends = sorted(times[[0, -1]].tolist())
        scenes = [_Scene(v, start, self.adapts, ends) for start in x.split(1)]
        v.converged[:] = finite(x).cpu()
        for i in v.converged.nonzero()[0]:
            scene = scenes[i]
            v.only(np.array([i]))
            try:
                *_, end = torchdiffeq.odeint(
                    scene,
                    scene.last.double(),
                    grid[[0, -1]],
                    rtol=tolerance,
                    atol=tolerance,
                    method=self.name,
                    options=options,
                )
                v.converged[i] = scene.keep(end)
            # It asserts on underflowing steps, non-finite values.
            except (Spent, AssertionError) as error:
                v.converged[i] = False
                _log.warning("%s%s gave up on scene %d: %s.", TORCHDIFFEQ, self.name, i, error)
        return v.solution(torch.cat([scene.last for scene in scenes]))


class _Scene:
    """One scene's velocity, and the steps that torchdiffeq reports."""

    def __init__(self, v: Evaluations, x: Tensor, adapts: bool, ends: list[float]) -> None:
        self._v = v
        self._ends = ends
        self._dtype = x.dtype
        self.last = x
        self._velocity = v.of_one if adapts else v
        if adapts:  # torchdiffeq warns about callbacks that a method does not call
            self.callback_reject_step = self._reject

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        # The probe for the first step's length may lie beyond the end.
        v = self._velocity(t.to(self._dtype).clamp(*self._ends), x.to(self._dtype))
        return v.to(x)

    def keep(self, x: Tensor) -> bool:
        x = x.to(self._dtype)
        good = bool(x.isfinite().all())
        if good:
            self.last = x
        return good

    def callback_step(self, t: Tensor, x: Tensor, h: Tensor) -> None:
        self._v.accepted[self._v.scenes] += 1
        self.keep(x)

    def _reject(self, t: Tensor, x: Tensor, h: Tensor) -> None:
        self._v.accepted[self._v.scenes] -= 1
        self._v.rejected[self._v.scenes] += 1
