"""Time grids: the times between t_0 and t_1 at which fixed steps begin and end."""

import math
from itertools import pairwise

import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers.fixed import AB2
from r2flow.flow.solvers.solution import Velocity
from r2flow.registry import Registry


def uniform(t_0: float, t_1: float, steps: int) -> Tensor:
    """Equal steps; (steps + 1,) float64."""
    return torch.linspace(t_0, t_1, steps + 1, dtype=torch.float64)


def quadratic(t_0: float, t_1: float, steps: int) -> Tensor:
    """t = 1 - u^2 at equal steps of u: denser towards t = 1, forward and backward through the same times.

    Raises:
        InputError: an end beyond t = 1.
    """
    if max(t_0, t_1) > 1:
        raise InputError(f"a quadratic grid gets denser towards t = 1 and cannot go beyond it; found {t_0} to {t_1}.")
    times = 1 - uniform(math.sqrt(1 - t_0), math.sqrt(1 - t_1), steps).square()
    times[0], times[-1] = t_0, t_1  # not 1 - (1 - t)
    return times


GRIDS = Registry("time grid", uniform=uniform, quadratic=quadratic)


def build_grid(grid: str | Tensor, t_0: float, t_1: float, steps: int) -> Tensor:
    """Times from t_0 to t_1, (N + 1,) float64 on the CPU, N = steps unless the times are given.

    Raises:
        InputError: an unknown name, or given times that do not run from t_0 to t_1 in one direction.
    """
    if isinstance(grid, str):
        return GRIDS[grid](t_0, t_1, steps)
    times = grid.detach().to("cpu", torch.float64, copy=True)
    if times.ndim != 1 or len(times) < 2 or not ((times[1:] - times[:-1]) * (t_1 - t_0) > 0).all():
        raise InputError(f"a time grid must be (N + 1,) times that run in one direction, found {grid}.")
    if max(abs(times[0] - t_0), abs(times[-1] - t_1)) > 1e-6:
        raise InputError(f"this time grid runs from {times[0]:g} to {times[-1]:g}, the solution from {t_0} to {t_1}.")
    times[0], times[-1] = t_0, t_1  # what a grid kept in float32 has lost
    return times


def halved(times: Tensor) -> Tensor:
    """Every step divided into two; (N + 1,) -> (2 N + 1,)."""
    finer = times.new_empty(2 * len(times) - 1)
    finer[::2] = times
    finer[1::2] = (times[1:] + times[:-1]) / 2
    return finer


def extended(times: Tensor, t_1: float, closing: float) -> Tensor:
    """The times and further ones that halve the distance to t_1, until it is `closing` (which has a sign)."""
    left = [t_1 - float(times[-1])]
    while abs(left[-1]) > 2 * abs(closing):
        left.append(left[-1] / 2)
    further = [t_1 - way for way in left[1:]] + ([t_1 - closing] if abs(left[-1]) > 1.01 * abs(closing) else [])
    return torch.cat([times, times.new_tensor(further)])


def calibrated_grid(velocity: Velocity, x_0: Tensor, steps: int, order: int = 1, fine: int = 256) -> Tensor:
    """The time grid on which `steps` steps of a method of this order make equal local errors.

    D(t) = RMS |d^order v / dt^order| is estimated by differences along a fine solution from x_0. The local error is
    proportional to h^(order + 1) D, so that the density of steps is proportional to D^(1 / (order + 1)): the
    equidistribution of de Boor, Good approximation by splines with variable knots II, 1973.

    Args:
        velocity: v(t, x) with t of shape ().
        x_0: Noise of the scenes to calibrate on, (B, ...).
        steps: Steps of the grid.
        order: Order of the method that will use it.
        fine: Steps of the fine solution, one evaluation each; more than a few times `steps`.

    Returns:
        Times from 0 to 1, (steps + 1,) float64 on the CPU: `solve(..., grid=times)`.

    Raises:
        InputError: no step, or a solution along which the velocity is not finite.
    """
    if steps < 1 or order < 1 or fine <= order:
        raise InputError(f"needs a step, an order and more than {order} fine steps; found {steps}, {order}, {fine}.")
    times = uniform(0.0, 1.0, fine)
    density = _derivatives(velocity, x_0, times, order) ** (1 / (order + 1))
    if not density.isfinite().all():
        raise InputError("the velocity is not finite along the fine solution: no grid can be calibrated on it.")
    # Where these scenes have straight paths, the grid still has a tenth of the steps of a uniform one.
    density = density + 0.1 * density.mean() if density.any() else torch.ones_like(density)
    reached = torch.cat([torch.zeros(1, dtype=torch.float64), density.cumsum(0)])
    return _inverse(reached / reached[-1], times, steps)


def _derivatives(velocity: Velocity, x: Tensor, times: Tensor, order: int) -> Tensor:
    """RMS of the order-th difference of v along the solution, on each of the fine intervals, (N,) float64."""
    step = AB2()
    x = x if x.dtype == torch.float64 else x.float()
    differences: list[Tensor] = []
    found: list[Tensor] = []

    def noted(t: Tensor, state: Tensor) -> Tensor:
        v = velocity(t, state).to(state.dtype)
        newest = [v]
        for earlier in differences[:order]:
            newest.append(newest[-1] - earlier)
        if len(newest) > order:
            found.append(newest[order].square().mean(dtype=torch.float64).sqrt())
        differences[:] = newest
        return v

    for t, following in pairwise(times):
        x = step(noted, t.to(x), (following - t).to(x), x)
    rms = torch.stack(found).cpu()
    # Difference i spans the nodes i to i + order and belongs in their middle.
    lead = order // 2
    return torch.cat([rms[:1].expand(lead), rms, rms[-1:].expand(len(times) - 1 - lead - len(rms))])


def _inverse(share: Tensor, times: Tensor, steps: int) -> Tensor:
    """The times at which `share`, rising from 0 to 1 over `times`, is 0, 1/steps, ..., 1."""
    wanted = torch.linspace(0, 1, steps + 1, dtype=torch.float64)
    right = torch.searchsorted(share, wanted).clamp(1, len(share) - 1)
    left = right - 1
    weight = (wanted - share[left]) / (share[right] - share[left])
    grid = torch.lerp(times[left], times[right], weight)
    grid[0], grid[-1] = times[0], times[-1]
    return grid
