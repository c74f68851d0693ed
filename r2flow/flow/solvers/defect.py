"""Defect control: detects pulses between the stages of a step, and jumps of the velocity in time.

A Runge-Kutta method evaluates the velocity only at its stages. If the velocity jumps between two
stages, dopri5's error estimate can be 200 times smaller than the error; a pulse between two stages
is missed entirely. Therefore the velocity is compared with the slope of the step's interpolant at
additional times (Enright, A new error control for initial value solvers, 1989): if two evaluations
are more than `_UNSEEN` apart, or if one gap between two stages has most of the velocity's change.
Bisection locates a jump; the step before the jump ends at it. The time at which a rejected step saw
most is compared again in the accepted step that passes it.
"""

import math
from itertools import count, pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from r2flow.flow.path import expand_time
from r2flow.flow.solvers.batched import norms, powered, unpowered, weighted
from r2flow.flow.solvers.embedded import EmbeddedMethod
from r2flow.flow.solvers.step_size import REMEMBERED, SHRINK, StepController

_UNSEEN = 0.15  # longest part of the interval between two evaluations
# Offset of a probe in its part of a gap, against aliasing with regular patterns.
_OFF_CENTRE = 0.5 - 1 / math.sqrt(5)
# Thresholds on the third difference of v over a step: in tolerances, and relative to the
# extrapolation from the step before. Above both: compare v once in an accepted step; bisect (two
# pairs); bisect a step rejected for the first time.
_COMPARED = (100.0, 2.5)
_BISECTED = (40.0, 12.0)
_FROM_REST = (10.0, 1e3)
_REJECTED = (40.0, 1e5)
_EVEN = 0.25  # share of a change in the other half of its bracket; a jump has less
# Growth of a change while its bracket shrinks: constant for a jump, unbounded for a pole.
_POLE = 4.0
_GROSS = 10.0  # a bisected step that its error estimate accepts: in largest defects
_CROSSING = 0.2  # largest error of crossing a jump, in tolerances


_Velocities = dict[float, Tensor]  # of a scene, by share of its step


class Tried(NamedTuple):
    """A step of every scene with its stages."""

    method: EmbeddedMethod
    x: Tensor  # state before, (B, ...)
    k: list[Tensor]  # stages
    h: Tensor  # signed length, (B,)
    scale: Tensor  # tolerance of every element's error, (B, ...)

    def of(self, places: ndarray) -> "Tried":
        k = [stage[places] for stage in self.k]
        return Tried(self.method, self.x[places], k, self.h[places], self.scale[places])

    def at(self, theta: ndarray) -> tuple[Tensor, Tensor]:
        """State and slope of the interpolant at theta in [0, 1] of the step, for every scene."""
        scenes = (-1, len(theta), *(1,) * (self.x.ndim - 1))
        weights = self.x.new_tensor(self.method.interpolant(theta)).view(2, *scenes)
        shift, slope = (weights * torch.stack(self.k)).sum(1)
        return torch.addcmul(self.x, shift, expand_time(self.h, self.x)), slope

    def changes(self, *differences: Tensor) -> ndarray:
        """Norms of h times differences of velocities, in tolerances, (N, B)."""
        length = expand_time(self.h, self.x) / self.scale
        return unpowered(norms(*(powered(difference * length) for difference in differences)))


def _probes(method: EmbeddedMethod, share: float) -> list[float]:
    """Times, in shares of a step, to compare v at if it spans this share of the interval."""
    thetas = []
    # Only stages with a weight in the error estimate count.
    for left, right in pairwise(theta for theta, i in method.distinct.items() if method.error[i]):
        pieces = math.ceil((right - left) * share / _UNSEEN)
        thetas += [left + (right - left) * (i + _OFF_CENTRE) / pieces for i in range(1, pieces)]
    return thetas


