"""Scenes whose path is straight take one step; the others go on with an adaptive solver."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from r2flow.errors import InputError
from r2flow.flow.solvers import check_tolerance, solve
from r2flow.flow.solvers.solution import Evaluations, Solution, Velocity, finite

NARROWING = 10.0  # factor by which the distance to t = 1 shrinks from one probe to the next


def probes(tolerance: float) -> list[float]:
    """Times at which v on the straight line is compared with v(0, x): 0.5, 0.95, 0.995, ...

    Data of standard deviation s bends the paths within about s of t = 1 and moves their ends by s. Along the line the
    velocity of N(m, s^2) differs by t s^2 / ((1 - t)^2 + t^2 s^2) |x_0|: a last probe at 1 - t = d detects s down to
    sqrt(d tolerance / 10) in the sum of `straight_scenes`, so that no s above 3 tolerances passes where d is below 90
    tolerances. At tolerance 1e-3 that is two probes, at 1e-5 four.
    """
    left = [0.5]
    while left[-1] > 90 * tolerance and left[-1] > 1e-6:  # the resolution of float32 near 1
        left.append(left[-1] / NARROWING)
    if len(left) == 1:
        left.append(left[-1] / NARROWING)
    return [1 - d for d in left]


def solve_straight_first(
    velocity: Velocity,
    x: Tensor,
    tolerance: float = 1e-3,
    method: str = "dopri5",
    progress: Callable[[], None] | None = None,
    **options: Any,
) -> Solution:
    """Solve dx/dt = v(t, x) from t = 0 to 1: by x + v(0, x) where the path is straight, by `method` elsewhere.

    Forward only: towards noise the flow of narrow data expands so much that probes along a line do not bound its error.

    Args:
        velocity: v(t, x) with t of shape () or (B,).
        x: State at t = 0, (B, ...).
        tolerance: Absolute and relative tolerance of both the probes and the solver.
        method: An adaptive solver for the scenes that are not straight; v(0, x) is not evaluated for it again.
        progress: Called after every evaluation.
        options: Further keywords of `solve`, except `global_error`: a straight scene's step has no estimate.

    Returns:
        As `solve` does; the probes count as evaluations, and a straight scene has taken one step.

    Raises:
        InputError: as `solve` does, or `global_error` is asked for.
    """
    if options.get("global_error"):
        raise InputError("straight scenes have no estimate of their global error; call `solve` for it.")
    check_tolerance(tolerance)
    x = x if x.dtype == torch.float64 else x.float()
    v = Evaluations(velocity, len(x), progress)
    k = v(x.new_zeros(()), x)
    straight = straight_scenes(v, x, k, tolerance)
    found = Solution.build(x + k, v.counts.copy(), 1, 0, False, straight.cpu().numpy())
    bent = torch.nonzero(~straight).flatten()
    if len(bent) == 0:
        return found
    rest = _Rest(velocity, bent, x[bent], k[bent], v.precision)
    end = solve(rest, x[bent], method=method, tolerance=tolerance, progress=progress, **options)
    return _merge(found, end, bent, rest.answered)


@torch.no_grad()
def straight_scenes(v: Evaluations, x: Tensor, k: Tensor, tolerance: float) -> Tensor:
    """Which scenes keep the velocity k = v(0, x) along the whole path, (B,) bool.

    The error of one Euler step is the integral of v - k along the path. It is bounded by an upper sum over the probes
    x + t k: on each interval between two of them, the larger |v - k|. A scene is straight where the root mean square of
    the bound over its elements, each divided by tolerance (1 + |x|), is at most 1. A scene that has failed is not
    probed again.
    """
    scale = tolerance * (1 + torch.maximum(x.abs(), (x + k).abs()))
    straight = finite(x) & finite(k)
    bound, before, t_before = torch.zeros_like(x), torch.zeros_like(x), 0.0
    times = [*probes(tolerance), None]
    for t in times:
        left = torch.nonzero(straight).flatten()
        if len(left) == 0:
            break
        if t is None:  # from the last probe to the end
            bound[left] += (1 - t_before) * before[left]
        else:
            v.only(left.cpu().numpy())
            away = (v(x.new_tensor(t), x[left] + t * k[left]) - k[left]).abs()
            bound[left] += (t - t_before) * torch.maximum(before[left], away)
            before[left], t_before = away, t
        rms = (bound[left] / scale[left]).square().flatten(1).mean(1).sqrt()
        straight[left] = rms <= 1  # NaN is not
    v.only(np.arange(len(x)))
    return straight


class _Rest:
    """The velocity of the scenes that go on. Its first value, v(0, x), is known and not computed again.

    Args:
        precision: The type that this value was computed in.
    """

    def __init__(self, velocity: Velocity, scenes: Tensor, start: Tensor, k: Tensor, precision: torch.dtype) -> None:
        self.velocity, self.scenes, self.answered, self.precision = velocity, scenes, 0, precision
        self._known: tuple[Tensor, Tensor] | None = (start, k)
        choose = getattr(velocity, "select", None)
        self._own = velocity if choose is None else choose(scenes.cpu())

    def __call__(self, t: Tensor, x: Tensor) -> Tensor:
        if self._known is not None:
            (start, k), self._known = self._known, None
            if x.shape == start.shape and not torch.as_tensor(t).any() and torch.equal(x, start):
                self.answered = 1
                return k
        return self._own(t, x)

    def select(self, scenes: Tensor) -> Velocity:
        choose = getattr(self.velocity, "select", None)
        return self if choose is None or len(scenes) == len(self.scenes) else choose(self.scenes.cpu()[scenes])


def _merge(first: Solution, rest: Solution, scenes: Tensor, answered: int) -> Solution:
    """The first solution with the scenes of the second in their places."""
    places = scenes.cpu()
    x = first.x.index_copy(0, scenes, rest.x.to(first.x))
    evaluations = first.evaluations.clone()
    evaluations[places] += rest.evaluations - answered
    replaced = {}
    for name in ("accepted", "rejected", "stiff", "converged"):
        values = getattr(first, name).clone()
        values[places] = getattr(rest, name)
        replaced[name] = values
    return replace(first, x=x, evaluations=evaluations, global_error=None, **replaced)
