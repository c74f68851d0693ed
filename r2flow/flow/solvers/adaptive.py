"""Embedded Runge-Kutta methods with a separate step size per scene.

A batch is stepped together, but every scene has its own time, step size and error norm, and leaves the batch when it
has reached t_1. Step sizes are controlled on the host; the state stays on its device. Per step, a few norms per scene
are copied to the host, and the times and sizes of the next step back.
"""

import logging

import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.batched import norms, powered, rows, unpowered, weighted
from r2flow.flow.solvers.defect import Tried, inspect
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations, Limits, finite, flat
from r2flow.flow.solvers.step_size import StepController

log = logging.getLogger(__name__)

# Lower tolerances cost evaluations without gaining accuracy (measured on the exact problems), since rounding noise of
# the network dominates the error estimate.
LEAST_TOLERANCE = {torch.float64: 1e-14, torch.float32: 1e-7, torch.float16: 1e-5, torch.bfloat16: 1e-4}

SHORT = 1e-3  # of the interval: steps below this are checked for poles


def attainable(limits: Limits, dtype: torch.dtype) -> float:
    """The requested tolerance, or a type's least one, with a warning, if that is higher."""
    least = LEAST_TOLERANCE[dtype]
    if limits.tolerance < least and limits.tighter == 1:  # no second warning for the error estimate
        name = str(dtype).removeprefix("torch.")
        log.warning("a tolerance of %g is below what %s can hold: %g is used.", limits.tolerance, name, least)
    return max(limits.tolerance, least) / limits.tighter


def advance(v: Evaluations, x: Tensor, t_0: float, t_1: float, method: EmbeddedMethod, limits: Limits) -> Tensor:
    """The last state of every scene of x, (B, ...), from t_0 to t_1 by its own steps."""
    control = StepController(v, t_0, t_1, method, limits, torch.finfo(x.dtype).eps)
    results = x.clone()
    k_1 = v(x.new_full((len(x),), t_0), x)
    tolerance = attainable(limits, v.precision)
    with torch.no_grad():
        scale = x.abs().mul(tolerance).add_(tolerance)
        state, slope = norms(x / scale, k_1 / scale)
        control.start(state, slope)
    while True:
        if control.leaving.any():
            leaving = control.leaving.nonzero()[0]
            results[torch.from_numpy(v.scenes[leaving]).to(x.device)] = rows(x, leaving)
            remaining = (~control.leaving).nonzero()[0]
            x, k_1 = rows(x, remaining), rows(k_1, remaining)
            control.keep(remaining)
            if not len(remaining):
                return results
        x, k_1 = _step(control, x, k_1, tolerance)


def _step(control: StepController, x: Tensor, k_1: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Try one step of every scene. Returns new states and velocities, unchanged for rejected steps."""
    method = control.method
    *stages, h = torch.from_numpy(control.propose()).to(x.device, x.dtype)
    k, y = [k_1], x
    for t, row in zip(stages, method.rows, strict=True):
        previous_y, y = y, torch.addcmul(x, weighted(row, k), expand_time(h, x))
        k.append(control.v(t, y))
    with torch.no_grad():
        scale = torch.maximum(x.abs(), y.abs()).mul_(tolerance).add_(tolerance)
        error = weighted(method.error, k).mul_(expand_time(h, x)).div_(scale)
        powers, dk, dy, distance = norms(powered(error), k[-1] - k[-2], y - previous_y, scale)
    size = unpowered(powers)
    good = control.within(size, dk, dy, distance / tolerance)
    good = inspect(control, Tried(method, x, y, k, h, scale), good)
    short = (good & (control.h < SHORT * control.length)).nonzero()[0]
    control.judge(good, size, dk, dy)
    if len(short):
        first, last, end = (rows(part.detach(), short) for part in (k[0], k[-1], y))
        displacement, length = last * expand_time(rows(h, short), last), 1 + end.abs()
        share = flat(displacement).norm(dim=1) / flat(length).norm(dim=1)
        back = flat(first * displacement * expand_time(rows(h, short), displacement)).sum(1) < 0
        control.note_pole(short, rows(h, short).abs().cpu().numpy(), share.cpu().numpy(), back.cpu().numpy())
    if good.all():
        x, k_1 = y, k[-1]
    elif good.any():
        chosen = expand_time(torch.from_numpy(good).to(x.device), x)
        x, k_1 = torch.where(chosen, y, x), torch.where(chosen, k[-1], k_1)
    return _cross(control, x, k_1) if control.crossing.any() else (x, k_1)


def _cross(control: StepController, x: Tensor, k_1: Tensor) -> tuple[Tensor, Tensor]:
    """Step across jumps of the velocity, by the mean of the velocities on both sides."""
    places = control.crossing.nonzero()[0]
    t, h = torch.from_numpy(control.cross()).to(x.device, x.dtype)
    start, before, h = rows(x, places), rows(k_1, places), expand_time(h, x)
    after = control.v.some(places, t, start + h * before)
    end = start + h / 2 * (before + after)
    is_finite = finite(end) & finite(after)
    control.give_up(places[~is_finite.cpu().numpy()])
    end, after = (torch.where(expand_time(is_finite, x), new, old) for new, old in ((end, start), (after, before)))
    index = torch.from_numpy(places).to(x.device)
    return x.index_copy(0, index, end), k_1.index_copy(0, index, after)
