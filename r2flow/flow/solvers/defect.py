"""What the stages of a step do not show: pulses between them, and jumps of the velocity in time.

A Runge-Kutta method sees the velocity at its stages alone. Where it jumps between two of them, dopri5's error estimate
can be 200 times smaller than the error; what lies between them is not seen at all. Therefore the velocity is compared
with the slope of the step's interpolant at further times (Enright, A new error control for initial value solvers,
1989): where two evaluations would be more than `UNSEEN` apart, and where one gap between two stages holds most of the
velocity's change. A jump is located by bisection; the step before it ends where it begins.
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
from r2flow.flow.solvers.solution import Evaluations
from r2flow.flow.solvers.step_size import REMEMBERED, SHRINK, StepController

UNSEEN = 0.15  # longest part of the interval between two evaluations
OFF_CENTRE = 0.5 - 1 / math.sqrt(5)  # of a probe in its part of a gap, so that no regular pattern escapes
# Third difference of v over a step, in tolerances, and how many times what the step before it foretells: above both, v
# is compared once in an accepted step; bisected; bisected in a step that is rejected for the first time.
COMPARED, BISECTED, FROM_REST, REJECTED = (100.0, 2.5), (40.0, 12.0), (10.0, 1e3), (40.0, 1e5)
EVEN = 0.25  # share of a change that lies in the other half of its bracket: less is a jump
POLE = 4.0  # growth of a change while its bracket shrinks: a jump's stays, a pole's has no bound
CROSSING = 0.2  # error that the crossing of a jump may add, in tolerances


class Tried(NamedTuple):
    """A step of every scene with its stages.

    Attributes:
        x, y: State before and after, (B, ...).
        k: Stages.
        h: Signed length, (B,).
        scale: Tolerance of every element's error, (B, ...).
    """

    method: EmbeddedMethod
    x: Tensor
    y: Tensor
    k: list[Tensor]
    h: Tensor
    scale: Tensor

    def of(self, places: np.ndarray) -> "Tried":
        """The step of some scenes."""
        x, y, h, scale = (rows(part, places) for part in (self.x, self.y, self.h, self.scale))
        return Tried(self.method, x, y, [rows(part, places) for part in self.k], h, scale)

    def at(self, theta: np.ndarray) -> tuple[Tensor, Tensor]:
        """State and slope of the interpolant at a share of the step, 0 to 1, for every scene."""
        state, slope = (torch.from_numpy(w).to(self.x.device, self.x.dtype) for w in self.method.interpolant(theta))
        way, slope = (weighted([expand_time(w, self.x) for w in weights], self.k) for weights in (state, slope))
        return torch.addcmul(self.x, way, expand_time(self.h, self.x)), slope

    def changes(self, *differences: Tensor) -> np.ndarray:
        """Norms of h times differences of velocities, in tolerances, (N, B)."""
        length = expand_time(self.h, self.x) / self.scale
        return unpowered(norms(*(powered(difference * length) for difference in differences)))

    def roughness(self) -> np.ndarray:
        """h times the third difference of v, in tolerances, (B,)."""
        return self.changes(weighted(self.method.third_difference, self.k))[0]


@dataclass
class _Bracket:
    """Shares of a step between which v may jump, v there without its smooth trend, and how much that changes.

    Attributes:
        trend: Change of v over the step, the median over its stages, of every element.
        most: Largest change of any half.
        whole: Change over the first bracket.
    """

    left: float
    right: float
    before: Tensor
    after: Tensor
    change: float
    trend: Tensor
    most: float = 0.0
    whole: float = math.inf

    @classmethod
    def first(cls, step: Tried, also: dict[float, Tensor]) -> "_Bracket":
        """The first two neighbours, of the stages and one further value of a scene, between which v changes most."""
        points = sorted({**{theta: step.k[i] for theta, i in step.method.distinct.items()}, **also}.items())
        slopes = [(after - before) / (right - left) for (left, before), (right, after) in pairwise(points)]
        trend = torch.stack(slopes).median(0).values
        values = [(theta, found - theta * trend) for theta, found in points]
        changes = step.changes(*(after - before for (_, before), (_, after) in pairwise(values)))[:, 0]
        begin = int((changes >= changes.max() / 2).argmax())
        (left, before), (right, after) = values[begin : begin + 2]
        return cls(left, right, before[0], after[0], changes[begin], trend[0], whole=changes[begin])

    @property
    def middle(self) -> float:
        return (self.left + self.right) / 2

    def halve(self, found: Tensor, first: float, second: float) -> bool:
        """Continue in the half that holds the jump; False where v does not jump: it changes in both, or has a pole."""
        most, middle = max(first, second), self.middle
        smooth = min(first, second) > EVEN * most and self.change > 1.2 * most  # less: there and back, a pulse
        self.most = max(self.most, most)
        if smooth or self.most > POLE * self.whole or not self.most / 2 <= most < math.inf:
            return False
        if first >= most / 2:
            self.right, self.after, self.change = middle, found, first
        else:
            self.left, self.before, self.change = middle, found, second
        return True

    def error(self) -> float:
        """That of a trapezoidal step across the bracket, in tolerances."""
        return self.change * (self.right - self.left) / 2


def probes(method: EmbeddedMethod, share: float) -> list[float]:
    """Shares of a step at which v is compared, if the step spans this share of the interval."""
    found = []
    # A stage without a weight in the error changes nothing by what it sees.
    for left, right in pairwise(theta for theta, i in method.distinct.items() if method.error[i]):
        pieces = math.ceil((right - left) * share / UNSEEN)
        found += [left + (right - left) * (i + OFF_CENTRE) / pieces for i in range(1, pieces)]
    return found


@torch.no_grad()
def inspect(v: Evaluations, control: StepController, tried: Tried, good: np.ndarray) -> np.ndarray:
    """Which of the accepted steps hold, (B,) bool; tells the controller where the others end."""
    control.roughness = tried.roughness()
    compared, bisected = control.rougher(*COMPARED), control.rougher(*BISECTED) | control.rougher(*FROM_REST)
    bisected &= good | (control.troubled == REMEMBERED) | control.rougher(*REJECTED)
    asked: dict[int, list[float]] = {}
    for place in good.nonzero()[0]:
        one = [0.5 + OFF_CENTRE] if compared[place] else []
        asked[int(place)] = probes(tried.method, control.h[place] / control.length) or one
    brackets = {int(place): _Bracket.first(tried.of(np.array([place])), {}) for place in bisected.nonzero()[0]}
    held = good.copy()
    for turn in range(max(map(len, asked.values()), default=0)):
        places = np.array([place for place, thetas in asked.items() if held[place] and turn < len(thetas)], int)
        if not len(places):
            break
        theta, step = np.array([asked[place][turn] for place in places]), tried.of(places)
        state, slope = step.at(theta)
        found = _ask(v, control, places, theta, state)
        (sizes,) = step.changes(found - slope)
        for row, place in enumerate(places):
            if not sizes[row] <= tried.method.defect:
                held[place] = False
                also = {float(theta[row]): found[row : row + 1]}
                brackets[int(place)] = _Bracket.first(tried.of(np.array([place])), also)
    if brackets:
        _locate(v, control, tried, brackets, held)
    return held


def _locate(
    v: Evaluations, control: StepController, tried: Tried, brackets: dict[int, _Bracket], held: np.ndarray
) -> None:
    """Bisect every bracket until the jump in it is found, or none; a step with a jump does not hold."""
    least = control.shortest() / control.h
    while brackets:
        places = np.array(sorted(brackets))
        step, own = tried.of(places), [brackets[place] for place in sorted(brackets)]
        theta = np.array([bracket.middle for bracket in own])
        trends, before, after = (
            torch.stack([getattr(bracket, name) for bracket in own]) for name in ("trend", "before", "after")
        )
        found = _ask(v, control, places, theta, step.at(theta)[0])
        found -= trends * expand_time(torch.from_numpy(theta).to(trends), trends)
        changes = step.changes(found - before, after - found)
        for row, (place, bracket) in enumerate(zip(places, own, strict=True)):
            if not bracket.halve(found[row], *changes[:, row]):
                if not held[place]:
                    control.shorten(place, max(bracket.left, bracket.right - bracket.left))
            elif bracket.right - bracket.left <= least[place] and bracket.error() > CROSSING:
                control.shorten(place, SHRINK)  # a pole: no step across it is within the tolerance, however short
                held[place] = False
            elif bracket.error() <= CROSSING:
                control.stop_at(place, bracket.left, bracket.right)
                held[place] = False
            else:
                continue
            del brackets[int(place)]


def _ask(v: Evaluations, control: StepController, places: np.ndarray, theta: np.ndarray, x: Tensor) -> Tensor:
    """v of some scenes within their step; NaN where the budget is used up."""
    found, able = torch.full_like(x, math.nan), control.able(v.counts, places)
    if able.any():
        t = torch.from_numpy(control.time(control.reached[places] + theta * control.h[places])).to(x.device, x.dtype)
        chosen = able.nonzero()[0]
        found[torch.from_numpy(able).to(x.device)] = v.some(places[able], rows(t, chosen), rows(x, chosen))
    return found
