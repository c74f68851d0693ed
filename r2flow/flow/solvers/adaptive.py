"""Embedded Runge-Kutta methods with a separate step size per scene.

A batch is stepped together, but every scene has its own time, step size and error norm, and leaves
the batch when it has reached t_1. Step sizes are controlled on the host; the state stays on its
device. Per step, a few norms per scene are copied to the host, and the times and sizes of the next
step back.
"""

import logging

import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.batched import norms, powered, unpowered, weighted
from r2flow.flow.solvers.defect import Tried, inspect
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations, Limits
from r2flow.flow.solvers.step_size import StepController

_log = logging.getLogger(__name__)

# Lower tolerances cost evaluations without gaining accuracy (measured on the exact problems), since
# rounding noise of the network dominates the error estimate.
LEAST_TOLERANCE = {
    torch.float64: 1e-14,
    torch.float32: 1e-7,
    torch.float16: 1e-5,
    torch.bfloat16: 1e-4,
}


def attainable(limits: Limits, dtype: torch.dtype) -> float:
    """The requested tolerance, or a type's least one, with a warning, if that is higher."""
    least = LEAST_TOLERANCE[dtype]
    if limits.tolerance < least and limits.tighter == 1:  # no second warning for the error estimate
        name = str(dtype).removeprefix("torch.")
        _log.warning(
            "a tolerance of %g is below what %s can hold: %g is used.",
            limits.tolerance,
            name,
            least,
        )
    return max(limits.tolerance, least) / limits.tighter


def advance(v: Evaluations, x: Tensor, t_0: float, t_1: float, method: EmbeddedMethod) -> Tensor:
    """The last state of every scene of x, (B, ...), from t_0 to t_1 by its own steps."""
    control = StepController(v, t_0, t_1, method, torch.finfo(x.dtype).eps)
    results = x.clone()
    k_1 = v(x.new_full((len(x),), t_0), x)
    tolerance = attainable(v.limits, v.precision)
    with torch.no_grad():
        scale = x.abs().mul(tolerance).add_(tolerance)
        control.start(*norms(x / scale, k_1 / scale))
    while len(x):
        if control.leaving.any():
            leaving = control.leaving.nonzero()[0]
            remaining = (~control.leaving).nonzero()[0]
            results[v.scenes[leaving]] = x[leaving]
            x = x[remaining]
            k_1 = k_1[remaining]
            control.keep(remaining)
        else:
            x, k_1 = _step(control, x, k_1, tolerance)
    return results


def _step(
    control: StepController, x: Tensor, k_1: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Try one step of every scene: new states and velocities, unchanged for rejected steps."""
    method = control.method
    *stages, h = x.new_tensor(control.propose())
    length = expand_time(h, x)
    k = [k_1]
    y = x
    for t, row in zip(stages, method.rows, strict=True):
        before = y
        y = torch.addcmul(x, weighted(row, k), length)
        k.append(control.v(t, y))
    last = k[-1]
    with torch.no_grad():
        scale = torch.maximum(x.abs(), y.abs()).mul_(tolerance).add_(tolerance)
        local = powered(weighted(method.error, k).mul_(length).div_(scale))
        values = (local, scale, last - k[-2], y - before, last, last - k_1, last + k_1)
        powers, size, dk, dy, speed, apart, together = norms(*values)
    size = size / tolerance
    error = unpowered(powers)
    good = control.within(error, dk, dy, size)
    good = inspect(control, Tried(method, x, k, h, scale), good)
    control.note_poles(good, speed, size, together < apart)
    control.judge(good, error, dk, dy)
    accepted = expand_time(torch.from_numpy(good).to(x.device), x)
    return torch.where(accepted, y, x), torch.where(accepted, last, k_1)
