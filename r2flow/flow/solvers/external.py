"""torchdiffeq's methods, scene by scene."""

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.adaptive import attainable
from r2flow.flow.solvers.fixed import euler
from r2flow.flow.solvers.solution import Evaluations, Solution
from r2flow.flow.solvers.step_size import Limits

log = logging.getLogger(__name__)

TORCHDIFFEQ = "torchdiffeq:"
# Its Adams methods need equal steps, which it does not check: on others their order falls to 2. With its default order
# of 12 the error of the explicit one grows with every halving of equal steps (measured: order -2). SciPy's count no
# steps.
LEFT_OUT = ("explicit_adams", "implicit_adams", "fixed_adams", "scipy_solver")


def torchdiffeq_methods() -> dict[str, Any]:
    """torchdiffeq's table of solvers without those in `LEFT_OUT`."""
    from torchdiffeq._impl.odeint import SOLVERS

    return {name: method for name, method in SOLVERS.items() if name not in LEFT_OUT}


def check_torchdiffeq(name: str) -> None:
    """Check the name of a torchdiffeq method.

    Raises:
        InputError: an unknown method, or one that is left out.
    """
    known = torchdiffeq_methods()
    if name in LEFT_OUT:
        raise InputError(
            f"torchdiffeq's {name} is left out: its Adams methods lose their order on unequal steps, and its call of "
            f"SciPy counts no steps. Take one of: {', '.join(sorted(known))}."
        )
    if name not in known:
        raise InputError(f"torchdiffeq has no method {name!r}; it knows: {', '.join(sorted(known))}.")


def is_fixed(name: str) -> bool:
    """Whether a method of torchdiffeq takes the steps of a grid."""
    from torchdiffeq._impl.solvers import FixedGridODESolver

    return issubclass(torchdiffeq_methods()[name], FixedGridODESolver)


def solve_torchdiffeq(
    v: Evaluations, x: Tensor, times: Tensor, name: str, limits: Limits, finish: Tensor | None
) -> Solution:
    """Solve one scene after another, since torchdiffeq has one error norm for a batch, which hides a hard scene.

    Args:
        times: The time grid of a fixed-step method; an adaptive one goes from its first to its last time.
    """
    total = len(x)
    # By the state's type: the velocity has not been called yet.
    tolerance = limits.tolerance if is_fixed(name) else attainable(limits, v.coarsest(x))
    ends, taken, lost, converged = [], [], [], []
    for index in range(total):
        v.only(np.array([index]))
        field = _Scene(v, x[index : index + 1], limits.max_evaluations - int(v.counts[index]))
        end, whole = _end(field, times, name, tolerance, finish)
        if not whole:
            log.warning("%s%s gave up on scene %d: %s.", TORCHDIFFEQ, name, index, field.trouble or "not finite")
        ends.append(end)
        taken.append(field.steps - field.rejected)
        lost.append(field.rejected)
        converged.append(whole)
    v.only(np.arange(total))
    return Solution.build(torch.cat(ends) if ends else x, v.counts, taken, lost, False, converged)


class _Spent(Exception):
    """A scene has used its budget of evaluations."""


class _Scene:
    """One scene's velocity, and what torchdiffeq reports on the way."""

    def __init__(self, v: Evaluations, x: Tensor, max_evaluations: int) -> None:
        self._v, self._left = v, max_evaluations
        self.last, self.steps, self.rejected, self.trouble = x, 0, 0, ""

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        if self._left <= 0:
            raise _Spent("its evaluations are used up")
        self._left -= 1
        return self._v(t, x)

    def step(self, t: Tensor, x: Tensor, h: Tensor) -> None:
        self.steps += 1
        self.last = x if torch.isfinite(x).all() else self.last

    def reject(self, t: Tensor, x: Tensor, h: Tensor) -> None:
        self.rejected += 1

    def callbacks(self, known: set[str]) -> Callable[[Tensor, Tensor], Tensor]:
        """The velocity with the callbacks that the method knows; torchdiffeq warns about others."""

        def field(t: Tensor, x: Tensor) -> Tensor:
            return self(t, x)

        for name, call in (("callback_step", self.step), ("callback_reject_step", self.reject)):
            if name in known:
                setattr(field, name, call)
        return field


def _end(field: _Scene, times: Tensor, name: str, tolerance: float, finish: Tensor | None) -> tuple[Tensor, bool]:
    """The state at the end and True, or the last finite state and False."""
    import torchdiffeq

    method, x = torchdiffeq_methods()[name], field.last
    grid = times.to(x)
    options = {"grid_constructor": lambda v, x_0, span: grid} if is_fixed(name) else {}
    if not torch.isfinite(x).all():
        return x, False
    try:
        end = torchdiffeq.odeint(
            field.callbacks(method.valid_callbacks()), x, grid[[0, -1]],
            rtol=tolerance, atol=tolerance, method=name, options=options,
        )[-1]  # fmt: skip
        if finish is not None:
            field.last = end if torch.isfinite(end).all() else field.last
            end = euler(field, grid[-1], finish.to(x), end)
    except (_Spent, AssertionError) as error:  # it asserts that steps do not underflow and that values are finite
        field.trouble = str(error)
        return field.last, False
    return (end, True) if torch.isfinite(end).all() else (field.last, False)
