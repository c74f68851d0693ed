"""Defect control: detects pulses between the stages of a step, and jumps of the velocity in time.

A Runge-Kutta method evaluates the velocity only at its stages. If the velocity jumps between two stages, dopri5's error
estimate can be 200 times smaller than the error; a pulse between two stages is missed entirely. Therefore the velocity
is compared with the slope of the step's interpolant at additional times (Enright, A new error control for initial value
solvers, 1989): if two evaluations are more than `UNSEEN` apart, or if one gap between two stages has most of the
velocity's change. Bisection locates a jump; the step before the jump ends at it.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.batched import norms, powered, rows, unpowered, weighted
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.step_size import REMEMBERED, SHRINK, StepController

UNSEEN = 0.15  # longest part of the interval between two evaluations
OFF_CENTRE = 0.5 - 1 / math.sqrt(5)  # offset of a probe in its part of a gap, against aliasing with regular patterns
# Thresholds on the third difference of v over a step: in tolerances, and relative to the extrapolation from the step
# before. Above both: compare v once in an accepted step; bisect (two pairs); bisect a step rejected for the first time.
COMPARED, BISECTED, FROM_REST, REJECTED = (100.0, 2.5), (40.0, 12.0), (10.0, 1e3), (40.0, 1e5)
EVEN = 0.25  # share of a change in the other half of its bracket; a jump has less
POLE = 4.0  # growth of a change while its bracket shrinks: constant for a jump, unbounded for a pole
CROSSING = 0.2  # largest error of crossing a jump, in tolerances


class Tried(NamedTuple):
    """A step of every scene with its stages."""

    method: EmbeddedMethod
    x: Tensor  # state before, (B, ...)
    y: Tensor  # state after
    k: list[Tensor]  # stages
    h: Tensor  # signed length, (B,)
    scale: Tensor  # tolerance of every element's error, (B, ...)

    def of(self, places: np.ndarray) -> "Tried":
        """The step of the scenes with these indices."""
        x, y, h, scale = (rows(part, places) for part in (self.x, self.y, self.h, self.scale))
        return Tried(self.method, x, y, [rows(part, places) for part in self.k], h, scale)

    def at(self, theta: np.ndarray) -> tuple[Tensor, Tensor]:
        """State and slope of the interpolant at theta in [0, 1] of the step, for every scene."""
        state, slope = (torch.from_numpy(w).to(self.x.device, self.x.dtype) for w in self.method.interpolant(theta))
        shift, slope = (weighted([expand_time(w, self.x) for w in weights], self.k) for weights in (state, slope))
        return torch.addcmul(self.x, shift, expand_time(self.h, self.x)), slope

    def changes(self, *differences: Tensor) -> np.ndarray:
        """Norms of h times differences of velocities, in tolerances, (N, B)."""
        length = expand_time(self.h, self.x) / self.scale
        return unpowered(norms(*(powered(difference * length) for difference in differences)))


@dataclass
class _Bracket:
    """An interval of a step, in shares of its length, in which v may jump."""

    left: float
    right: float
    before: Tensor  # v at the left end, minus its smooth trend
    after: Tensor  # at the right end
    change: float  # norm of h (after - before), in tolerances
    trend: Tensor  # slope of v per step, the median over the gaps between stages, per element
    most: float = 0.0  # largest change of any half so far
    whole: float = math.inf  # change over the first bracket

    @classmethod
    def first(cls, step: Tried, also: dict[float, Tensor]) -> "_Bracket":
        """The first pair of neighbouring values (stages and `also`) with at least half of the largest change of v."""
        points = sorted({**{theta: step.k[i] for theta, i in step.method.distinct.items()}, **also}.items())
        slopes = [(after - before) / (right - left) for (left, before), (right, after) in pairwise(points)]
        trend = torch.stack(slopes).median(0).values
        values = [(theta, value - theta * trend) for theta, value in points]
        changes = step.changes(*(after - before for (_, before), (_, after) in pairwise(values)))[:, 0]
        begin = int((changes >= changes.max() / 2).argmax())
        (left, before), (right, after) = values[begin : begin + 2]
        return cls(left, right, before[0], after[0], changes[begin], trend[0], whole=changes[begin])

    @property
    def middle(self) -> float:
        return (self.left + self.right) / 2

    def halve(self, value: Tensor, first: float, second: float) -> bool:
        """Continue in the half with the jump; False if v does not jump: it changes in both halves, or has a pole."""
        most, middle = max(first, second), self.middle
        smooth = min(first, second) > EVEN * most and self.change > 1.2 * most  # less: a pulse
        self.most = max(self.most, most)
        if smooth or self.most > POLE * self.whole or not self.most / 2 <= most < math.inf:
            return False
        if first >= most / 2:
            self.right, self.after, self.change = middle, value, first
        else:
            self.left, self.before, self.change = middle, value, second
        return True

    def error(self) -> float:
        """Error of a trapezoidal step across the bracket, in tolerances."""
        return self.change * (self.right - self.left) / 2


def probes(method: EmbeddedMethod, share: float) -> list[float]:
    """Times, as shares of a step, at which v is compared if the step spans this share of the interval."""
    thetas = []
    # Only stages with a weight in the error estimate count.
    for left, right in pairwise(theta for theta, i in method.distinct.items() if method.error[i]):
        pieces = math.ceil((right - left) * share / UNSEEN)
        thetas += [left + (right - left) * (i + OFF_CENTRE) / pieces for i in range(1, pieces)]
    return thetas


@torch.no_grad()
def inspect(control: StepController, tried: Tried, good: np.ndarray) -> np.ndarray:
    """Which of the accepted steps remain accepted, (B,) bool; tells the controller where the others must end."""
    control.roughness = tried.changes(weighted(tried.method.third_difference, tried.k))[0]
    compared, bisected = control.rougher(*COMPARED), control.rougher(*BISECTED) | control.rougher(*FROM_REST)
    bisected &= good | (control.troubled == REMEMBERED) | control.rougher(*REJECTED)
    planned: dict[int, list[float]] = {}
    for place in good.nonzero()[0]:
        single = [0.5 + OFF_CENTRE] if compared[place] else []
        planned[int(place)] = probes(tried.method, control.h[place] / control.length) or single
    brackets = {int(place): _Bracket.first(tried.of(np.array([place])), {}) for place in bisected.nonzero()[0]}
    held = good.copy()
    for turn in range(max(map(len, planned.values()), default=0)):
        places = np.array([place for place, thetas in planned.items() if held[place] and turn < len(thetas)], int)
        if not len(places):
            break
        theta, step = np.array([planned[place][turn] for place in places]), tried.of(places)
        state, slope = step.at(theta)
        v_probe = _ask(control, places, theta, state)
        (sizes,) = step.changes(v_probe - slope)
        for row, place in enumerate(places):
            if not sizes[row] <= tried.method.defect:
                held[place] = False
                also = {float(theta[row]): v_probe[row : row + 1]}
                brackets[int(place)] = _Bracket.first(tried.of(np.array([place])), also)
    if brackets:
        _locate(control, tried, brackets, held)
    return held


def _locate(control: StepController, tried: Tried, brackets: dict[int, _Bracket], held: np.ndarray) -> None:
    """Bisect every bracket until its jump is located or excluded; reject steps with a jump."""
    least = control.shortest() / control.h
    while brackets:
        places = np.array(sorted(brackets))
        step, ordered = tried.of(places), [brackets[place] for place in sorted(brackets)]
        theta = np.array([bracket.middle for bracket in ordered])
        trends, before, after = (
            torch.stack([getattr(bracket, name) for bracket in ordered]) for name in ("trend", "before", "after")
        )
        v_middle = _ask(control, places, theta, step.at(theta)[0])
        v_middle -= trends * expand_time(torch.from_numpy(theta).to(trends), trends)
        changes = step.changes(v_middle - before, after - v_middle)
        for row, (place, bracket) in enumerate(zip(places, ordered, strict=True)):
            if not bracket.halve(v_middle[row], *changes[:, row]):
                if not held[place]:
                    control.shorten(place, max(bracket.left, bracket.right - bracket.left))
            elif bracket.right - bracket.left <= least[place] and bracket.error() > CROSSING:
                control.shorten(place, SHRINK)  # a pole: no step across it meets the tolerance
                held[place] = False
            elif bracket.error() <= CROSSING:
                control.stop_at(place, bracket.left, bracket.right)
                held[place] = False
            else:
                continue
            del brackets[int(place)]


def _ask(control: StepController, places: np.ndarray, theta: np.ndarray, x: Tensor) -> Tensor:
    """v of some scenes at shares theta of their steps; NaN for scenes without budget."""
    values, able = torch.full_like(x, math.nan), control.able(places)
    if able.any():
        t = torch.from_numpy(control.time(control.reached[places] + theta * control.h[places])).to(x.device, x.dtype)
        chosen = able.nonzero()[0]
        values[torch.from_numpy(able).to(x.device)] = control.v.some(places[able], rows(t, chosen), rows(x, chosen))
    return values
