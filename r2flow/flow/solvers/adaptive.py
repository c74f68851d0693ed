"""Embedded Runge-Kutta methods with a step size of its own for every scene.

A batch is stepped together, but every scene has its own time, step size and error norm, and leaves the batch when it
has arrived. The step sizes are controlled on the host, the state stays on its device. Once a step, three norms of every
scene come to the host and the times and sizes of the next step go back.
"""

import logging
import math

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.solution import Evaluations, Solution
from r2flow.flow.solvers.step_size import Limits, StepController

log = logging.getLogger(__name__)

# Tolerances below these cost evaluations and gain no accuracy (measured on the exact problems): the error estimate is
# then the rounding noise of the network.
LEAST_TOLERANCE = {torch.float64: 1e-14, torch.float32: 1e-7, torch.float16: 1e-5, torch.bfloat16: 1e-4}

# The error of a step is (mean |e|^6)^(1/6) over a scene's elements. In a scene of dropped and measured pixels, few
# elements turn towards one or the other in any one step. A root mean square hides their error; the maximum would let a
# single element set the step.
NORM = 6


def attainable(limits: Limits, dtype: torch.dtype) -> float:
    """The tolerance to use, no lower than a type can hold; warns where that is not the one asked for."""
    least = LEAST_TOLERANCE[dtype]
    if limits.tolerance < least and limits.tighter == 1:  # not a second time for the error estimate
        name = str(dtype).removeprefix("torch.")
        log.warning("a tolerance of %g is below what %s can hold: %g is used.", limits.tolerance, name, least)
    return max(limits.tolerance, least) / limits.tighter


def solve_adaptive(
    v: Evaluations, x: Tensor, t_0: float, t_1: float, method: EmbeddedMethod, limits: Limits
) -> Solution:
    """Solve every scene of x, (B, ...), from t_0 to t_1; its result does not depend on the others."""
    control = StepController(v.scenes, t_0, t_1, method, limits, torch.finfo(x.dtype).eps)
    device = x.device
    results = x.clone()
    k_1 = v(control.now(x), x)
    tolerance = attainable(limits, v.precision)
    _first_steps(v, control, x, k_1, tolerance)
    closing = math.copysign(limits.finish, t_1 - t_0)
    while True:
        if control.leaving.any():
            gone, arrived = control.leaving.nonzero()[0], control.arrived[control.leaving]
            last = _rows(x, gone)
            if closing:
                ended = torch.from_numpy(arrived).to(device)
                last = torch.where(_column(ended, x), last + closing * _rows(k_1, gone), last)
            results[torch.from_numpy(control.places[gone]).to(device)] = last
            rest = (~control.leaving).nonzero()[0]
            x, k_1 = _rows(x, rest), _rows(k_1, rest)
            control.keep(rest)
            if not len(rest):
                break
            v.only(control.scenes)
        x, k_1 = _step(v, control, method, x, k_1, tolerance)
    return control.solution(results, v.counts)


def _step(
    v: Evaluations, control: StepController, method: EmbeddedMethod, x: Tensor, k_1: Tensor, tolerance: float
) -> tuple[Tensor, Tensor]:
    """Try one step of every scene: its new state and velocity, or the old ones where the step is rejected."""
    times = control.propose()
    *stages, h = torch.from_numpy(times).to(x.device, x.dtype)
    h = _column(h, x)
    k, y = [k_1], x
    for t, row in zip(stages, method.rows, strict=True):
        before, y = y, torch.addcmul(x, _weighted(row, k), h)
        k.append(v(t, y))
    with torch.no_grad():
        error = _weighted(method.error, k).mul_(h)
        scale = torch.maximum(x.abs(), y.abs()).mul_(tolerance).add_(tolerance)
        cubes, dk, dy = _norms(error.div_(scale).pow_(NORM // 2), k[-1] - k[-2], y - before)
    size = (cubes ** (2 / NORM)).astype(np.float32).astype(np.float64)
    accepted = control.judge(size, dk, dy, v.counts[control.scenes])
    if accepted.all():
        return y, k[-1]
    if not accepted.any():
        return x, k_1
    chosen = _column(torch.from_numpy(accepted).to(x.device), x)
    return torch.where(chosen, y, x), torch.where(chosen, k[-1], k_1)


@torch.no_grad()
def _first_steps(v: Evaluations, control: StepController, x: Tensor, k_1: Tensor, tolerance: float) -> None:
    """Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4: the starting step size."""
    scale = x.abs().mul_(tolerance).add_(tolerance)
    state, slope = _norms(x / scale, k_1 / scale)
    t, h = torch.from_numpy(control.probe(state, slope)).to(x.device, x.dtype)
    h = _column(h, x)
    change = v(t, torch.addcmul(x, k_1, h)).sub(k_1).div_(scale)
    (curvature,) = _norms(change)
    control.start(slope, curvature, v.counts[control.scenes])


def _weighted(weights: tuple[float, ...], k: list[Tensor]) -> Tensor:
    """sum_i weights_i k_i, always a new tensor: a stage may be a buffer that the network writes to again."""
    terms = [(weight, stage) for weight, stage in zip(weights, k, strict=True) if weight]
    total = terms[0][1] * terms[0][0]
    for weight, stage in terms[1:]:
        total.add_(stage, alpha=weight)
    return total


def _norms(*values: Tensor) -> np.ndarray:
    """Root mean square over each scene's elements, (len(values), B) float64, in one transfer to the host.

    Summed in float64 and rounded to float32: the order of summation may depend on the size of the batch, and a scene's
    steps must not. The rounding removes the difference in nearly all cases.
    """
    sums = [torch.linalg.vector_norm(value.flatten(1), dim=1, dtype=torch.float64) for value in values]
    count = max(values[0][0].numel(), 1)
    with np.errstate(over="ignore"):
        return (torch.stack(sums).cpu().numpy() / math.sqrt(count)).astype(np.float32).astype(np.float64)


def _column(per_scene: Tensor, x: Tensor) -> Tensor:
    return per_scene.view(-1, *(1,) * (x.ndim - 1))


def _rows(x: Tensor, rows: np.ndarray) -> Tensor:
    return x[torch.from_numpy(rows).to(x.device)]
