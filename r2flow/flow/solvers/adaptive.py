"""Embedded Runge-Kutta methods with a step size of its own for every scene.

A batch is stepped together, but every scene has its own time, step size and error norm, and leaves the batch when it
has arrived. The step sizes are controlled on the host, the state stays on its device. Once a step, three norms of every
scene come to the host and the times and sizes of the next step go back.
"""

import logging

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.batched import norms, powered, rows, unpowered, weighted
from r2flow.flow.solvers.defect import Tried, inspect
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations, Limits, Solution, finite
from r2flow.flow.solvers.step_size import StepController

log = logging.getLogger(__name__)

# Tolerances below these cost evaluations and gain no accuracy (measured on the exact problems): the error estimate is
# then the rounding noise of the network.
LEAST_TOLERANCE = {torch.float64: 1e-14, torch.float32: 1e-7, torch.float16: 1e-5, torch.bfloat16: 1e-4}


SHORT = 1e-3  # of the interval: steps whose length of path is looked at, for poles


def attainable(limits: Limits, dtype: torch.dtype) -> float:
    """The tolerance to use, no lower than a type can hold; warns where that is not the one asked for."""
    least = LEAST_TOLERANCE[dtype]
    if limits.tolerance < least and limits.tighter == 1:  # not a second time for the error estimate
        name = str(dtype).removeprefix("torch.")
        log.warning("a tolerance of %g is below what %s can hold: %g is used.", limits.tolerance, name, least)
    return max(limits.tolerance, least) / limits.tighter


def advance(
    v: Evaluations, x: Tensor, t_0: float, t_1: float, method: EmbeddedMethod, limits: Limits
) -> tuple[Solution, np.ndarray]:
    """Solve every scene of x, (B, ...), from t_0 to t_1, each by its own steps.

    Returns:
        The solution, and the time that each scene has reached, (B,).
    """
    control = StepController(v.scenes, t_0, t_1, method, limits, torch.finfo(x.dtype).eps)
    results = x.clone()
    k_1 = v(control.now(x), x)
    tolerance = attainable(limits, v.precision)
    with torch.no_grad():
        scale = x.abs().mul(tolerance).add_(tolerance)
        state, slope = norms(x / scale, k_1 / scale)
        control.start(state, slope, v.counts)
    while True:
        if control.leaving.any():
            gone = control.leaving.nonzero()[0]
            results[torch.from_numpy(control.places[gone]).to(x.device)] = rows(x, gone)
            rest = (~control.leaving).nonzero()[0]
            x, k_1 = rows(x, rest), rows(k_1, rest)
            control.keep(rest)
            if not len(rest):
                break
            v.only(control.scenes)
        x, k_1 = _step(v, control, method, x, k_1, tolerance)
    return control.solution(results, v.counts), control.times


def _step(
    v: Evaluations, control: StepController, method: EmbeddedMethod, x: Tensor, k_1: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Try one step of every scene: its new state and velocity, or the old ones where the step is rejected."""
    times = control.propose()
    *stages, h = torch.from_numpy(times).to(x.device, x.dtype)
    k, y = [k_1], x
    for t, row in zip(stages, method.rows, strict=True):
        before, y = y, torch.addcmul(x, weighted(row, k), expand_time(h, x))
        k.append(v(t, y))
    with torch.no_grad():
        scale = torch.maximum(x.abs(), y.abs()).mul_(tolerance).add_(tolerance)
        error = weighted(method.error, k).mul_(expand_time(h, x)).div_(scale)
        powers, dk, dy, whole = norms(powered(error), k[-1] - k[-2], y - before, scale)
    size = unpowered(powers)
    good = control.within(size, dk, dy, whole / tolerance)
    good = inspect(v, control, Tried(method, x, y, k, h, scale), good)
    short = (good & (control.h < SHORT * control.length)).nonzero()[0]
    control.judge(good, size, dk, dy, v.counts[control.scenes])
    if len(short):
        way, length = rows(k[-1] * expand_time(h, x), short), 1 + rows(y, short).abs()
        share = way.flatten(1).norm(dim=1) / length.flatten(1).norm(dim=1)
        back = (rows(k[0], short) * way * expand_time(rows(h, short), way)).flatten(1).sum(1) < 0
        control.note_pole(short, rows(h, short).abs().cpu().numpy(), share.cpu().numpy(), back.cpu().numpy())
    if good.all():
        x, k_1 = y, k[-1]
    elif good.any():
        chosen = expand_time(torch.from_numpy(good).to(x.device), x)
        x, k_1 = torch.where(chosen, y, x), torch.where(chosen, k[-1], k_1)
    return _cross(v, control, x, k_1) if control.crossing.any() else (x, k_1)


def _cross(v: Evaluations, control: StepController, x: Tensor, k_1: Tensor) -> tuple[Tensor, Tensor]:
    """Cross the jumps that scenes stand before, by the mean of the velocities on either side."""
    places = control.crossing.nonzero()[0]
    t, h = torch.from_numpy(control.cross()).to(x.device, x.dtype)
    here, before, h = rows(x, places), rows(k_1, places), expand_time(h, x)
    after = v.some(places, t, here + h * before)
    there = here + h / 2 * (before + after)
    whole = finite(there) & finite(after)
    control.give_up(places[~whole.cpu().numpy()])
    there, after = (torch.where(expand_time(whole, x), new, old) for new, old in ((there, here), (after, before)))
    at = torch.from_numpy(places).to(x.device)
    return x.index_copy(0, at, there), k_1.index_copy(0, at, after)
