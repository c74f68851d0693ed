"""Embedded Runge-Kutta pairs in which every scene has its own clock.

A batch is stepped together, but each scene at its own time with its own step, error norm, controller and end, and a
scene that has arrived leaves the batch. What decides is on the host, the state stays on its device. They meet once a
step: three norms of each scene come back, the next stages' times and steps go out.
"""

import logging
import math

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.clock import Clock, Limits
from r2flow.flow.solvers.pairs import Pair
from r2flow.flow.solvers.solution import Evaluations, Solution

log = logging.getLogger(__name__)

# Local tolerances below these cost evaluations and gain no accuracy, measured on the exact problems: around a
# network in half precision they chase the noise of its rounding.
FLOOR = {torch.float64: 1e-14, torch.float32: 1e-7, torch.float16: 1e-5, torch.bfloat16: 1e-4}


# What a step is held to is (mean |e|^6)^(1/6) over a scene's elements. In data with parts, as dropped and measured
# pixels, few elements decide between them in any one step, and their error goes under in a root mean square; the
# largest error alone would give the step to a single one of them.
NORM = 6


def floored(limits: Limits, dtype: torch.dtype) -> float:
    """The tolerance, no lower than a type can hold, and a warning where that is not the one asked for."""
    floor = FLOOR[dtype]
    if limits.tolerance < floor and limits.tighter == 1:  # said once a call, not again by the tighter solution
        name = str(dtype).removeprefix("torch.")
        log.warning("a tolerance of %g is below what %s can hold: %g is used.", limits.tolerance, name, floor)
    return max(limits.tolerance, floor) / limits.tighter


def solve_adaptive(v: Evaluations, x: Tensor, t_0: float, t_1: float, pair: Pair, limits: Limits) -> Solution:
    """Every scene of x, (B, ...), from t_0 to t_1 with steps of its own; results do not depend on the neighbours."""
    clock = Clock(v.scenes, t_0, t_1, pair, limits, torch.finfo(x.dtype).eps)
    device = x.device
    results = x.clone()
    k_1 = v(clock.now(x), x)
    tolerance = floored(limits, v.precision)
    _first_steps(v, clock, x, k_1, tolerance)
    closing = math.copysign(limits.finish, t_1 - t_0)
    while True:
        if clock.leaving.any():
            gone, arrived = clock.leaving.nonzero()[0], clock.arrived[clock.leaving]
            last = _rows(x, gone)
            if closing:
                ended = torch.from_numpy(arrived).to(device)
                last = torch.where(_column(ended, x), last + closing * _rows(k_1, gone), last)
            results[torch.from_numpy(clock.places[gone]).to(device)] = last
            rest = (~clock.leaving).nonzero()[0]
            x, k_1 = _rows(x, rest), _rows(k_1, rest)
            clock.keep(rest)
            if not len(rest):
                break
            v.only(clock.scenes)
        x, k_1 = _step(v, clock, pair, x, k_1, tolerance)
    return clock.solution(results, v.counts)


def _step(v: Evaluations, clock: Clock, pair: Pair, x: Tensor, k_1: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """One attempt of every scene: its new state and velocity, or where the attempt failed its old ones."""
    times = clock.propose()
    *stages, h = torch.from_numpy(times).to(x.device, x.dtype)
    h = _column(h, x)
    k, y = [k_1], x
    for t, row in zip(stages, pair.rows, strict=True):
        before, y = y, torch.addcmul(x, _weighted(row, k), h)
        k.append(v(t, y))
    with torch.no_grad():
        error = _weighted(pair.error, k).mul_(h)
        scale = torch.maximum(x.abs(), y.abs()).mul_(tolerance).add_(tolerance)
        cubes, dk, dy = _norms(error.div_(scale).pow_(NORM // 2), k[-1] - k[-2], y - before)
    size = (cubes ** (2 / NORM)).astype(np.float32).astype(np.float64)
    accepted = clock.judge(size, dk, dy, v.counts[clock.scenes])
    if accepted.all():
        return y, k[-1]
    if not accepted.any():
        return x, k_1
    chosen = _column(torch.from_numpy(accepted).to(x.device), x)
    return torch.where(chosen, y, x), torch.where(chosen, k[-1], k_1)


@torch.no_grad()
def _first_steps(v: Evaluations, clock: Clock, x: Tensor, k_1: Tensor, tolerance: float) -> None:
    """Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4: the starting step size."""
    scale = x.abs().mul_(tolerance).add_(tolerance)
    state, slope = _norms(x / scale, k_1 / scale)
    t, h = torch.from_numpy(clock.probe(state, slope)).to(x.device, x.dtype)
    h = _column(h, x)
    change = v(t, torch.addcmul(x, k_1, h)).sub(k_1).div_(scale)
    (curvature,) = _norms(change)
    clock.start(slope, curvature, v.counts[clock.scenes])


def _weighted(weights: tuple[float, ...], k: list[Tensor]) -> Tensor:
    """sum_i weights_i k_i, a new tensor: the stages may be the network's own memory."""
    terms = [(weight, stage) for weight, stage in zip(weights, k, strict=True) if weight]
    total = terms[0][1] * terms[0][0]
    for weight, stage in terms[1:]:
        total.add_(stage, alpha=weight)
    return total


def _norms(*values: Tensor) -> np.ndarray:
    """Root mean square over each scene's elements, (len(values), B) float64, on the host at once.

    Summed in float64 and rounded to float32: the order of a sum may depend on the batch's size, which all but never
    shows in the rounded value, and a scene's steps must not depend on its neighbours.
    """
    sums = [torch.linalg.vector_norm(value.flatten(1), dim=1, dtype=torch.float64) for value in values]
    count = max(values[0][0].numel(), 1)
    with np.errstate(over="ignore"):
        return (torch.stack(sums).cpu().numpy() / math.sqrt(count)).astype(np.float32).astype(np.float64)


def _column(per_scene: Tensor, x: Tensor) -> Tensor:
    return per_scene.view(-1, *(1,) * (x.ndim - 1))


def _rows(x: Tensor, rows: np.ndarray) -> Tensor:
    return x[torch.from_numpy(rows).to(x.device)]
