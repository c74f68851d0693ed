"""Step size control for many scenes at once, on the host and in float64."""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from r2flow.flow.solvers.pairs import Pair
from r2flow.flow.solvers.solution import Solution

SHRINK = 0.2  # the least share of a step that the next one is
MEMORY = 0.04  # weight of the previous error in the step's choice, its "beta": steadier steps at a stability limit
STIFF_AFTER, SMOOTH_AFTER = 15, 6  # Hairer: so many stiff steps, not interrupted by so many others, are no accident


class Limits(NamedTuple):
    """What a solution is held to.

    Attributes:
        tolerance: Absolute and relative tolerance of one step's error, before it is floored.
        tighter: By how much the tolerance goes below that.
        max_evaluations: Budget of one scene.
        max_step: Longest step as a share of the interval.
        finish: The last stretch of the interval, left to one Euler step.
    """

    tolerance: float
    max_evaluations: int
    tighter: float = 1.0
    max_step: float = 1.0
    finish: float = 0.0


class Clock:
    """Where every scene of the batch is, how far it dares to go next, and what has been counted on the way.

    Everything is an array with one entry for each scene still in the batch, except what `solution` needs of all.
    Progress is measured as a length from t_0, so that both directions of time are one.
    """

    def __init__(self, scenes: np.ndarray, t_0: float, t_1: float, pair: Pair, limits: Limits, eps: float) -> None:
        self.pair, self.limits, self.nodes = pair, limits, np.array(pair.nodes)[:, None]
        self.t_0, self.direction = t_0, math.copysign(1.0, t_1 - t_0)
        self.length = abs(t_1 - t_0) - limits.finish
        self.t_end = t_0 + self.direction * self.length if limits.finish else t_1
        self.low, self.high = sorted((t_0, self.t_end))
        self.longest = limits.max_step * self.length
        self.eps = eps
        self.scenes, self.places = scenes, np.arange(len(scenes))
        of = len(scenes)
        self.reached, self.h, self.grow = np.zeros(of), np.full(of, self.length), np.full(of, pair.grow)
        self.last_error = np.full(of, 1e-4)  # dopri5.f
        self.stiff_run, self.smooth_run = np.zeros(of, int), np.zeros(of, int)
        self.arrived, self.leaving = np.zeros(of, bool), np.zeros(of, bool)
        self.accepted, self.rejected = np.zeros(of, int), np.zeros(of, int)
        self.stiff, self.converged = np.zeros(of, bool), np.zeros(of, bool)

    def time(self, reached: np.ndarray) -> np.ndarray:
        """t at a length from t_0, never beyond the end."""
        t = self.t_0 + self.direction * np.minimum(reached, self.length)
        t = np.where(reached >= self.length, self.t_end, t)
        return np.minimum(np.maximum(t, self.low), self.high)

    def shortest(self) -> np.ndarray:
        """Steps below which the stages' times, in the state's type, are no longer different, (B,)."""
        return 4 * self.eps * np.maximum(np.abs(self.time(self.reached)), 1e-3 * self.length)

    def now(self, x: Tensor) -> Tensor:
        """t of every scene, (B,), where and as x is."""
        return torch.from_numpy(self.time(self.reached)).to(x.device, x.dtype)

    def probe(self, state: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Time and signed length, (2, B), of the Euler step that feels for the curvature."""
        with np.errstate(divide="ignore", invalid="ignore"):
            h = np.where((state < 1e-5) | (slope < 1e-5), 1e-6 * self.length, 0.01 * state / slope)
        self.h = np.fmin(h, self.longest)
        return np.stack([self.time(self.h), self.direction * self.h])

    def start(self, slope: np.ndarray, change: np.ndarray, evaluations: np.ndarray) -> None:
        """The first step, from the size of v and of its change over the probe; a scene without finite v leaves."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            steepest = np.fmax(slope, change / self.h)
            h = np.where(steepest <= 1e-15, 1e3 * self.h, (0.01 / steepest) ** (1 / self.pair.order))
        h = np.where(np.isfinite(h), np.minimum(100 * self.h, h), self.h)
        h = np.where(steepest == 0, self.longest, h)  # an untrained network's 0
        self.h = np.maximum(h, self.shortest()).astype(np.float32).astype(np.float64)
        self.leaving = ~np.isfinite(slope) | self._spent(evaluations)

    def propose(self) -> np.ndarray:
        """Times of the stages and signed steps, (stages + 1, B); no sliver is left before the end."""
        left = self.length - self.reached
        h = np.minimum(self.h, self.longest)
        h = np.where(1.01 * h >= left, left, np.where(2 * h > left, left / 2, h))
        self.h, self.following = h, np.where(h == left, self.length, self.reached + h)
        stages = self.time(np.where(self.nodes == 1, self.following, self.reached + self.nodes * h))
        return np.concatenate([stages, self.direction * h[None]])

    def judge(self, error: np.ndarray, dk: np.ndarray, dy: np.ndarray, evaluations: np.ndarray) -> np.ndarray:
        """Move the clocks of those scenes whose step is good enough, (B,) bool, and choose everyone's next step.

        Args:
            error: Norm of the local error over the tolerance.
            dk, dy: Size of v and x by which the last two stages differ.
            evaluations: Spent so far.
        """
        finite = np.isfinite(error) & np.isfinite(dk) & np.isfinite(dy)
        good = finite & (error <= 1)
        self.accepted[self.places] += good
        self.rejected[self.places] += ~good
        self._look_for_stiffness(good, dk, dy)
        tried = self.h
        self.reached = np.where(good, self.following, self.reached)
        self.h = tried * self._factors(good, finite, error)
        self.grow = np.where(good, self.pair.grow, 1.0)
        self.last_error = np.where(good, np.maximum(error, 1e-4), self.last_error)
        self.arrived = good & (self.reached >= self.length)
        stuck = (self.h < self.shortest()) & ~good
        self.leaving = self.arrived | stuck | self._spent(evaluations)
        return good

    def _spent(self, evaluations: np.ndarray) -> np.ndarray:
        return evaluations + self.pair.stages > self.limits.max_evaluations

    def _factors(self, good: np.ndarray, finite: np.ndarray, error: np.ndarray) -> np.ndarray:
        """The controller of dopri5.f, h_new / h = S err^-(1/q - 3/4 beta) err_before^beta with S the pair's safety;
        1/5 where not finite.
        """
        error = np.where(finite, np.maximum(error, 1e-10), np.inf)
        q = 1 / self.pair.order
        steady = self.pair.safety * error ** -(q - 0.75 * MEMORY) * self.last_error**MEMORY
        retry = self.pair.safety * error ** -(q - 0.75 * MEMORY)
        factors = np.where(good, np.clip(steady, SHRINK, self.grow), np.clip(retry, SHRINK, 1.0))
        # as in `_norms`: one ulp more or less must not be carried on
        return factors.astype(np.float32).astype(np.float64)

    def _look_for_stiffness(self, good: np.ndarray, dk: np.ndarray, dy: np.ndarray) -> None:
        """Hairer, Wanner, Solving Ordinary Differential Equations II, IV.2: h |dk| / |dy| estimates |h lambda|.

        Where it keeps touching the edge of the stability region, stability and not accuracy holds the steps short.
        """
        with np.errstate(invalid="ignore", over="ignore"):
            touching = good & (self.h * dk > self.pair.stability * dy)
        self.stiff_run += touching
        self.smooth_run = np.where(touching, 0, self.smooth_run + (good & ~touching))
        self.stiff_run = np.where(self.smooth_run >= SMOOTH_AFTER, 0, self.stiff_run)
        self.stiff[self.places] |= self.stiff_run >= STIFF_AFTER

    def keep(self, rest: np.ndarray) -> None:
        """Let the others go, and note which of them have arrived."""
        self.converged[self.places] |= self.arrived
        for name in (
            "scenes", "places", "reached", "h", "grow", "last_error", "stiff_run", "smooth_run", "arrived", "leaving",
        ):  # fmt: skip
            setattr(self, name, getattr(self, name)[rest])

    def solution(self, x: Tensor, evaluations: np.ndarray) -> Solution:
        """What has become of all scenes."""
        return Solution.build(x, evaluations, self.accepted, self.rejected, self.stiff, self.converged)