@torch.no_grad()
def inspect(control: StepController, tried: Tried, good: ndarray) -> ndarray:
    """Which good steps remain so, (B,) bool; tells the controller where the others must end."""
    method = tried.method
    control.roughness = tried.changes(weighted(method.third_difference, tried.k))[0]
    suspect = control.rougher(*_BISECTED) | control.rougher(*_FROM_REST)
    suspect &= good | (control.troubled == REMEMBERED) | control.rougher(*_REJECTED)
    compared = control.rougher(*_COMPARED)
    planned = {}
    for place in good.nonzero()[0].tolist():
        once = [0.5 + _OFF_CENTRE] if compared[place] else []
        even = _probes(method, control.h[place] / control.length) or once
        planned[place] = even + control.remembered(place)
    held = good.copy()
    found: dict[int, _Velocities] = {}  # v at the probe that shows a change, by its time
    for turn in count():
        due = [place for place in planned if held[place] and turn < len(planned[place])]
        places = np.array(due, int)
        if not len(places):
            break
        theta = np.array([planned[place][turn] for place in places])
        step = tried.of(places)
        state, slope = step.at(theta)
        v = _velocity(control, places, theta, state)
        agrees = step.changes(v - slope)[0] <= method.defect
        held[places] = agrees
        for row in (~agrees).nonzero()[0]:
            found[places[row]] = {theta[row].item(): v[row : row + 1]}
    for place in (suspect | (good & ~held)).nonzero()[0]:
        step = tried.of(np.array([place]))
        held[place] = _locate(control, step, place, found.setdefault(place, {}), held[place])
    for place in (~held).nonzero()[0].tolist():
        control.remember(place, _oddest(tried.of(np.array([place])), found.get(place, {})))
    return held


def _detrended(step: Tried, also: _Velocities) -> tuple[_Velocities, Tensor]:
    """A scene's velocities at its stages and `also` without their smooth trend, by increasing share
    of the step, and the trend: per element, the median slope over the gaps between stages.
    """
    stages = {theta: step.k[i] for theta, i in step.method.distinct.items()}
    slopes = [(stages[right] - stages[left]) / (right - left) for left, right in pairwise(stages)]
    trend = torch.stack(slopes).median(0).values
    points = sorted((stages | also).items())
    return {theta: value - theta * trend for theta, value in points}, trend


def _oddest(step: Tried, also: _Velocities) -> float:
    """The first share of a scene's step with at least a quarter of the largest change of v from its
    start; 0 if v is not finite.

    Later stages may differ more, since their states depend on the first.
    """
    points, _ = _detrended(step, also)
    changes = step.changes(*(value - points[0.0] for value in points.values()))[:, 0]
    return list(points)[(changes >= changes.max() / 4).argmax()]


def _locate(
    control: StepController, step: Tried, place: int, also: _Velocities, held: bool
) -> bool:
    """Bisect a scene's step until a jump is located or excluded; whether the step remains `held`.

    The bracket begins as the first pair of neighbouring values (stages and `also`) with at least
    half of the largest change of v without its trend. New values are added to `also`.
    """
    points, trend = _detrended(step, also)
    thetas = list(points)
    values = list(points.values())
    changes = step.changes(*(after - before for before, after in pairwise(values)))[:, 0]
    first = int((changes >= changes.max() / 2).argmax())
    left = thetas[first]
    right = thetas[first + 1]
    before = values[first]
    after = values[first + 1]
    change = changes[first]  # norm of h (after - before), in tolerances
    most = 0.0  # largest change of any half so far
    while True:
        middle = np.array([(left + right) / 2])
        state, slope = step.at(middle)
        v = _velocity(control, np.array([place]), middle, state)
        also[middle.item()] = v
        held = held and bool(step.changes(v - slope)[0, 0] <= _GROSS * step.method.defect)
        value = v - trend * middle.item()
        halves = step.changes(value - before, after - value)[:, 0]
        larger = halves.max()
        most = max(most, larger)
        smooth = halves.min() > _EVEN * larger and change > 1.2 * larger  # less: a pulse
        if smooth or most > _POLE * changes[first] or not most / 2 <= larger < math.inf:
            if not held:  # v does not jump: it changes in both halves, or has a pole
                control.shorten(place, max(left, right - left))
            return held
        if halves[0] >= larger / 2:
            right = middle.item()
            after = value
            change = halves[0]
        else:
            left = middle.item()
            before = value
            change = halves[1]
        # The error of a trapezoidal step across the bracket.
        if change * (right - left) / 2 <= _CROSSING:
            control.stop_at(place, left, right)
            return False
        if right - left <= control.shortest()[place] / control.h[place]:
            control.shorten(place, SHRINK)  # a pole: no step across it meets the tolerance
            return False


def _velocity(control: StepController, places: ndarray, theta: ndarray, x: Tensor) -> Tensor:
    """v of some scenes at shares theta of their steps; NaN for scenes without budget."""
    values = torch.full_like(x, math.nan)
    able = (control.budget()[places] > 0).nonzero()[0]
    if len(able):
        t = control.time(control.reached[places] + theta * control.h[places])[able]
        values[able] = control.v.some(places[able], x.new_tensor(t), x[able])
    return values
